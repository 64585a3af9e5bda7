"""What a policy sees of a sensor at one moment: arrays of fixed shape, in which every number is finite.

`hardnessd.export` fills data sets of LeRobot with them, and the camera `lerobot_camera_hardnessd` gives them
live. So both kinds of data sets have the same columns.

It needs numpy: pip install './clients/python[export]'
"""

from __future__ import annotations

import math
from typing import Any, Dict, List, Mapping, NamedTuple, Optional

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]

LONGEST_VERDICT_AGE_S = 60.0
"""An older verdict counts as none, so that its age has a bound."""

KEYS: Dict[str, str] = {
    "newtons": "observation.tactile.{sensor}.newtons",
    "force_n": "observation.tactile.{sensor}.state",
    "contact_area_taxels": "observation.tactile.{sensor}.state",
    "approach_mm": "observation.tactile.{sensor}.state",
    "approach_known": "observation.tactile.{sensor}.state",
    "level": "observation.tactile.{sensor}.state",
    "confidence": "observation.tactile.{sensor}.state",
    "verdict_age_s": "observation.tactile.{sensor}.state",
}
"""The key of the feature that has each quantity. Quantities of one key are the elements of one vector."""


class Verdict(NamedTuple):
    """What is known of the object that was pressed last."""

    level: Optional[int]
    confidence: float
    age_s: float
    """Since it was published."""


def keys_of(sensor: str, changed: Mapping[str, str] = {}) -> Dict[str, str]:
    """The keys for a sensor. `changed` replaces keys of KEYS; an empty key leaves the quantity out.

    Raises ValueError if there is no such quantity, or if `newtons` shares its key.
    """
    for quantity in changed:
        if quantity not in KEYS:
            raise ValueError(f"found the quantity {quantity!r}, expected {', '.join(KEYS)}")
    keys = {quantity: key.replace("{sensor}", sensor) for quantity, key in {**KEYS, **changed}.items() if key}
    for quantity, key in keys.items():
        if "/" in key:
            raise ValueError(f"found the key {key!r}, expected one without a slash")
        if quantity != "newtons" and key == keys.get("newtons"):
            raise ValueError(f"newtons is an array: {quantity} needs another key than {key!r}")
    return keys


def features(keys: Mapping[str, str], rows: int, cols: int) -> Dict[str, Dict[str, Any]]:
    """The features of a LeRobot data set that `values` fills."""
    found: Dict[str, Dict[str, Any]] = {}
    for key, quantities in _by_key(keys).items():
        shape, names = ((rows, cols), ["rows", "cols"]) if quantities == ["newtons"] else ((len(quantities),), quantities)
        found[key] = {"dtype": "float32", "shape": shape, "names": names}
    return found


def values(
    keys: Mapping[str, str],
    newtons: Array,
    force_n: float,
    contact_area_taxels: int,
    approach_mm: Optional[float],
    verdict: Optional[Verdict],
) -> Dict[str, Array]:
    """The features of one moment. `newtons` has the shape [rows, cols].

    Where the approach is not known it is 0, and `approach_known` is 0. Where there is no verdict, or only one older
    than LONGEST_VERDICT_AGE_S, `level` and `confidence` are 0 and the age is LONGEST_VERDICT_AGE_S. A rejected verdict
    has level 0.
    """
    known = approach_mm is not None and math.isfinite(approach_mm)
    if verdict is None or verdict.age_s >= LONGEST_VERDICT_AGE_S:
        verdict = Verdict(None, 0.0, LONGEST_VERDICT_AGE_S)
    numbers: Dict[str, float] = {
        "force_n": force_n,
        "contact_area_taxels": contact_area_taxels,
        "approach_mm": approach_mm if known and approach_mm is not None else 0.0,
        "approach_known": float(known),
        "level": verdict.level or 0,
        "confidence": verdict.confidence,
        "verdict_age_s": verdict.age_s,
    }
    return {
        key: newtons.astype(np.float32)
        if quantities == ["newtons"]
        else np.array([numbers[quantity] for quantity in quantities], np.float32)
        for key, quantities in _by_key(keys).items()
    }


def _by_key(keys: Mapping[str, str]) -> Dict[str, List[str]]:
    """The quantities of each key, in the order of KEYS."""
    found: Dict[str, List[str]] = {}
    for quantity in KEYS:
        if quantity in keys:
            found.setdefault(keys[quantity], []).append(quantity)
    return found
