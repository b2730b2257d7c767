"""Radius models: the radius of the sphere that represents a point.

`mean` is the model of the paper ([Fig12] section 7): half the mean closest-point distance, one
number per dataset. It is computed over distinct points, across voxel borders; duplicates would make
it zero (NUMERICS.md case 28).
"""

import math
from itertools import chain
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.voxel import Links, VoxelData
from ..kernels.neighbours.nearest_points import FAR, SearchTree, closest_other
from .hierarchy import Hierarchy, build_hierarchy

# Distances are added as integers of 2^-32 m: every order gives the same sum (NUMERICS.md N8), and
# 10^6 distances of 2 km fit 63 bits.
SUM_UNITS = 2.0**32

# The lattice of an avatar is never finer than this: 1 micrometre.
FINEST_STEP = 2.0**-20
# Most lattice steps that an avatar spans, which keeps the arithmetic of the bounds inside int64 and
# int32.
MOST_STEPS = 1 << 22
# Distances summed at a time; in between, other threads may take the interpreter lock.
_PIECE = 4096


class MeanDistance(NamedTuple):
    """Mean closest-point distance [m].

    error: its standard error [m], 0 if all points were used.  sample: number of points used.
    """

    mean: float
    error: float
    sample: int


class LocalHierarchy(NamedTuple):
    """Hierarchy of free points on their own lattice: world = low + steps * step (low (3,) [m])."""

    hierarchy: Hierarchy
    low: NDArray[np.float64]
    step: float


def mean_of_squares(total: int, squares: int, sample: int, everything: bool) -> MeanDistance:
    """Return the mean from integer sums: distances in SUM_UNITS, and their squares."""
    if sample == 0:
        return MeanDistance(0.0, 0.0, 0)
    mean = total / sample
    variance = max(squares / sample - mean * mean, 0.0) * sample / max(sample - 1, 1)
    error = 0.0 if everything else math.sqrt(variance / sample) / SUM_UNITS
    return MeanDistance(mean / SUM_UNITS, error, sample)


def build_local(points: NDArray[np.float64], *, leaf: int, degree: int) -> LocalHierarchy:
    """Build the hierarchy of points (n, 3) [m], n >= 1, on their own lattice.

    Its step is 2^-20 m, or the power of two that the extent of the points requires. Points are
    rounded down to the lattice. Each therefore lies less than two steps (sqrt(3) of them) from its
    lattice point.
    """
    low = points.min(axis=0)
    extent = float((points.max(axis=0) - low).max())
    step = max(FINEST_STEP, 2.0 ** math.ceil(math.log2(extent / MOST_STEPS))) if extent > 0 else FINEST_STEP
    steps = np.floor((points - low) / step).astype(np.int32)
    return LocalHierarchy(build_hierarchy(steps, leaf=leaf, degree=degree, highest=2 * MOST_STEPS), low, step)


def mean_closest_distance(local: LocalHierarchy) -> float:
    """Return the mean closest-point distance [m] of distinct lattice points.

    Return 0 for fewer than two points.
    """
    tree = local.hierarchy.tree
    t = len(tree.begin)
    is_leaf = np.arange(t) >= tree.levels[-2]
    inner = int(tree.levels[-2])
    first = np.empty(t, np.int32)
    first[:inner] = (
        1 + np.concatenate([[0], np.cumsum(tree.count[:inner], dtype=np.int64)[:-1]]) if inner else 0
    )
    first[inner:] = tree.begin[inner:]
    points = local.hierarchy.points.astype(np.int64)
    search = SearchTree(
        local.hierarchy.bounds.center, local.hierarchy.bounds.radius, first, tree.count, is_leaf, points
    )
    queries = _distinct(points)
    if len(queries) < 2:
        return 0.0
    best = np.full(len(queries), FAR)
    closest_other(search, queries, best)
    distances = np.sqrt(best.astype(np.float64)) * local.step
    # Sum in pieces: math.fsum of the whole array would hold the interpreter lock for 50 ms with
    # 10^6 points.
    pieces = (distances[i : i + _PIECE].tolist() for i in range(0, len(distances), _PIECE))
    return math.fsum(chain.from_iterable(pieces)) / len(queries)


def _distinct(points: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the distinct rows of points (n, 3), n >= 1, in lexicographic order.

    `np.unique(points, axis=0)` does the same, but holds the interpreter lock while sorting: 0.9 s
    for 10^6 points.
    """
    ordered = points[np.lexsort(points.T[::-1])]
    first = np.ones(len(ordered), bool)
    first[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    return ordered[first]


def voxel_points(voxel: VoxelData, links: Links) -> NDArray[np.int64]:
    """Return the points of a voxel (p, 3) int64 [voxel steps], in stored order."""
    leaf = np.flatnonzero(links.is_leaf)
    # Sort by first point: a cell that is a single leaf node stands among the roots, before the leaf
    # nodes of other cells.
    leaf = leaf[np.argsort(links.first[leaf], kind="stable")]
    low = voxel.cells.low[links.cell[leaf]].astype(np.int64) + voxel.nodes.block_low[leaf]
    return np.repeat(low, voxel.nodes.count[leaf].astype(np.int64), axis=0) + voxel.points.astype(np.int64)
