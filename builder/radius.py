"""Radius models: how large a sphere a point stands for.

`mean` is the paper's ([Fig12] section 7): half the mean closest-point distance, one figure a dataset. It is
taken over distinct points, across voxel borders; duplicates would make it zero (NUMERICS.md case 28).
"""

import math
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..schemas.archive import Archive
from ..schemas.voxel import Links, VoxelData
from .hierarchy import Hierarchy, build_hierarchy
from .kernels.nearest import FAR, SearchTree, box_distance2, closest_other
from .kernels.octree import voxel_codes

# Distances are added as integers of 2^-32 m: any order gives the same sum (NUMERICS.md N8), and 10^6 of
# 2 km fit 63 bits.
SUM_UNITS = 2.0**32

# An avatar's own lattice is never finer than this: 1 micrometre.
FINEST_STEP = 2.0**-20
# Most lattice steps an avatar extends, so that the bounds' arithmetic stays inside int64 and int32.
MOST_STEPS = 1 << 22


class MeanDistance(NamedTuple):
    """The mean closest-point distance [m], its standard error [m] (0 when all were asked), how many were asked."""

    mean: float
    error: float
    sample: int


class LocalHierarchy(NamedTuple):
    """A hierarchy of free points on a lattice of their own: world = low + steps * step (low (3,) [m])."""

    hierarchy: Hierarchy
    low: NDArray[np.float64]
    step: float


def mean_of_squares(total: int, squares: int, sample: int, everything: bool) -> MeanDistance:
    """The mean from integer sums: distances in SUM_UNITS, and their squares."""
    if sample == 0:
        return MeanDistance(0.0, 0.0, 0)
    mean = total / sample
    variance = max(squares / sample - mean * mean, 0.0) * sample / max(sample - 1, 1)
    error = 0.0 if everything else math.sqrt(variance / sample) / SUM_UNITS
    return MeanDistance(mean / SUM_UNITS, error, sample)


def build_local(points: NDArray[np.float64], *, leaf: int, degree: int) -> LocalHierarchy:
    """The hierarchy of points (n, 3) [m], n >= 1, on a lattice of 2^-20 m, or of the power of two their
    extent needs.

    Points are rounded down to it, so each lies less than two steps (sqrt(3) of them) from its lattice point.
    """
    low = points.min(axis=0)
    extent = float((points.max(axis=0) - low).max())
    step = max(FINEST_STEP, 2.0 ** math.ceil(math.log2(extent / MOST_STEPS))) if extent > 0 else FINEST_STEP
    steps = np.floor((points - low) / step).astype(np.int32)
    return LocalHierarchy(build_hierarchy(steps, leaf=leaf, degree=degree, highest=2 * MOST_STEPS), low, step)


def mean_closest_distance(local: LocalHierarchy) -> float:
    """The mean closest-point distance [m] over distinct points, on their lattice; 0 for fewer than two."""
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
    queries = np.unique(points, axis=0)
    if len(queries) < 2:
        return 0.0
    best = np.full(len(queries), FAR)
    closest_other(search, queries, best)
    return math.fsum(np.sqrt(best.astype(np.float64)) * local.step) / len(queries)


def search_tree(voxel: VoxelData, links: Links) -> SearchTree:
    """A voxel's hierarchy and points in voxel steps, for `closest_other`."""
    in_cell = links.cell >= 0
    low = np.where(in_cell[:, None], voxel.cells.low[links.cell], 0).astype(np.int64)
    unit = np.where(in_cell, 1, 1 << voxel.top_shift).astype(np.int64)
    center = low + voxel.nodes.center.astype(np.int64) * unit[:, None]
    return SearchTree(
        center,
        voxel.nodes.radius.astype(np.int64) * unit,
        links.first,
        voxel.nodes.count,
        links.is_leaf,
        voxel_points(voxel, links),
    )


def voxel_points(voxel: VoxelData, links: Links) -> NDArray[np.int64]:
    """The points of a voxel (p, 3) int64 [voxel steps], in stored order."""
    leaf = np.flatnonzero(links.is_leaf)
    # By first point: a cell that is one leaf node stands among the roots, before the others' leaf nodes.
    leaf = leaf[np.argsort(links.first[leaf], kind="stable")]
    low = voxel.cells.low[links.cell[leaf]].astype(np.int64) + voxel.nodes.block_low[leaf]
    return np.repeat(low, voxel.nodes.count[leaf].astype(np.int64), axis=0) + voxel.points.astype(np.int64)


def sample_mask(lattice: NDArray[np.int64], share: float) -> NDArray[np.bool_]:
    """Which lattice points (n, 3) are asked: about `share` of them, chosen by their coordinates alone.

    So a point is asked or not whatever the order of scans, the voxel size or the number of jobs. The
    hash is the finaliser of MurmurHash3 (Appleby) over the three coordinates.
    """
    if share >= 1.0:
        return np.ones(len(lattice), bool)
    h = np.zeros(len(lattice), np.uint64)
    for k in range(3):
        h ^= lattice[:, k].astype(np.uint64)
        h ^= h >> np.uint64(33)
        h *= np.uint64(0xFF51AFD7ED558CCD)
        h ^= h >> np.uint64(33)
        h *= np.uint64(0xC4CEB9FE1A85EC53)
        h ^= h >> np.uint64(33)
    return h < np.uint64(int(share * 2.0**64))


def archive_sums(
    archive: Archive, rows: range, share: float, tick: Callable[[], None]
) -> tuple[int, int, int]:
    """Sums over the sampled distinct points of the voxels `rows`: distances, their squares, how many.

    Distances in SUM_UNITS, as Python integers: no order changes them. A point alone in the dataset has no
    closest other and is left out. Neighbouring voxels are opened only while one of them could hold something
    closer; at most 16 are held at a time.
    """
    steps, scale = archive.header.lattice.voxel_steps, archive.header.lattice.step * SUM_UNITS
    base = archive.coordinates * steps
    low, high = base + archive.voxels["low"], base + archive.voxels["high"]

    @lru_cache(maxsize=16)
    def tree_of(row: int) -> SearchTree:
        return search_tree(*archive.read_voxel(row))

    total = squares = sample = 0
    for row in rows:
        own = tree_of(row)
        queries = own.points[sample_mask(own.points + base[row], share)]
        queries = queries[np.unique(voxel_codes(queries), return_index=True)[1]] + base[row]
        best = np.full(len(queries), FAR)
        if len(queries):
            closest_other(own, queries - base[row], best)
            _ask_neighbours(row, queries, best, low, high, base, tree_of)
        best = best[best < FAR]
        distances = np.rint(np.sqrt(best.astype(np.float64)) * scale).astype(np.int64)
        total += int(distances.sum(dtype=np.int64))
        squares += sum(int(d) ** 2 for d in distances.tolist())
        sample += len(distances)
        tick()
    return total, squares, sample


def _ask_neighbours(
    row: int,
    queries: NDArray[np.int64],
    best: NDArray[np.int64],
    low: NDArray[np.int64],
    high: NDArray[np.int64],
    base: NDArray[np.int64],
    tree_of: Callable[[int], SearchTree],
) -> None:
    """Lower `best` by the points of other voxels, nearest box first, until none can hold anything closer."""
    gap = np.maximum(np.maximum(low - high[row], low[row] - high), 0).astype(np.float64)
    apart = (gap * gap).sum(axis=1)
    to_box = np.empty(len(queries), np.int64)
    # The box distance is a float64 sum of squares: a millionth less than it is surely a lower bound.
    apart *= 1 - 1e-6
    near_voxels = np.flatnonzero(apart < float(best.max()))
    for other in near_voxels[np.argsort(apart[near_voxels], kind="stable")]:
        if other == row:
            continue
        if apart[other] >= float(best.max()):
            break
        box_distance2(queries, low[other], high[other], to_box)
        near = np.flatnonzero(to_box < best)
        if len(near):
            lowered = best[near]
            closest_other(tree_of(int(other)), queries[near] - base[other], lowered)
            best[near] = lowered
