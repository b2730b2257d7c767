"""Avatar: the user's body as spheres, with their hierarchy and mean spacing. numpy alone: nothing is compiled.

[Fig12] section 5: all leaf nodes on one level, each point in one of them. The tree is packed from the
top (Lee and Lee, "OMT: Overlap minimizing top-down bulk loading", 2003), as a voxel's trees are
(builder/kernels/trees/pack_tree.py): split along the longest edge, at a multiple of the leaf size,
until every part is one child. All nodes of a level are split together, by a sort of all points.

The centre of a sphere comes from Badoiu and Clarkson's iteration ("Smaller core-sets for balls",
2003): step toward the farthest point by 1 / (i + 4), from the centre of the box. Its radius is that
of the points around the stored integers, rounded up, so that it encloses them whatever the centre.
"""

import math
from collections.abc import Iterator
from itertools import chain, pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...schemas.archive.voxel_grid import MAX_COORDINATE
from ...schemas.errors import BadRequestError
from ...schemas.wire.requests import make_positions
from ...schemas.wire.scene_messages import AvatarInfo
from ..kernels.core.array_references import refer_to_avatar
from ..kernels.core.placed_avatar import MAX_FRONT, Avatar
from ..kernels.core.scene_arrays import LANES

_Integers = NDArray[np.int64]
_Floats = NDArray[np.float64]

# Children per node; as for voxels, see BuildConfig.degree.
DEGREE = 8
# The lattice of an avatar is never finer than this: 1 micrometre.
FINEST_STEP = 2.0**-20
# Most lattice steps that an avatar spans: squared distances of three axes are exact in float64.
MAX_STEPS = 1 << 22
# Bits of a coordinate, and of the number of a point (MAX_AVATAR_POINTS). A key of a sort holds the
# number of a run too.
_COORDINATE_BITS, _POINT_BITS = 23, 20
# Steps of the iteration for a centre: more for the small nodes, which queries test often.
_SMALL_NODE, _SMALL_STEPS, _LARGE_STEPS = 256, 32, 8
# Pairs of points, or of leaf nodes, that are examined at a time.
_PAIRS = 1 << 18
# Largest front of a filled mesh, most of whose nodes are inside. With 256, `distance` takes 1.2
# times as long near a scan, and `collide` 0.8 to 1.2 times (bench_engine, `filled`).
FILLED_FRONT = 32
# Arrays of an avatar without points.
_NO_NODES = np.empty(0, np.int32)
_EMPTY = Avatar(
    np.empty((0, 3)), np.empty(0), _NO_NODES, _NO_NODES, np.empty((0, 3, LANES)), np.empty((4, 0)), 0, 0
)


class AvatarTree(NamedTuple):
    """Tree of points on their own lattice: world = low + steps * step.

    steps: (n, 3) float64, whole numbers, in the order of the leaf nodes.  order: (n,), their rows.
    levels: from the root to the leaf nodes, the first point of each node of a level, and n.
    """

    steps: _Floats
    order: _Integers
    levels: list[_Integers]
    low: _Floats
    step: float


class AvatarModel(NamedTuple):
    """Avatar with its sphere hierarchy.

    points: (n, 3) float64, avatar frame [m], as given.  radius: of each point's sphere [m].
    arrays: arrays that the kernels read.
    rows: (b, LANES) int32, the row of `points` in each lane of a block.
    bounding_radius: of a sphere that encloses all spheres of the avatar [m].
    box: (2, 3) around its points [m]; zeros if it has none.
    reference: `AvatarReference` to these arrays, for kernels that are called once a pose.
    inner_points: number of the points inside, the last ones.
    digest: `avatar_digest` of an avatar that a client added; empty for an avatar of the scene file.
    """

    points: NDArray[np.float64]
    radius: float
    arrays: Avatar
    rows: NDArray[np.int32]
    bounding_radius: float
    box: NDArray[np.float64]
    reference: Any
    inner_points: int = 0
    digest: bytes = b""


def describe_avatar(name: str, model: AvatarModel, description: str = "") -> AvatarInfo:
    """Return the description of an avatar. description: of its source, see `AvatarInfo`."""
    return AvatarInfo(
        name, len(model.points), model.radius, model.bounding_radius, model.inner_points, description
    )


def make_avatar(points: ArrayLike, radius: float | None = None, inner_points: int = 0) -> AvatarModel:
    """Build an avatar from points (n, 3), avatar frame [m]. One without points touches nothing.

    inner_points: number of them inside, the last ones; fewer than n.
    radius: of every point's sphere [m], zero or more; None: half the mean closest-point distance
    ([Fig12] section 7) of the distinct points, rounded to a lattice of 2^-20 m. A single distinct
    point needs a radius. Raise BadRequestError.
    """
    array = make_positions(points).copy()  # the caller may still write into the original
    if len(array) and np.abs(array).max() > MAX_COORDINATE:
        raise BadRequestError(
            f"avatar coordinate {np.abs(array).max():g} m: expected within {MAX_COORDINATE:g} m"
        )
    if radius is not None and not (np.isfinite(radius) and radius >= 0):
        raise BadRequestError(f"avatar radius {radius!r}: expected zero or a positive length in metres")
    rows = np.empty((0, LANES), np.int32)
    arrays, bounding_radius, box = _EMPTY, 0.0, np.zeros((2, 3))
    if len(array):
        tree = pack_points(array)
        if radius is None:
            radius = mean_spacing(tree) / 2
            if radius == 0.0:
                raise BadRequestError(
                    "avatar of a single distinct point has no closest-point distance: give a radius"
                )
        arrays, rows = _lay_out(tree, array, inner_points)
        bounding_radius = float(arrays.radius[0]) + float(radius)
        box = np.array([array.min(axis=0), array.max(axis=0)])
    radius = float(radius or 0.0)
    reference = refer_to_avatar(arrays, rows, len(array) - inner_points, array, radius, box)
    return AvatarModel(array, radius, arrays, rows, bounding_radius, box, reference, inner_points)


def _lay_out(tree: AvatarTree, points: _Floats, inner_points: int) -> tuple[Avatar, NDArray[np.int32]]:
    """Return the arrays of a tree, and the row of `points` (n, 3) in each lane of a block."""
    center, node_radius = bound_nodes(tree)
    # Rounding moves a point by less than sqrt(3) lattice steps. Two more steps in the radius
    # therefore enclose the given points, including the rounding of these sums.
    center, node_radius = tree.low + center * tree.step, (node_radius + 2) * tree.step
    sizes = np.array([len(starts) - 1 for starts in tree.levels])
    begins = np.concatenate([[0], np.cumsum(sizes)])
    children = [np.searchsorted(below, above) for above, below in pairwise(tree.levels)]
    first = [begin + each[:-1] for begin, each in zip(begins[1:], children, strict=False)]
    counts = [np.diff(each) for each in (*children, tree.levels[-1])]
    # Unused lanes of a block repeat its last point.
    lane = tree.levels[-1][:-1, None] + np.minimum(np.arange(LANES), counts[-1][:, None] - 1)
    rows = np.ascontiguousarray(tree.order[lane], np.int32)
    # The flat list of nodes is the deepest level that fits: the leaf nodes, up to some 8,000
    # points.
    level = int(np.flatnonzero(sizes <= (FILLED_FRONT if inner_points else MAX_FRONT))[-1])
    front = slice(int(begins[level]), int(begins[level + 1]))
    arrays = Avatar(
        center,
        node_radius,
        np.concatenate([*first, ~np.arange(sizes[-1])]).astype(np.int32),
        np.concatenate(counts).astype(np.int32),
        np.ascontiguousarray(points[rows].transpose(0, 2, 1)),
        # `concatenate` may return another memory order, and numba would recompile every kernel.
        np.ascontiguousarray(np.concatenate([center[front].T, node_radius[None, front]])),
        front.start,
        inner_points,
    )
    return arrays, rows


def pack_points(points: _Floats) -> AvatarTree:
    """Pack points (n, 3) [m], n >= 1, into a tree with at most LANES points in a leaf node.

    The step is 2^-20 m, or the power of two that the extent of the points requires. Points are
    rounded down to the lattice. Each therefore lies less than two steps (sqrt(3) of them) from its
    lattice point.
    """
    low = points.min(axis=0)
    extent = float((points.max(axis=0) - low).max())
    step = max(FINEST_STEP, 2.0 ** math.ceil(math.log2(extent / MAX_STEPS))) if extent > 0 else FINEST_STEP
    return _pack(np.floor((points - low) / step), low, step)


def _pack(steps: _Floats, low: _Floats, step: float) -> AvatarTree:
    """Pack points (n, 3) of a lattice."""
    order, starts = np.arange(len(steps)), np.array([0, len(steps)])
    levels, capacity = [starts], 1  # capacity: most leaf nodes below a node of this level
    while capacity * LANES < len(steps):
        capacity *= DEGREE
    while capacity > 1:
        capacity //= DEGREE
        leaves = -(-np.diff(starts) // LANES)
        parts = -(-leaves // capacity)
        while (parts > 1).any():  # halve the runs of several parts
            order = _sort_runs(steps, order, starts)
            left = parts // 2
            middle = starts[:-1] + leaves * left // parts * LANES
            both = np.stack([left, parts - left], axis=1)
            begins = np.stack([starts[:-1], middle], axis=1)[both > 0]
            starts, parts = np.append(begins, len(steps)), both[both > 0]
            leaves = -(-np.diff(starts) // LANES)
        levels.append(starts)
    return AvatarTree(steps[order], order, levels, low, step)


def _sort_runs(steps: _Floats, order: _Integers, starts: _Integers) -> _Integers:
    """Sort each run of points along the longest edge of its box, ties by number; return the order."""
    own, begins = steps[order].astype(np.int64), starts[:-1]
    edges = np.maximum.reduceat(own, begins) - np.minimum.reduceat(own, begins)
    runs = np.repeat(np.arange(len(begins)), np.diff(starts))
    along = own[np.arange(len(own)), edges.argmax(axis=1)[runs]]
    keys = (runs << _COORDINATE_BITS | along) << _POINT_BITS | order
    keys.sort()
    return keys & ((1 << _POINT_BITS) - 1)


def bound_nodes(tree: AvatarTree) -> tuple[_Floats, _Floats]:
    """Return centre (t, 3) and radius (t,) of the sphere of each node [steps], level by level."""
    spheres = [_bound_level(tree.steps, starts) for starts in tree.levels]
    centers, radii = zip(*spheres, strict=True)
    return np.concatenate(centers), np.concatenate(radii)


def _bound_level(steps: _Floats, starts: _Integers) -> tuple[_Floats, _Floats]:
    """Return centre (s, 3) and radius (s,) of the spheres around the points of a level's nodes."""
    begins, sizes = starts[:-1], np.diff(starts)
    center = (np.minimum.reduceat(steps, begins) + np.maximum.reduceat(steps, begins)) / 2
    narrow = np.ascontiguousarray(steps.T, np.float32)
    for number in range(_SMALL_STEPS if sizes.max() <= _SMALL_NODE else _LARGE_STEPS):
        squares = _squares(narrow, center.T.astype(np.float32), sizes)
        most = np.repeat(np.maximum.reduceat(squares, begins), sizes)
        at = np.flatnonzero(squares == most)
        farthest = at[np.searchsorted(at, begins)]
        center += (steps[farthest] - center) / (number + 4)
    center = np.rint(center)
    square = np.maximum.reduceat(_squares(steps.T, center.T, sizes), begins)
    radius = np.ceil(np.sqrt(square))
    return center, radius + (radius * radius < square)


def _squares(points: NDArray, centers: NDArray, sizes: _Integers) -> NDArray:
    """Return the squared distances (n,) of points (3, n) from the centres (3, s) of their runs."""
    apart = [own - np.repeat(center, sizes) for own, center in zip(points, centers, strict=True)]
    return np.asarray(apart[0] * apart[0] + apart[1] * apart[1] + apart[2] * apart[2])


def mean_spacing(tree: AvatarTree) -> float:
    """Return the mean distance of distinct points from their closest ones [m]; 0 for fewer than two."""
    ordered = tree.steps[np.lexsort(tree.steps.T)]
    is_first = np.append(True, (ordered[1:] != ordered[:-1]).any(axis=1))
    if not is_first.all():
        tree = _pack(ordered[is_first], tree.low, tree.step)
    if len(tree.steps) < 2:
        return 0.0
    distances = np.sqrt(_closest_squares(tree)) * tree.step
    # Sum in pieces: math.fsum of the whole array would hold the interpreter lock for 50 ms with
    # 10^6 points.
    pieces = (distances[i : i + 4096].tolist() for i in range(0, len(distances), 4096))
    return math.fsum(chain.from_iterable(pieces)) / len(distances)


def _closest_squares(tree: AvatarTree) -> _Floats:
    """Return the squared distance (n,) of each point from the closest other one, of two or more [steps].

    All points must be distinct. The other points of its leaf node bound the distance of each point;
    then the leaf nodes are searched whose boxes are nearer.
    """
    starts = tree.levels[-1]
    lanes = starts[:-1, None] + np.minimum(np.arange(LANES), np.diff(starts)[:, None] - 1)
    best = np.empty(len(tree.steps))
    for at in range(0, len(lanes), _PAIRS // LANES**2):
        rows = lanes[at : at + _PAIRS // LANES**2]
        own = tree.steps[rows]
        squares = np.square(own[:, :, None] - own[:, None]).sum(axis=3)
        best[rows] = np.where(squares > 0, squares, np.inf).min(axis=2)
    low, high = np.minimum.reduceat(tree.steps, starts[:-1]), np.maximum.reduceat(tree.steps, starts[:-1])
    for leaf, other in _near_leaves(tree, best):
        sizes = np.diff(starts)[leaf]
        point = np.repeat(starts[leaf] - np.cumsum(sizes) + sizes, sizes) + np.arange(sizes.sum())
        other = np.repeat(other, sizes)
        own = tree.steps[point]
        near = _gaps(own, own, low[other], high[other]) < best[point]
        point, other, own = point[near], other[near], own[near]
        squares = np.zeros((len(own), LANES))
        for k in range(3):
            squares += np.square(own[:, k, None] - tree.steps[:, k][lanes[other]])
        np.minimum.at(best, point, squares.min(axis=1))
    return best


def _near_leaves(tree: AvatarTree, best: _Floats) -> Iterator[tuple[_Integers, _Integers]]:
    """Yield pairs of different leaf nodes, the second of which may hold a point nearer than `best`."""
    boxes = [
        (np.minimum.reduceat(tree.steps, starts[:-1]), np.maximum.reduceat(tree.steps, starts[:-1]))
        for starts in tree.levels
    ]
    reach, (low, high) = np.maximum.reduceat(best, tree.levels[-1][:-1]), boxes[-1]
    waiting = [np.arange(len(low))]
    while waiting:
        leaves = waiting.pop()
        leaf, other = leaves, np.zeros(len(leaves), np.int64)
        for above, starts, (least, most) in zip(tree.levels, tree.levels[1:], boxes[1:], strict=False):
            first = np.searchsorted(starts, above)
            counts = np.diff(first)[other]
            leaf, other = (
                np.repeat(leaf, counts),
                np.repeat(first[other] - np.cumsum(counts) + counts, counts) + np.arange(counts.sum()),
            )
            near = _gaps(low[leaf], high[leaf], least[other], most[other]) < reach[leaf]
            leaf, other = leaf[near], other[near]
            if len(leaf) * LANES > _PAIRS and len(leaves) > 1:
                waiting += np.array_split(leaves, 2)
                break
        else:
            yield leaf[leaf != other], other[leaf != other]


def _gaps(low: _Floats, high: _Floats, least: _Floats, most: _Floats) -> _Floats:
    """Return the squared distances (m,) of boxes low, high from boxes least, most (m, 3)."""
    apart = np.maximum(np.maximum(least - high, low - most), 0.0)
    return np.asarray(np.square(apart).sum(axis=1))
