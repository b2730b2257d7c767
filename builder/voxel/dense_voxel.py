"""Construction of voxels that do not fit in memory.

Such a voxel is built part by part, then ordered and compressed from files.

Whether the octree splits a cell depends on the contents of the cell alone, and every cube of more
than `cell_points` points is split. Cubes that hold few enough points according to the spool can
therefore be built one after the other; they give the same cells as the whole voxel.

The cells are spilled to files in this order. Then the top hierarchy is packed over the cells. In
the order of the top hierarchy, the cells are read once more to bound it and to write the rows of
the record. The resulting voxel equals the one that voxel_octree.py builds of the same points, row for row
(tests/unit/builder/voxel/test_dense_voxel.py); only its frames are compressed as streams.

Memory holds a part of DENSE_POINTS and at most some 300 bytes per cell. All points at one lattice
position form one cell, however many there are. If there are more than a part holds (a heap), only
the nodes are held in memory (coincident_points.py).
"""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.codec import (
    OPTIONAL_COLUMNS,
    point_dtype,
)
from ...schemas.archive.voxel import CELL_BITS
from .. import build_limits
from ..config import BuildConfig
from ..kernels.points.octree_cells import split_octree
from ..spool.spool import Spool
from .coincident_points import heap_place, heap_trees, merge_runs
from .dense_record import CellSpill, RecordLayout
from .voxel_octree import BuiltVoxel, CellTrees, VoxelPoints, build_trees, canonical, gather_voxel

# Maps all points (n, 3) of a voxel whose Morton codes lie in a range, the range, and the number of
# times that each point occurs (a heap passes a single point) to the radius class of each point,
# (n,).
Classify = Callable[[NDArray[np.int32], range, int], NDArray[np.uint8]]


class Cube(NamedTuple):
    """Cube of the octree.

    code: first Morton code of the cube.  log2: log2 of its edge [steps].  points: number of its
    points.
    """

    code: int
    log2: int
    points: int

    @property
    def code_end(self) -> int:
        """Return the first code after the cube."""
        return self.code + (1 << 3 * self.log2)


def plan_parts(spool: Spool, key: int, config: BuildConfig) -> Iterator[list[Cube]]:
    """Cut a voxel into parts, in Morton order.

    A part is either consecutive cubes of together at most DENSE_POINTS points, or one cube that
    cannot be cut further.
    """
    most = max(build_limits.DENSE_POINTS, config.cell_points)
    root = Cube(0, int(spool.lattice.voxel_steps - 1).bit_length(), spool.count(key))
    waiting, part = [root], list[Cube]()
    while waiting:
        cube = waiting.pop()
        if cube.points > most and cube.log2 > 0:
            edge = 1 << 3 * (cube.log2 - 1)
            children = [
                Cube(code, cube.log2 - 1, spool.block_count(key, code, code + edge))
                for code in range(cube.code, cube.code_end, edge)
            ]
            waiting += [child for child in reversed(children) if child.points]
            continue
        if part and sum(c.points for c in part) + cube.points > most:
            yield part
            part = []
        part.append(cube)
    yield part


def build_dense(
    key: int,
    spool: Spool,
    config: BuildConfig,
    archive_id: bytes,
    scratch: Path,
    classify: Classify | None = None,
) -> BuiltVoxel:
    """Build a voxel and its record, as voxel_octree.py and codec.py do together, one part at a time.

    scratch: folder for unnamed files, of about 9 bytes per point and 12 more at times.
    classify: computes the radius classes of a part; None: no radius classes.
    """
    kept = {name: name in (spool.dtype.names or ()) for name in OPTIONAL_COLUMNS}
    dtype = point_dtype(**{**kept, "radius_class": classify is not None})
    with CellSpill(scratch, dtype) as spill:
        for part in plan_parts(spool, key, config):
            codes_of = range(part[0].code, part[-1].code_end)
            if is_heap(part):
                _put_heap(spill, part[0], spool, key, config, classify)
                continue
            points, codes = canonical(gather_voxel(spool.block_rows(key, codes_of.start, codes_of.stop)))
            if classify is not None:
                points = points._replace(radius_class=classify(points.local, codes_of, 1))
            spill.put(_build_part(points, codes, part, config), points)
        return RecordLayout(key, spill, spool.lattice.voxel_steps, config, archive_id, scratch).write()


def _build_part(
    points: VoxelPoints, codes: NDArray[np.uint64], part: list[Cube], config: BuildConfig
) -> CellTrees:
    """Build the cells of consecutive cubes, and their hierarchies."""
    starts, sizes, at = [], [], 0
    for cube in part:
        found = split_octree(codes[at : at + cube.points], cube.log2, CELL_BITS, config.cell_points)
        starts.append(at + found[0])
        sizes.append(found[1])
        at += cube.points
    return build_trees(points.local, np.concatenate(starts), np.concatenate(sizes), config)


def is_heap(part: list[Cube]) -> bool:
    """Return whether a part is one lattice position with more points than fit in memory."""
    return len(part) == 1 and part[0].log2 == 0 and part[0].points > build_limits.DENSE_POINTS


def _put_heap(
    spill: CellSpill, cube: Cube, spool: Spool, key: int, config: BuildConfig, classify: Classify | None
) -> None:
    """Spill the cell of a one-step cube as `build_trees` makes it.

    Its points are never all in memory.
    """
    codes, kind = range(cube.code, cube.code_end), np.uint8(0)
    if classify is not None:
        kind = classify(heap_place(cube.code), codes, cube.points)[0]
    if spill.names:
        # Memory holds two windows of each run, and the rows merged from them, sorted.
        windows = spool.block_windows(key, codes.start, codes.stop, build_limits.DENSE_POINTS // 4)
        for rows in merge_runs(windows):
            columns = np.empty(len(rows), spill.columns)
            for name in spill.names:
                columns[name] = kind if name == "radius_class" else rows[name]
            spill.put_columns(columns)
    spill.put_cells(heap_trees(cube.code, cube.points, config), None, np.empty(0, spill.columns))
