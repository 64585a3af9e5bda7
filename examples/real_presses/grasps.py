"""Which level a gripper with 16 taxels has grasped: printed cubes and cylinders, one object a level.

In: the volts of each grasp over time. Out: printed shares of grasps judged correctly, by another shape and by
five references a level. Beside each is the share by the unloaded first row, which can show the session only.
"""

import itertools
import sys

import numpy as np
from sklearn.covariance import LedoitWolf
from threadpoolctl import threadpool_limits

SEED = 1
ROWS, TAXELS, PARTS = 80, 16, 2
# Changes are seen on a logarithmic scale from here on.
SCALE_V = 1e-3
REFERENCES = 5
DRAWS = 100
# Where references are drawn: up to which grasp of an object, and after which grasp the others are judged. The
# numbers of the files give the order.
DRAWN = {"anywhere": (None, 0), "among the first 40, judged after the first 85": (40, 85)}
# The levels that cubes and cylinders both have, by the page of the data. By the names of the files (3P, 5P and
# 10P of the cylinders; 3P, 5P, 7P, 10P and 12P of the cubes) it is the cubes' level 3 that matches the last.
BOTH = (0, 1, 2)
BY_NAME = (0, 1, 3)
# How a grasp is judged: by the nearest mean of a level's references, or by the nearest reference; and whether
# the other shape's grasps say what differs between grasps of one object.
RULES = {
    "nearest mean": (True, True),
    "nearest reference": (False, True),
    "nearest mean, this shape alone": (True, False),
}


def percent(share):
    return f"{100 * share:.1f} %"


def course(volts):
    """[grasps, 64]: the greatest and the least change of each taxel since its first row, in two parts of time."""
    changes = (volts - volts[:, :1]).reshape(-1, PARTS, ROWS // PARTS, TAXELS) / SCALE_V
    found = np.stack([changes.max(axis=2), changes.min(axis=2)], axis=1).reshape(len(volts), -1)
    return np.sign(found) * np.log1p(np.abs(found))


def unloaded(volts):
    """[grasps, 16]: the first row alone, before anything is touched. It can show the session, not the object."""
    return volts[:, 0] / SCALE_V


def read_grasps(directory, shape):
    """Volts [grasps, 80, 16] and levels [grasps] of the objects of a shape, in the order of their numbers."""
    files = (directory / "Dataset" / shape / f"{ROWS}_Samples").glob("*/*.csv")
    files = sorted(files, key=lambda file: (file.parent.name, int(file.stem.split("_")[-1])))
    if not files:
        sys.exit(f"{directory}: no grasps of {shape}")
    volts = np.array([np.loadtxt(file, delimiter=",") for file in files])
    return volts, np.array([int(file.parent.name) for file in files])


def of_levels(grasps, levels):
    """The inputs and levels of the grasps that have one of these levels."""
    return tuple(of[np.isin(grasps[1], levels)] for of in grasps)


def means(inputs, level):
    """The mean of each level, and the levels."""
    levels = np.unique(level)
    return np.array([inputs[level == own].mean(axis=0) for own in levels]), levels


def residuals(inputs, level):
    """Each grasp minus the mean of its level: how grasps of one object differ."""
    centres, levels = means(inputs, level)
    return inputs - centres[np.searchsorted(levels, level)]


def nearest(centres, levels, inputs, differ):
    """The level of the nearest centre of each input. What differs between grasps of one object counts less."""
    if differ is not None:
        metric = np.linalg.cholesky(LedoitWolf(assume_centered=True).fit(differ).precision_)
        centres, inputs = centres @ metric, inputs @ metric
    return levels[((inputs[:, None] - centres) ** 2).sum(axis=2).argmin(axis=1)]


def unseen(known, levels, other):
    """[1, objects, grasps]: which grasps are judged correctly by the means of these levels of another shape."""
    known = of_levels(known, levels)
    inputs, level = of_levels(other, BOTH)
    right = nearest(*means(*known), inputs, residuals(*known)) == np.array(levels)[level]
    return np.array([[right[level == own] for own in BOTH]])


def referred(known, other, rule, drawn):
    """[draws, objects, grasps]: which grasps of `other` are judged correctly by references drawn at random.

    The references are not judged. `known` are grasps of another shape.
    """
    by_mean, other_shape = RULES[rule]
    up_to, after = DRAWN[drawn]
    rng = np.random.default_rng(SEED)
    rights = []
    for _ in range(DRAWS):
        places = [np.flatnonzero(other[1] == own) for own in np.unique(other[1])]
        chosen = [rng.permutation(of[:up_to])[:REFERENCES] for of in places]
        references = tuple(of[np.concatenate(chosen)] for of in other)
        differ = np.concatenate([residuals(*known), residuals(*references)]) if other_shape else None
        centres = means(*references) if by_mean else references
        judged = [np.setdiff1d(of[after:], own) for of, own in zip(places, chosen)]
        rights.append([nearest(*centres, other[0][of], differ) == other[1][of] for of in judged])
    return np.array(rights)


def one_for_all(cubes, rule, drawn):
    """The share judged correctly if one cube stands for the other shape, and the four others have references."""
    levels = np.unique(cubes[1])
    splits = [(of_levels(cubes, [one]), of_levels(cubes, levels[levels != one])) for one in levels]
    return np.mean([referred(*split, rule, drawn).mean() for split in splits])


def print_rights(title, rights):
    """Prints the share judged correctly: in all, over draws, by object, and beside it that by the unloaded row alone."""
    of_course, of_unloaded = rights
    low, high = np.percentile(of_course.mean(axis=(1, 2)), [2.5, 97.5])
    draws = f" ({percent(low)} to {percent(high)} over the draws)" if len(of_course) > 1 else ""
    objects = ", ".join(percent(share) for share in of_course.mean(axis=(0, 2)))
    missed = percent(of_course[~of_unloaded].mean())
    print(f"  {title}: {percent(of_course.mean())}{draws}; by object: {objects}")
    print(f"    the unloaded row alone: {percent(of_unloaded.mean())}; of what that misses: {missed}")


# The matrices are small, so several threads would only wait for each other.
@threadpool_limits.wrap(limits=1)
def report(directory):
    volts = [read_grasps(directory, shape) for shape in ("Cubes", "Cylinders")]
    views = [[(see(of), level) for of, level in volts] for see in (course, unloaded)]
    print("nothing known of the shape; chance is a third:")
    print_rights("cylinders by cubes", [unseen(cubes, BOTH, cylinders) for cubes, cylinders in views])
    print_rights("the same, paired by file name", [unseen(cubes, BY_NAME, cylinders) for cubes, cylinders in views])
    print_rights("cubes by cylinders", [unseen(cylinders, BOTH, cubes) for cubes, cylinders in views])
    for drawn, rule in itertools.product(DRAWN, RULES):
        print(f"{REFERENCES} references a level, drawn {drawn}; {rule}:")
        print_rights("cylinders", [referred(cubes, cylinders, rule, drawn) for cubes, cylinders in views])
        both = [(cylinders, of_levels(cubes, BOTH)) for cubes, cylinders in views]
        print_rights("cubes", [referred(*shapes, rule, drawn) for shapes in both])
        of_cubes = one_for_all(views[0][0], rule, drawn)
        print(f"  four cubes, with one other cube as the other shape: {percent(of_cubes)}")
