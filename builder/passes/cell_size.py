"""Choice of `cell_points` for a requested number of leaf cells (`--leaf-cells`).

[Fig12] section 7 states the number of its octree's leaf cells, 4,096, not their size. The number of
cells falls as the permitted number of points in a cell grows. One traversal of the octree gives the
number for every limit (`count_capacities`). The choice depends on the points and the options alone.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.voxel import CELL_BITS
from ...schemas.runtime.interrupts import check_interrupt
from .. import build_limits
from ..config import MAX_CELL_POINTS, BuildConfig
from ..kernels.points.octree_cells import count_capacities, is_ascending, voxel_codes
from ..resume.transaction import Transaction
from ..spool.spool import Spool
from ..voxel.balance_cells import balance_cells, tree_limits
from ..voxel.dense_voxel import Cube
from .build_shards import plan_shards


class CellCounts(NamedTuple):
    """Number of leaf cells as a function of the limit on their points.

    limits: (k,) int64, ascending, from 1 (balanced cells: from the points of a leaf node).
    changes: (k,) int64. The number of cells at limits[i] is changes[0] + ... + changes[i], and it
    does not change before limits[i + 1].
    """

    limits: NDArray[np.int64]
    changes: NDArray[np.int64]


class _Unit(NamedTuple):
    """Voxels whose cells are counted. points: their total."""

    keys: tuple[int, ...]
    points: int
    spool: Spool
    config: BuildConfig


def choose_cell_points(spool: Spool, build: Transaction) -> int:
    """Return the `cell_points` with which the number of leaf cells is nearest to `leaf_cells`.

    Of two numbers equally near, the greater is chosen; of limits that give the same cells, the
    least. The options are those of `build`; `leaf_cells` is not None.
    """
    assert build.config.leaf_cells is not None
    units = [
        _Unit(keys, points, spool, build.config) for keys, points in plan_shards(spool.keys, spool.counts)
    ]
    with build.stage("cells", sum(unit.points for unit in units), "points"):
        counts = add_counts(build.run(_count_unit, units))
    return nearest_limit(counts, build.config.leaf_cells)


def nearest_limit(counts: CellCounts, cells: int) -> int:
    """Return the least limit, at most MAX_CELL_POINTS, whose number of cells is nearest to `cells`."""
    permitted = max(1, int(np.searchsorted(counts.limits, MAX_CELL_POINTS, side="right")))
    return int(counts.limits[np.argmin(np.abs(np.cumsum(counts.changes[:permitted]) - cells))])


def add_counts(parts: list[CellCounts]) -> CellCounts:
    """Return the counts of all parts together."""
    limits, where = np.unique(np.concatenate([part.limits for part in parts]), return_inverse=True)
    changes = np.zeros(len(limits), np.int64)
    np.add.at(changes, where, np.concatenate([part.changes for part in parts]))
    return CellCounts(limits, changes)


def _count_unit(unit: _Unit) -> CellCounts:
    """Count the cells of some voxels."""
    parts = []
    for key in unit.keys:
        check_interrupt()
        if unit.config.cells == "balanced":
            parts.append(count_balanced(unit.spool, key, unit.config))
        else:
            parts += count_octree(unit.spool, key)
    return add_counts(parts)


def count_octree(spool: Spool, key: int) -> list[CellCounts]:
    """Count the octree's leaf cells in a voxel, part by part.

    Memory holds one cube of at most DENSE_POINTS points.
    """
    found, changes = [], list[tuple[int, int]]()
    # Each cube with the number of points of the cube around it; 0 if that cube is always split.
    root = Cube(0, int(spool.lattice.voxel_steps - 1).bit_length(), spool.count(key))
    waiting = [(root, 0)]
    while waiting:
        cube, above = waiting.pop()
        if cube.log2 <= CELL_BITS:
            changes += [(1 if cube.log2 == 0 else cube.points, 1)] + ([(above, -1)] if above else [])
        if cube.log2 == 0:
            continue
        if cube.points > build_limits.DENSE_POINTS:
            edge, above = 1 << 3 * (cube.log2 - 1), cube.points if cube.log2 <= CELL_BITS else 0
            for code in range(cube.code, cube.code_end, edge):
                if held := spool.block_count(key, code, code + edge):
                    waiting.append((Cube(code, cube.log2 - 1, held), above))
            continue
        inside = count_capacities(_sorted_codes(spool, key, cube), cube.log2, CELL_BITS)
        limits = np.flatnonzero(inside)
        found.append(CellCounts(limits, inside[limits]))
    limits, steps = np.array(changes, np.int64).reshape(-1, 2).T
    return [*found, CellCounts(limits, steps)]


def count_balanced(spool: Spool, key: int, config: BuildConfig) -> CellCounts:
    """Count the balanced cells of a voxel for each height of their trees."""
    root = Cube(0, int(spool.lattice.voxel_steps - 1).bit_length(), spool.count(key))
    codes = _sorted_codes(spool, key, root)
    limits, cells, most = list[int](), list[int](), 0
    while most < len(codes):
        most = config.leaf * config.degree ** len(limits)
        fewest, _ = tree_limits(most, config.leaf, config.degree)
        limits.append(most)
        cells.append(len(balance_cells(codes, root.log2, CELL_BITS, fewest, most)[1]))
    changes = np.array(cells, np.int64)
    changes[1:] -= changes[:-1].copy()
    return CellCounts(np.array(limits, np.int64), changes)


def _sorted_codes(spool: Spool, key: int, cube: Cube) -> NDArray[np.uint64]:
    """Return the Morton codes of the points in a cube of a voxel, ascending."""
    parts = spool.block_rows(key, cube.code, cube.code_end)
    codes = np.concatenate([voxel_codes(np.ascontiguousarray(part["local"])) for part in parts])
    if not is_ascending(codes):
        codes.sort(kind="stable")  # merges the ascending runs
    return codes
