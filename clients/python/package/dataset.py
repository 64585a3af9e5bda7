"""Data sets: the `.npz` files that `hrn-train simulate` and `hrn-train collect` write.

    from hardnessd import dataset

    presses = dataset.load("data.npz")
    test = presses.part("test")
    print(test.frames.shape, test.level)

It needs numpy: pip install './clients/python[dataset]'
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass, field, fields, replace
from typing import Any, Dict, Literal, Optional, Tuple

import numpy as np
import numpy.typing as npt

from hardnessd.files import Path, reading

Array = npt.NDArray[Any]

# Name, type, shape behind the number of presses.
_ARRAYS: Tuple[Tuple[str, str, Tuple[int, ...]], ...] = (
    ("frames", "float32", (28, 28)),
    ("level", "uint8", ()),
    ("object", "uint32", ()),
    ("material", "uint8", ()),
    ("force", "float32", ()),
    ("split", "uint8", ()),
    ("shore", "float32", ()),
)

# Newtons on a taxel that the trainer takes (docs/formats.md).
MOST_N = 1_000_000

# What a file that begins with these bytes is.
_KINDS: Dict[bytes, str] = {
    b"\x89MCA": "a recording (MCAP). Read it with hardnessd.recording, or collect its presses with "
    "`hrn-train collect`",
    b"\x93NUM": "a single array (.npy)",
}


@dataclass(frozen=True)
class DataSet:
    """Presses. Each array has one element a press."""

    frames: Array
    """float32 [N, 28, 28]: newtons on each taxel, in the frame of maximal contact area."""
    level: Array
    """uint8 [N]: 1 (hard) to 4 (very soft), 0 where it is not known."""
    split: Array
    """uint8 [N]: 0 for training, 1 for testing."""
    object: Optional[Array] = None
    """uint32 [N]: which object was pressed."""
    material: Optional[Array] = None
    """uint8 [N]: index into meta["materials"]."""
    force: Optional[Array] = None
    """float32 [N]: peak force of the press in newtons."""
    shore: Optional[Array] = None
    """float32 [N]: the measured hardness, Shore."""
    meta: Dict[str, Any] = field(default_factory=dict)
    """Names of materials and levels, seed, generator, pitch."""
    others: Dict[str, Array] = field(default_factory=dict)
    """Arrays that this module does not know, as they are in the file."""

    def __len__(self) -> int:
        return len(self.level)

    def part(self, split: Literal["train", "test"]) -> DataSet:
        """Only the presses of one split."""
        return self.where(self.split == ("train", "test").index(split))

    def labelled(self) -> DataSet:
        """Only the presses whose level is known."""
        return self.where(self.level != 0)

    def where(self, chosen: Array) -> DataSet:
        """Only the presses that `chosen` selects: booleans or indices."""
        names = {name for name, _, _ in _ARRAYS}
        found = {f.name: getattr(self, f.name) for f in fields(self) if f.name in names}
        picked = {name: array[chosen] for name, array in found.items() if array is not None}
        others = {
            name: array[chosen] if array.shape[:1] == (len(self),) else array
            for name, array in self.others.items()
        }
        return replace(self, **picked, others=others)


def load(path: Path) -> DataSet:
    """Reads a data set. Raises ValueError if the file is none, OSError if it cannot be read."""
    arrays, meta = _content(path)
    if "frames_mn" in arrays:
        raise ValueError(
            f"{os.fspath(path)}: it has whole presses (--sequences), and this module reads single frames: "
            "docs/formats.md says how to read them"
        )
    for name in ("frames", "level"):
        if name not in arrays:
            raise ValueError(f"{os.fspath(path)}: {name}: found none, expected an array")
    count = len(np.atleast_1d(arrays["level"]))
    arrays.setdefault("split", np.zeros(count, np.uint8))
    known: Dict[str, Array] = {}
    for name, dtype, shape in _ARRAYS:
        if (array := arrays.pop(name, None)) is None:
            continue
        if array.dtype != dtype or array.shape != (count, *shape):
            raise ValueError(
                f"{os.fspath(path)}: {name}: found {array.dtype} {list(array.shape)}, "
                f"expected {dtype} {[count, *shape]}"
            )
        known[name] = array
    return DataSet(**known, meta=meta, others=arrays)


def best_frames(path: Path) -> Tuple[Dict[str, Array], Dict[str, Any]]:
    """The arrays and `meta` of single frames or of whole presses, as the trainer reads them: either has `frames`,
    newtons of one frame of each press, `level` and `split`. Raises what `load` raises."""
    arrays, meta = _content(path)
    with reading(path, "not a data set (.npz)"):
        if "frames_mn" in arrays:
            arrays["frames"] = arrays["frames_mn"][arrays["best"]] / np.float32(1000)
        count = len(arrays["level"])
        arrays.setdefault("split", np.zeros(count, np.uint8))
        for name, shape in (("frames", (count, 28, 28)), ("level", (count,)), ("split", (count,))):
            array = arrays[name]
            if array.shape != shape or array.dtype.kind not in "biuf":
                raise ValueError(f"{name}: found {array.dtype} {list(array.shape)}, expected numbers {list(shape)}")
        wrong = arrays["frames"][~(np.abs(arrays["frames"]) <= MOST_N)]
        if wrong.size:
            raise ValueError(f"frames: found {wrong[0]}, expected -{MOST_N} to {MOST_N}")
    return arrays, meta


def _content(path: Path) -> Tuple[Dict[str, Array], Dict[str, Any]]:
    """The arrays of a file, and its `meta`."""
    with reading(path, "not a data set (.npz)"), open(path, "rb") as content:
        # numpy takes what it does not know for pickled objects, and proposes to load them unsafely.
        begin = content.read(4)
        if not begin.startswith(b"PK"):
            raise ValueError(_KINDS.get(begin, "no zip archive"))
        content.seek(0)
        with np.load(content, allow_pickle=False) as file:
            arrays = {name: np.asarray(file[name]) for name in file.files}
    with reading(path, "meta: not JSON"):
        meta = json.loads(arrays.pop("meta", np.frombuffer(b"{}", np.uint8)).tobytes())
    with reading(path, "meta"):
        if not isinstance(meta, dict):
            raise ValueError(f"found {type(meta).__name__}, expected an object")
    return arrays, meta
