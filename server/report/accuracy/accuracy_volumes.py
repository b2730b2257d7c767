"""Comparison of bounding volumes, and of points as spheres or cubes, by one plain descent.

[Fig12] reports that its authors first used a cube for each point, as wide as the mean closest-point
distance, and leaves open whether groups of spheres bound tighter than groups of cubes. Both are
measured here in the same way: with the same trees, the same order of descent, and boxes measured
from the points. Only the test of two nodes, or of two points, differs.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....builder.voxel.point_radius import voxel_points
from ....schemas.archive.archive import Archive
from ....schemas.archive.units import UNITS_PER_METRE
from ....schemas.archive.voxel import Links, VoxelData
from ...avatars.avatar_model import AvatarModel
from ...kernels.core.scene_arrays import LANES
from ..kernels.plain_descent import (
    BOX,
    SLAB,
    SPHERE,
    SPHERE_AND_BOX,
    Body,
    Forest,
    box_nodes,
    descend,
    nearest,
)
from ..kernels.plain_pairs import CERTIFIED, CUBES, INTEGERS, Lattice

Floats = NDArray[np.float64]


class Kind(NamedTuple):
    """A way to test nodes and points.

    name: for tables.  node, leaf, sift: see report/kernels/plain_descent.py.
    """

    name: str
    node: int
    leaf: int
    sift: bool = True


VOLUMES = (
    Kind("sphere", SPHERE, CERTIFIED),
    Kind("sphere with slab", SLAB, CERTIFIED),
    Kind("box", BOX, CERTIFIED),
    Kind("box, avatar spheres", SPHERE_AND_BOX, CERTIFIED),
)
# Points as spheres or as cubes, each with its natural bounding volumes, in integers.
PRIMITIVES = (
    Kind("points spheres, nodes spheres with slabs", SLAB, INTEGERS),
    Kind("points spheres, nodes boxes", BOX, INTEGERS),
    Kind("points cubes, nodes boxes", BOX, CUBES),
)


class Plain(NamedTuple):
    """Input of the plain descent. units, reach: r_a + r_b in exact units, and in metres."""

    body: Body
    forest: Forest
    lattice: Lattice
    units: int
    reach: float


class Found(NamedTuple):
    """Answers of one kind. contact: (k,) bool.  node_tests, pair_tests: (k,) int64."""

    contact: NDArray[np.bool_]
    node_tests: NDArray[np.int64]
    pair_tests: NDArray[np.int64]


def make_plain(archive: Archive, avatar: AvatarModel) -> Plain:
    """Convert all voxels of an archive, and an avatar, to the input of the plain descent.

    The scan's points have the archive's radius, and there is no margin.
    """
    header = archive.header
    lattice = Lattice(np.array(header.lattice.origin), header.lattice.step, header.lattice.units_per_step)
    units = round(header.radius * UNITS_PER_METRE) + round(avatar.radius * UNITS_PER_METRE)
    return Plain(_make_body(avatar), make_forest(archive), lattice, units, header.radius + avatar.radius)


def ask(plain: Plain, kind: Kind, poses: Floats) -> Found:
    """Test rigid poses (k, 4, 4) for contact in the way of `kind`."""
    contact, counts = np.zeros(len(poses), bool), np.zeros((2, len(poses)), np.int64)
    descend(
        poses, plain.body, plain.forest, plain.lattice, plain.units, plain.reach, kind.node, kind.leaf,
        kind.sift, contact, counts,
    )  # fmt: skip
    return Found(contact, counts[0], counts[1])


def distances(plain: Plain, kind: Kind, poses: Floats, farthest: float) -> Floats:
    """Return signed distances (k,) [m] by the leaf test of `kind`, at most `farthest`."""
    found = np.empty(len(poses))
    nearest(
        poses, plain.body, plain.forest, plain.lattice, plain.units, plain.reach, farthest, kind.leaf, found
    )
    return found


def _make_body(avatar: AvatarModel) -> Body:
    """Return the avatar's tree with boxes of its points."""
    a = avatar.arrays
    middle, half = _boxes(a.first, a.count, a.points.min(axis=2), a.points.max(axis=2))
    return Body(a.center, a.radius, middle, half, a.first, a.count, a.points)


def _boxes(
    first: NDArray[np.int32], count: NDArray[np.int32], leaf_low: Floats, leaf_high: Floats
) -> tuple[Floats, Floats]:
    """Return centres and half sides (n, 3) of the nodes' boxes.

    They are exact except the last bit, which SLACK covers.
    """
    low, high = np.empty((len(first), 3)), np.empty((len(first), 3))
    box_nodes(first, count, leaf_low, leaf_high, low, high)
    return (low + high) / 2, (high - low) / 2


def make_forest(archive: Archive) -> Forest:
    """Return the hierarchies of all voxels of an archive, concatenated."""
    lattice = archive.header.lattice
    parts: list[Forest] = []
    nodes = blocks = 0
    for row, coordinate in enumerate(archive.coordinates):
        voxel, links = archive.read_voxel(row)
        part = _make_tree(voxel, links, coordinate * lattice.voxel_steps, lattice.step)
        is_leaf = part.first < 0
        first = np.where(is_leaf, part.first - blocks, part.first + nodes).astype(np.int32)
        parts.append(part._replace(first=first, roots=part.roots + nodes))
        nodes, blocks = nodes + len(part.first), blocks + len(part.low)
    return Forest(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _make_tree(voxel: VoxelData, links: Links, corner: NDArray[np.int64], step: float) -> Forest:
    """Return one voxel's hierarchy. corner: (3,), of the voxel, lattice steps."""
    stored = voxel.nodes
    in_cell = links.cell >= 0
    low = np.where(in_cell[:, None], voxel.cells.low[links.cell], 0).astype(np.int64) + corner
    unit = np.where(in_cell, 1, 1 << voxel.top_shift).astype(np.int64)
    center = np.asarray((low + stored.center.astype(np.int64) * unit[:, None]) * step, np.float64)
    # Blocks are numbered in the order of their nodes, as in the arena.
    leaf = np.flatnonzero(links.is_leaf)
    first = links.first.astype(np.int32).copy()
    first[leaf] = ~np.arange(len(leaf), dtype=np.int32)
    block_low = low[leaf] + stored.block_low[leaf]
    count = stored.count[leaf].astype(np.int64)
    rows = links.first[leaf, None] + np.minimum(np.arange(LANES), count[:, None] - 1)
    points = (voxel_points(voxel, links) + corner)[rows]
    steps = (points - block_low[:, None]).astype(np.uint16).transpose(0, 2, 1)
    middle, half = _boxes(
        first, stored.count.astype(np.int32), points.min(axis=1) * step, points.max(axis=1) * step
    )
    normal = stored.normal.astype(np.float64)
    return Forest(
        center,
        np.asarray(stored.radius.astype(np.int64) * unit * step, np.float64),
        normal,
        np.sqrt((normal * normal).sum(axis=1)),
        stored.slab.astype(np.float64) * step,
        middle,
        half,
        first,
        stored.count.astype(np.int32),
        np.zeros(1, np.int64),
        block_low,
        np.ascontiguousarray(steps),
    )
