"""Level of detail of a voxel: its representatives in a hierarchy that encloses all its points.

schemas/archive/level.py defines a level.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.codec import DecompressedRecord
from ...schemas.archive.voxel import MAX_LEAF, VoxelData, link_nodes, top_shift
from ..config import BuildConfig
from ..kernels.points.octree_cells import voxel_codes
from ..kernels.points.representatives import Runs, choose_representatives, empty_runs, enclose_runs
from ..kernels.points.voxel_records import link_parents
from ..kernels.trees.bounding_sphere import ceil_sqrt
from .record_points import leaves_of, voxel_points
from .voxel_octree import VoxelPoints, build_voxel

# Greatest stored radius, in a node's unit.
_MAX_RADIUS = (1 << 16) - 1


class LevelVoxel(NamedTuple):
    """Voxel of a level. low, high: (3,) int64, bounds of its representatives [voxel steps]."""

    voxel: VoxelData
    low: NDArray[np.int64]
    high: NDArray[np.int64]


def level_voxel(record: DecompressedRecord, squares: NDArray[np.int64], config: BuildConfig) -> LevelVoxel:
    """Make the level of one voxel. squares: `squared_covers` of the lattice."""
    made = _level_voxel(record, squares, config)
    # A radius beyond 16 bits takes representatives in opposite corners of a cell whose runs end in
    # others. Without covers, the bounds are those of an ordinary voxel, which fit.
    return made if made is not None else _require(_level_voxel(record, squares[:1] * 0, config))


def _require(made: LevelVoxel | None) -> LevelVoxel:
    assert made is not None
    return made


def _level_voxel(
    record: DecompressedRecord, squares: NDArray[np.int64], config: BuildConfig
) -> LevelVoxel | None:
    """Make the level of one voxel; return None if a radius exceeds what can be stored."""
    leaves = leaves_of(record)
    # Few leaf nodes are divided, in sparse voxels.
    room = empty_runs(record.leaves + MAX_LEAF)
    found = choose_representatives(leaves, squares, room)
    if found < 0:
        room = empty_runs(record.shape.point_rows + MAX_LEAF)
        found = choose_representatives(leaves, squares, room)
    runs = Runs._make(np.ascontiguousarray(column[:found]) for column in room)
    # Of representatives at one position, the one of the largest cover radius remains.
    codes = voxel_codes(runs.xyz)
    order = np.lexsort((-runs.classes.astype(np.int16), codes))
    first = order[np.append(True, codes[order[1:]] != codes[order[:-1]])]
    local, places = np.ascontiguousarray(runs.xyz[first]), codes[first]
    points = VoxelPoints(local, radius_class=runs.classes[first])
    voxel = build_voxel(record.key, points, record.voxel_steps, config)
    links = link_nodes(voxel)
    stored = voxel_points(voxel, links)
    leaf = np.flatnonzero(links.is_leaf)
    leaf = leaf[np.argsort(links.first[leaf], kind="stable")]
    above = np.empty(len(places), np.int32)  # of each representative in the order of `places`
    held = np.repeat(leaf, voxel.nodes.count[leaf].astype(np.int64))
    above[np.searchsorted(places, voxel_codes(stored.astype(np.int32)))] = held
    nodes, unit = voxel.nodes, np.where(links.cell < 0, 1 << top_shift(record.voxel_steps), 1)
    corner = np.where((links.cell < 0)[:, None], 0, voxel.cells.low[np.maximum(links.cell, 0)])
    centers = corner + nodes.center.astype(np.int64) * unit[:, None]
    reach2, slab = np.zeros(len(unit), np.int64), nodes.slab.astype(np.int64)
    parents = link_parents(links.first, nodes.count, links.is_leaf)
    enclose_runs(
        leaves,
        runs,
        above[np.searchsorted(places, codes)],
        parents,
        centers,
        nodes.normal.astype(np.int64),
        reach2,
        slab,
    )
    radius = -(-np.array([int(ceil_sqrt(square)) for square in reach2]) // unit)
    if int(radius.max()) > _MAX_RADIUS:
        return None
    nodes = nodes._replace(radius=radius.astype(np.uint16), slab=slab.astype(np.int32))
    low, high = (edge(local, axis=0).astype(np.int64) for edge in (np.min, np.max))
    return LevelVoxel(voxel._replace(nodes=nodes), low, high)
