"""What a set of recorded presses is, and the splits that sets share."""

import dataclasses

import numpy as np

GROUPS = 5


@dataclasses.dataclass
class Recorded:
    """Presses: counts, [rows, taxels] each, level from 0, the hardest one, object, number of the trial, the sensor's table.

    The first row of a press is unloaded.
    """

    counts: list
    level: np.ndarray
    object: np.ndarray
    trial: np.ndarray
    sensor: str


def by_time(recorded, share):
    """(title, one part of presses to learn from and to judge): the later trials are judged."""
    last = round(share * recorded.trial.max())
    return "later presses", [(np.flatnonzero(recorded.trial <= last), np.flatnonzero(recorded.trial > last))]


def by_object(recorded):
    """(title, parts): each object is judged by others, in five parts. The objects of a level are shared out."""
    part = {}
    for level in np.unique(recorded.level):
        objects = np.unique(recorded.object[recorded.level == level])
        part.update({name: (level + place) % GROUPS for place, name in enumerate(objects)})
    part = np.array([part[name] for name in recorded.object])
    parts = [(np.flatnonzero(part != own), np.flatnonzero(part == own)) for own in np.unique(part)]
    return "other objects", parts
