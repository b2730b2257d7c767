"""Radius classes of points, for the radius models `local` and `border`.

A class depends only on the distinct points within REACH of a point, and not on voxels, trees, files
or jobs. The classes of a voxel are therefore computed from its own points and from the near points
of the surrounding voxels, which are read from the spool.
"""

import math
from collections.abc import Collection, Iterable, Iterator
from fractions import Fraction
from itertools import chain
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.radius_model import LOCAL_RADII, RIM_BIT
from ...schemas.archive.voxel_grid import KEY_BIAS, voxel_coordinates, voxel_keys
from ..kernels.neighbours.nearest_neighbours import bound_boxes, box_starts
from ..kernels.neighbours.point_classes import TOO_FEW_NEIGHBOURS, point_classes
from ..kernels.points.octree_cells import voxel_codes
from ..spool.spool import Spool

# Neighbours farther away than this do not count [m]. The bound determines which voxels must be
# read.
REACH = 0.362
# The local radius is the distance of neighbour number LOCAL_NEIGHBOUR divided by this.
LOCAL_SHARE = 13
# Bits per axis of a Morton code.
CODE_BITS = 21
# The Morton codes of all points of a voxel.
ALL_CODES = range(1 << 63)
# Most points of a surrounding voxel that are read at once.
READ_POINTS = 1 << 18
# Sets of at most this many points are not split to save memory: halving them hardly reduces their
# neighbourhood.
MIN_TOGETHER = 64


class Classes(NamedTuple):
    """Radius classes.

    of_point: (n,) uint8.  capped: number of points with too few neighbours for a local class.
    """

    of_point: NDArray[np.uint8]
    capped: int


class ClassLimits(NamedTuple):
    """Squared distance limits [steps^2].

    reach2: limit up to which a point is a neighbour.
    local2: (15,) int64, upper limits of all local classes except the last, for the distance of
    neighbour number LOCAL_NEIGHBOUR.
    """

    reach2: int
    local2: NDArray[np.int64]


def class_limits(step: float) -> ClassLimits:
    """Return the limits on a lattice of step `step` [m].

    The step is taken as the decimal number that it prints as, so 10 steps of 0.1 mm are exactly 1
    mm.
    """
    steps_a_metre = 1 / Fraction(repr(step))
    radii = [Fraction(radius, 1_000_000) for radius in LOCAL_RADII[:-1]]
    local2 = [int((LOCAL_SHARE * radius * steps_a_metre) ** 2) for radius in radii]
    return ClassLimits(int((Fraction(repr(REACH)) * steps_a_metre) ** 2), np.array(local2, np.int64))


def voxel_classes(
    key: int,
    local: NDArray[np.int32],
    models: Collection[str],
    spool: Spool,
    max_neighbours: int,
    codes: range = ALL_CODES,
) -> Classes:
    """Compute the class of each point of a voxel; equal points have the same class.

    local: (n, 3) [voxel steps], n >= 1.
    max_neighbours: limit of points around the queried points in memory. Larger queries are split
    down to MIN_TOGETHER points.
    codes: for a voxel that is built in parts, the Morton codes of the queried part; `local` holds
    all points with these codes.
    """
    _, first, back = np.unique(voxel_codes(local), return_index=True, return_inverse=True)
    own = local[first]  # in Morton order: a contiguous range is a region of space
    limits = class_limits(spool.lattice.step)
    reach = math.isqrt(limits.reach2)
    found = np.empty(len(own), np.uint8)
    parts = [(0, len(own))]
    while parts:
        begin, end = parts.pop()
        asked = own[begin:end]
        box = np.stack([asked.min(axis=0) - reach, asked.max(axis=0) + reach]).astype(np.int64)
        most = max_neighbours if end - begin > MIN_TOGETHER else None
        near = _points_near(chain([own[:begin], own[end:]], _around(key, box, spool, codes)), box, most)
        if near is None:
            middle = (begin + end) // 2
            parts += [(begin, middle), (middle, end)]
        else:
            found[begin:end] = _classify(asked, near, limits)
    stored = np.uint8((RIM_BIT - 1 if "local" in models else 0) | (RIM_BIT if "border" in models else 0))
    return Classes((found & stored)[back], int(np.count_nonzero(found[back] & TOO_FEW_NEIGHBOURS)))


def _points_near(
    around: Iterable[NDArray[np.int32]], box: NDArray[np.int64], most: int | None
) -> NDArray[np.int32] | None:
    """Return the points (m, 3) of several sets that lie in a box (2, 3); None if too many do.

    most: largest number returned; None: no limit.
    """
    held = 0
    found: list[NDArray[np.int32]] = []
    for points in around:
        inside = _inside(points, box)
        held += len(inside)
        if most is not None and held > most:
            return None
        found.append(inside)
    return np.concatenate(found)


def _inside(points: NDArray[np.int32], box: NDArray[np.int64]) -> NDArray[np.int32]:
    """Return the points (n, 3) that lie in a box (2, 3), corners inclusive."""
    return points[((points >= box[0]) & (points <= box[1])).all(axis=1)]


def _around(key: int, box: NDArray[np.int64], spool: Spool, codes: range) -> Iterator[NDArray[np.int32]]:
    """Yield the distinct points of all voxels in a box.

    Points of this voxel with codes in `codes` are left out. Points and box are in the frame of the
    voxel `key`. Yields disjoint sets (m, 3).
    """
    steps = spool.lattice.voxel_steps
    home = voxel_coordinates(np.array([key], np.uint64))[0]
    low = np.maximum(home + box[0] // steps, -KEY_BIAS)
    high = np.minimum(home + box[1] // steps, KEY_BIAS - 1)
    if math.prod((high - low + 1).tolist()) < len(spool.keys):
        axes = (np.arange(a, b + 1) for a, b in zip(low, high, strict=True))
        keys = voxel_keys(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3))
        at = np.minimum(np.searchsorted(spool.keys, keys), len(spool.keys) - 1)
        keys = keys[spool.keys[at] == keys]
    else:  # small voxels: fewer voxels exist than fit in the box
        voxels = voxel_coordinates(spool.keys)
        keys = spool.keys[((voxels >= low) & (voxels <= high)).all(axis=1)]
    for other in keys.tolist():
        if other == key and codes == ALL_CODES:
            continue
        shift = (voxel_coordinates(np.array([other], np.uint64))[0] - home) * steps
        without = codes if other == key else range(0)
        for points in _points_in(other, box - shift, spool, without):
            found, distinct = np.unique(voxel_codes(points), return_index=True)
            distinct = distinct[(found < without.start) | (found >= without.stop)]
            yield (points[distinct] + shift).astype(np.int32)


def _points_in(key: int, box: NDArray[np.int64], spool: Spool, without: range) -> Iterator[NDArray[np.int32]]:
    """Yield the points of a voxel in a box, as one set (m, 3) for each cube of its octree.

    Points and box are in the voxel's frame. Cubes of at most READ_POINTS points are read. A lattice
    position with more points yields one point without reading any, because only distinct points are
    needed. Cubes whose codes all lie in `without` are skipped; other cubes may still yield points
    with these codes.
    """
    root = int(spool.lattice.voxel_steps - 1).bit_length()
    waiting = [(0, root, np.zeros(3, np.int64))]
    while waiting:
        code, log2, low = waiting.pop()
        if (box[1] < low).any() or (box[0] >= low + (1 << log2)).any():
            continue
        past = code + (1 << 3 * log2)
        if without.start <= code and past <= without.stop:
            continue
        whole = log2 == root
        count = spool.count(key) if whole else spool.block_count(key, code, past)
        if count > READ_POINTS and log2 == 0:
            yield low[None].astype(np.int32)
        elif count > READ_POINTS:
            half = log2 - 1
            waiting += [
                (
                    code + (octant << 3 * half),
                    half,
                    low + ((np.array([octant, octant >> 1, octant >> 2]) & 1) << half),
                )
                for octant in range(8)
            ]
        elif count:
            parts = spool.rows(key) if whole else spool.block_rows(key, code, past)
            yield np.concatenate([_inside(rows["local"], box) for rows in parts])


def _classify(asked: NDArray[np.int32], near: NDArray[np.int32], limits: ClassLimits) -> NDArray[np.uint8]:
    """Compute the classes (q,) of points, including the TOO_FEW_NEIGHBOURS bit.

    The neighbours are the points themselves and points nearby.
    asked: (q, 3).  near: (m, 3).  All points are distinct.
    """
    points = np.concatenate([asked, near])
    points -= points.min(axis=0)
    # A voxel with its surroundings may need more bits than a code has. The order only has to keep
    # neighbours close.
    shift = max(0, int(points.max()).bit_length() - CODE_BITS)
    order = np.argsort(voxel_codes(points >> shift), kind="stable")
    points = points[order]
    rows = np.where(order < len(asked), order, -1).astype(np.int32)
    starts = box_starts(len(points))
    classes = np.empty(len(asked), np.uint8)
    point_classes(points, bound_boxes(points, starts), starts, rows, *limits, classes)
    return classes
