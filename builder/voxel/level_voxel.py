"""Level of detail of a voxel: its representatives in a hierarchy that encloses all its points.

schemas/archive/level.py defines a level.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.codec import DecompressedRecord
from ...schemas.archive.level import LEVEL_COLUMNS
from ...schemas.archive.voxel import MAX_LEAF, VoxelData, link_nodes, top_shift
from ...schemas.archive.voxel_grid import voxel_keys
from ..config import BuildConfig
from ..kernels.points.octree_cells import voxel_codes
from ..kernels.points.representatives import Runs, choose_representatives, empty_runs, enclose_runs
from ..kernels.points.voxel_records import link_parents
from ..kernels.trees.bounding_sphere import ceil_sqrt
from .record_points import leaves_of, read_columns, voxel_points
from .voxel_octree import VoxelPoints, build_voxel

# Greatest stored radius, in a node's unit.
_MAX_RADIUS = (1 << 16) - 1


def _kept(record: DecompressedRecord) -> list[str]:
    """Return the columns of a record that its level has too."""
    return [name for name in LEVEL_COLUMNS if name in (record.dtype.names or ())]


class LevelVoxel(NamedTuple):
    """Voxel of a level. low, high: (3,) int64, bounds of its representatives [its own steps]."""

    voxel: VoxelData
    low: NDArray[np.int64]
    high: NDArray[np.int64]


def level_voxels(
    record: DecompressedRecord,
    coordinate: NDArray[np.int64],
    halvings: int,
    squares: NDArray[np.int64],
    config: BuildConfig,
) -> list[LevelVoxel]:
    """Make the voxels of the level of one voxel, in ascending order of their keys.

    record: with LEVEL_COLUMNS, if the archive has them.
    coordinate: (3,) of the voxel.  halvings: how often its edge is halved for the level.
    squares: `squared_covers` of the lattice.
    """
    made = _level_voxels(record, coordinate, halvings, squares, config)
    if made is None:
        # A radius beyond 16 bits takes representatives in opposite corners of a cell whose runs end
        # in others. Without covers, the bounds are those of ordinary voxels, which fit.
        made = _level_voxels(record, coordinate, halvings, squares[:1] * 0, config)
    assert made is not None
    return made


def _level_voxels(
    record: DecompressedRecord,
    coordinate: NDArray[np.int64],
    halvings: int,
    squares: NDArray[np.int64],
    config: BuildConfig,
) -> list[LevelVoxel] | None:
    """Make the voxels of a level; return None if a radius exceeds what can be stored."""
    leaves, steps = leaves_of(record), record.voxel_steps >> halvings
    # Few leaf nodes are divided, in sparse voxels.
    room = empty_runs(record.leaves + MAX_LEAF)
    found = choose_representatives(leaves, squares, room)
    if found < 0:
        room = empty_runs(record.shape.point_rows + MAX_LEAF)
        found = choose_representatives(leaves, squares, room)
    runs = Runs._make(column[:found] for column in room)
    parts = (coordinate << halvings) + runs.xyz // steps
    keys = voxel_keys(parts)
    made = []
    for key in np.unique(keys).tolist():
        which = np.flatnonzero(keys == key) if halvings else np.arange(found)
        corner = parts[which[0]] * steps - coordinate * record.voxel_steps
        own = Runs._make(np.ascontiguousarray(column[which]) for column in runs)
        voxel = _enclosing_voxel(record, own, corner, key, steps, config)
        if voxel is None:
            return None
        made.append(voxel)
    return made


def _enclosing_voxel(
    record: DecompressedRecord,
    runs: Runs,
    corner: NDArray[np.int64],
    key: int,
    steps: int,
    config: BuildConfig,
) -> LevelVoxel | None:
    """Build a voxel of a level and enlarge its bounds; return None if a radius exceeds 16 bits.

    record, runs: of the voxel of the archive.  corner: (3,) of the level's voxel in it.  steps: the
    edge of the level's voxel.
    """
    # Of representatives at one position, the one of the largest cover radius remains.
    within = (runs.xyz - corner).astype(np.int32)
    codes = voxel_codes(within)
    order = np.lexsort((-runs.classes.astype(np.int16), codes))
    first = order[np.append(True, codes[order[1:]] != codes[order[:-1]])]
    local, places = np.ascontiguousarray(within[first]), codes[first]
    leaves = leaves_of(record)
    rows = leaves.first[runs.node[first]].astype(np.int64) + runs.chosen[first]
    points = VoxelPoints(local, radius_class=runs.classes[first], **read_columns(record, _kept(record), rows))
    voxel = build_voxel(key, points, steps, config)
    links = link_nodes(voxel)
    stored = voxel_points(voxel, links)
    leaf = np.flatnonzero(links.is_leaf)
    leaf = leaf[np.argsort(links.first[leaf], kind="stable")]
    above = np.empty(len(places), np.int32)  # of each representative in the order of `places`
    held = np.repeat(leaf, voxel.nodes.count[leaf].astype(np.int64))
    above[np.searchsorted(places, voxel_codes(stored.astype(np.int32)))] = held
    nodes, unit = voxel.nodes, np.where(links.cell < 0, 1 << top_shift(steps), 1)
    low = np.where((links.cell < 0)[:, None], 0, voxel.cells.low[np.maximum(links.cell, 0)])
    reach2, slab = np.zeros(len(unit), np.int64), nodes.slab.astype(np.int64)
    enclose_runs(
        leaves,
        runs,
        above[np.searchsorted(places, codes)],
        link_parents(links.first, nodes.count, links.is_leaf),
        corner + low + nodes.center.astype(np.int64) * unit[:, None],
        nodes.normal.astype(np.int64),
        reach2,
        slab,
    )
    radius = -(-np.array([int(ceil_sqrt(square)) for square in reach2]) // unit)
    if int(radius.max()) > _MAX_RADIUS:
        return None
    nodes = nodes._replace(radius=radius.astype(np.uint16), slab=slab.astype(np.int32))
    least, most = (edge(local, axis=0).astype(np.int64) for edge in (np.min, np.max))
    return LevelVoxel(voxel._replace(nodes=nodes), least, most)
