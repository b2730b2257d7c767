"""Avatar: the user's body as spheres, with their hierarchy (avatar_tree.py)."""

from itertools import pairwise
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
from .avatar_tree import bound_nodes, mean_spacing, pack_points

# Largest front of a filled mesh, most of whose nodes are inside. With 256, `distance` takes 1.2
# times as long near a scan, and `collide` 0.8 to 1.2 times (bench_engine, `filled`).
FILLED_FRONT = 32


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
    if not len(array):
        nodes, blocks = np.empty(0, np.int32), np.empty((0, 3, LANES))
        empty = Avatar(np.empty((0, 3)), np.empty(0), nodes, nodes, blocks, np.empty((4, 0)), 0, 0)
        return _model(array, float(radius or 0.0), empty, np.empty((0, LANES), np.int32), 0.0, 0)
    tree = pack_points(array)
    if radius is None:
        radius = mean_spacing(tree) / 2
        if radius == 0.0:
            raise BadRequestError(
                "avatar of a single distinct point has no closest-point distance: give a radius"
            )
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
        np.ascontiguousarray(array[rows].transpose(0, 2, 1)),
        # `concatenate` may return another memory order, and numba would recompile every kernel.
        np.ascontiguousarray(np.concatenate([center[front].T, node_radius[None, front]])),
        front.start,
        inner_points,
    )
    bounding_radius = float(node_radius[0]) + float(radius)
    return _model(array, float(radius), arrays, rows, bounding_radius, inner_points)


def _model(
    points: NDArray[np.float64],
    radius: float,
    arrays: Avatar,
    rows: NDArray[np.int32],
    bounding_radius: float,
    inner_points: int,
) -> AvatarModel:
    """Return the model with these fields."""
    points = np.ascontiguousarray(points)
    box = np.array([points.min(axis=0), points.max(axis=0)]) if len(points) else np.zeros((2, 3))
    reference = refer_to_avatar(arrays, rows, len(points) - inner_points, points, radius, box)
    return AvatarModel(points, radius, arrays, rows, bounding_radius, box, reference, inner_points)
