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

import os
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.codec import (
    CELL_DTYPE,
    CELL_EXPANSION,
    NODE_DTYPE,
    NODE_EXPANSION,
    OPTIONAL_COLUMNS,
    Record,
    cell_rows,
    node_rows,
    point_dtype,
    point_rows,
)
from ...schemas.archive.voxel import CELL_BITS, LeafCells, Nodes, VoxelData, top_shift
from ...schemas.archive.zstd_frame import RowStream, pwrite_all
from ...schemas.errors import BadRequestError, CorruptError
from ..config import BuildConfig
from ..kernels.points.octree_cells import by_axis, by_cell, split_octree
from ..kernels.trees.bounding_sphere import MOMENTS
from ..kernels.trees.build_tree import EXTREMES
from ..spool.spool import Spool
from .cell_trees import CellTrees, block_points, build_trees, leaf_runs
from .coincident_points import heap_place, heap_trees, merge_runs
from .top_hierarchy import Top, pack_top
from .voxel_octree import VoxelPoints, canonical, gather_voxel

# Voxels with more points are always built in parts of at most this many, so that no archive depends
# on the memory of its builder. Building a part takes some 60 bytes per point.
DENSE_POINTS = 1 << 20
# Most points of cells that are read together on the way into the record. Fewer than DENSE_POINTS,
# which makes a heap a window of its own.
WINDOW_POINTS = 1 << 17

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
    def past(self) -> int:
        """Return the first code after the cube."""
        return self.code + (1 << 3 * self.log2)


class BuiltVoxel(NamedTuple):
    """Finished voxel, as `write_shard` takes it.

    voxel: at least its key and the columns it has.
    low, high: (3,) int64, least and greatest coordinates of its points [voxel steps].
    """

    voxel: VoxelData
    record: Record
    low: NDArray[np.int64]
    high: NDArray[np.int64]


def is_dense(points: int, config: BuildConfig) -> bool:
    """Return whether a voxel of so many points is built in parts.

    Balanced cells, an option kept for comparison, require the whole voxel.
    """
    return points > DENSE_POINTS and config.cells == "octree"


def check_normals(counts: NDArray[np.int64], config: BuildConfig) -> None:
    """Refuse normals if a voxel is built in parts, because neighbours may be in another part.

    counts: (v,) points of each voxel.
    """
    most = int(counts.max(initial=0))
    if "normal" in config.keep and is_dense(most, config):
        raise BadRequestError(
            f"--keep normal: a voxel of {config.voxel:g} m holds {most} points, too many to be held in memory: give a "
            "smaller --voxel, or leave it out: a server estimates the normals it needs"
        )


def plan_parts(spool: Spool, key: int, config: BuildConfig) -> Iterator[list[Cube]]:
    """Cut a voxel into parts, in Morton order.

    A part is either consecutive cubes of together at most DENSE_POINTS points, or one cube that
    cannot be cut further.
    """
    most = max(DENSE_POINTS, config.cell_points)
    root = Cube(0, int(spool.lattice.voxel_steps - 1).bit_length(), spool.count(key))
    waiting, part = [root], list[Cube]()
    while waiting:
        cube = waiting.pop()
        if cube.points > most and cube.log2 > 0:
            edge = 1 << 3 * (cube.log2 - 1)
            children = [
                Cube(code, cube.log2 - 1, spool.block_count(key, code, code + edge))
                for code in range(cube.code, cube.past, edge)
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
    names = [name for name in OPTIONAL_COLUMNS[:2] if name in (spool.dtype.names or ())]
    dtype = point_dtype(
        scan_index="scan_index" in names, intensity="intensity" in names, radius_class=classify is not None
    )
    with _Spill(scratch, dtype) as spill:
        for part in plan_parts(spool, key, config):
            codes_of = range(part[0].code, part[-1].past)
            if is_heap(part):
                _put_heap(spill, part[0], spool, key, config, classify)
                continue
            points, codes = canonical(gather_voxel(spool.block_rows(key, codes_of.start, codes_of.stop)))
            if classify is not None:
                points = points._replace(radius_class=classify(points.local, codes_of, 1))
            spill.put(_build_part(points, codes, part, config), points)
        return _Layout(key, spill, spool.lattice.voxel_steps, config, archive_id, scratch).write()


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
    return len(part) == 1 and part[0].log2 == 0 and part[0].points > DENSE_POINTS


def _put_heap(
    spill: "_Spill", cube: Cube, spool: Spool, key: int, config: BuildConfig, classify: Classify | None
) -> None:
    """Spill the cell of a one-step cube as `build_trees` makes it.

    Its points are never all in memory.
    """
    codes, kind = range(cube.code, cube.past), np.uint8(0)
    if classify is not None:
        kind = classify(heap_place(cube.code), codes, cube.points)[0]
    if spill.names:
        # Memory holds two windows of each run, and the rows merged from them, sorted.
        windows = spool.block_windows(key, codes.start, codes.stop, DENSE_POINTS // 4)
        for rows in merge_runs(windows):
            columns = np.empty(len(rows), spill.columns)
            for name in spill.names:
                columns[name] = kind if name == "radius_class" else rows[name]
            spill.put_columns(columns)
    spill.put_cells(heap_trees(cube.code, cube.points, config), None, np.empty(0, spill.columns))


class _Spill:
    """Cells made so far, on disk in Morton order; memory holds their corners, sizes and counts."""

    def __init__(self, scratch: Path, dtype: np.dtype) -> None:
        """Open spill files in the folder `scratch`, for points with the columns of `dtype`."""
        self.names = [name for name in dtype.names or () if name != "xyz"]
        self.dtype = dtype
        self.columns = np.dtype([(name, dtype[name]) for name in self.names])
        self._files = [tempfile.TemporaryFile(dir=scratch, buffering=0) for _ in range(4)]  # noqa: SIM115  __exit__
        self._ends = [0] * 4
        self._cells: list[tuple[NDArray[Any], ...]] = []

    def __enter__(self) -> "_Spill":
        """Return the spill itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the files, which deletes them."""
        for file in self._files:
            file.close()

    def put(self, trees: CellTrees, points: VoxelPoints) -> None:
        """Append the cells of a part and the points that they were made of."""
        columns = np.empty(len(trees.rank) if self.names else 0, self.columns)
        for name in self.names:
            columns[name] = getattr(points, name)[trees.rank]
        self.put_cells(trees, by_cell(trees.xyz, trees.starts), columns)

    def put_columns(self, columns: NDArray) -> None:
        """Append columns of the cells that the next `put_cells` adds."""
        self._ends[1] += pwrite_all(self._files[1].fileno(), columns.view(np.uint8), self._ends[1])

    def put_cells(self, trees: CellTrees, flat: NDArray[np.uint16] | None, columns: NDArray) -> None:
        """Append cells, their points in the layout of `by_cell`, and their columns.

        flat: the points; None: all points are at the corner of their cell.
        columns: of the points that `put_columns` has not received.
        """
        stats = [trees.spreads.tobytes(), trees.extremes.tobytes()]
        if flat is None:
            self._ends[0] += 6 * int(trees.starts[-1])  # leaves a hole that is never read
        for i, data in enumerate(
            [
                b"" if flat is None else flat,
                columns.view(np.uint8) if self.names else b"",
                node_rows(trees.nodes).view(np.uint8),
            ]
        ):
            self._ends[i] += pwrite_all(self._files[i].fileno(), data, self._ends[i])
        self._ends[3] += pwrite_all(self._files[3].fileno(), b"".join(stats), self._ends[3])
        self._cells.append(
            (
                trees.low.astype(np.int32),
                trees.log2_size,
                np.diff(trees.starts).astype(np.uint32),
                np.diff(trees.rows).astype(np.uint32),
            )
        )

    def cells(self) -> LeafCells:
        """Return the cells in their stored form, in Morton order."""
        low, log2_size, points, nodes = (np.concatenate(column) for column in zip(*self._cells, strict=True))
        return LeafCells(low, log2_size, nodes, points)

    def stats(self) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
        """Return the spreads and extremes of all cells, in Morton order."""
        spreads, extremes, at = [], [], 0
        for low, *_ in self._cells:
            c = len(low)
            raw = os.pread(self._files[3].fileno(), c * (8 * MOMENTS + 12 * EXTREMES), at)
            spreads.append(np.frombuffer(raw, np.float64, c * MOMENTS).reshape(c, MOMENTS))
            extremes.append(np.frombuffer(raw, np.int32, offset=8 * c * MOMENTS).reshape(c, EXTREMES, 3))
            at += len(raw)
        return np.concatenate(spreads), np.concatenate(extremes)

    def take(self, which: int, starts: NDArray[np.int64], counts: NDArray[np.int64], size: int) -> NDArray:
        """Return the items of some cells, of `size` bytes each, in file `which`.

        They are concatenated.
        """
        taken = np.empty(int(counts.sum()) * size, np.uint8)
        view, at = taken.data, 0
        descriptor = self._files[which].fileno()
        for start, count in zip((starts * size).tolist(), (counts * size).tolist(), strict=True):
            got = os.preadv(descriptor, [view[at : at + count]], start)
            if got != count:
                raise CorruptError(f"a spill file is {count - got} bytes too short: check the disk")
            at += count
        return taken

    def take_columns(self, starts: NDArray[np.int64], counts: NDArray[np.int64]) -> NDArray:
        """Return the columns of some cells' points, concatenated."""
        if not self.names:
            return np.empty(0, self.columns)
        return self.take(1, starts, counts, self.columns.itemsize).view(self.columns)


class _Layout:
    """Writer of the record: orders the spilled cells as the top hierarchy over them."""

    def __init__(
        self, key: int, spill: _Spill, voxel_steps: int, config: BuildConfig, archive_id: bytes, scratch: Path
    ) -> None:
        """Pack the top hierarchy."""
        self.key, self.spill, self.config = key, spill, config
        self.archive_id, self.scratch, self.shift = archive_id, scratch, top_shift(voxel_steps)
        cells = spill.cells()
        spreads, extremes = spill.stats()
        self.low = extremes.min(axis=(0, 1)).astype(np.int64)
        self.high = extremes.max(axis=(0, 1)).astype(np.int64)
        self.top: Top | None = None
        order = np.zeros(1, np.int64)
        if len(cells.nodes) > 1:
            low = cells.low.astype(np.int64)
            self.top = pack_top(low, cells.log2_size, spreads, extremes, voxel_steps, config)
            order = self.top.order
        points, nodes = (np.cumsum(np.append(0, c), dtype=np.int64) for c in (cells.points, cells.nodes))
        self.first_point, self.first_node = points[order], nodes[order]
        self.cells = LeafCells._make(column[order] for column in cells)

    def write(self) -> BuiltVoxel:
        """Read the cells in order and compress their rows."""
        spill, c = self.spill, len(self.cells.nodes)
        counts = self.cells.points.astype(np.int64)
        top_rows = 0 if self.top is None else len(self.top.count)
        total, nodes_total = int(counts.sum()), top_rows + int(self.cells.nodes.sum(dtype=np.int64))
        points = RowStream(self.scratch, spill.dtype, total)
        nodes = RowStream(self.scratch, NODE_DTYPE, nodes_total, NODE_EXPANSION)
        at_point, at_node = 0, top_rows + c
        for first, past in _windows(counts):
            stored, is_root = self._nodes(first, past)
            nodes.put(top_rows + first, stored[is_root])
            nodes.put(at_node, stored[~is_root])
            at_node += len(stored) - (past - first)
            is_heap = counts[first] > DENSE_POINTS and self.cells.log2_size[first] == 0
            for rows in self._heap(first) if is_heap else self._points(first, past, stored):
                points.put(at_point, rows)
                at_point += len(rows)
        if self.top is not None:
            nodes.put(0, node_rows(self.top.rows()))
        cells = RowStream(self.scratch, CELL_DTYPE, c, CELL_EXPANSION)
        cells.put(0, cell_rows(self.key, self.archive_id, self.cells))
        leaves = int((-(-counts // self.config.leaf)).sum())
        record = Record(cells.frame(), nodes.frame(), points.frame(), c, nodes_total, total, leaves)
        return BuiltVoxel(self._shell(), record, self.low, self.high)

    def _nodes(self, first: int, past: int) -> tuple[NDArray, NDArray[np.bool_]]:
        """Return the node rows of cells [first, past) in stored order, and a mask of the roots."""
        held = self.cells.nodes[first:past].astype(np.int64)
        stored = self.spill.take(2, self.first_node[first:past], held, NODE_DTYPE.itemsize).view(NODE_DTYPE)
        is_root = np.zeros(len(stored), bool)
        is_root[np.cumsum(held) - held] = True
        return stored, is_root

    def _points(self, first: int, past: int, stored: NDArray) -> Iterator[NDArray]:
        """Yield the point rows of a range of cells.

        Enlarge the bounds of the top hierarchy around them.

        stored: node rows of these cells.
        """
        of = slice(first, past)
        cells = LeafCells._make(column[of] for column in self.cells)
        held = cells.points.astype(np.int64)
        starts, rows = (
            np.concatenate([[0], np.cumsum(count, dtype=np.int64)]) for count in (held, cells.nodes)
        )
        trees = CellTrees(
            cells.low.astype(np.int64),
            cells.log2_size,
            starts,
            rows,
            Nodes._make(np.ascontiguousarray(stored[name]) for name in Nodes._fields),
            by_axis(self.spill.take(0, self.first_point[of], held, 6).view(np.uint16), starts),
            np.empty(0, np.int32),
            np.empty((0, MOMENTS)),
            np.empty((0, EXTREMES, 3), np.int32),
        )
        if self.top is not None:
            self.top.grow(trees.xyz, trees.starts, trees.low, first)
        columns = self.spill.take_columns(self.first_point[of], held)
        kept = {name: columns[name] for name in self.spill.names}
        yield point_rows(block_points(trees, self.config.leaf), leaf_runs(trees, self.config.leaf), kept)

    def _heap(self, cell: int) -> Iterator[NDArray]:
        """Yield the point rows of a cell whose points are all at one position.

        The rows contain columns only.
        """
        if self.top is not None:
            low = self.cells.low[cell : cell + 1].astype(np.int64)
            self.top.grow(np.zeros((3, 1), np.uint16), np.array([0, 1]), low, cell)
        n, first = int(self.cells.points[cell]), int(self.first_point[cell])
        for at in range(0, n, WINDOW_POINTS):
            held = min(WINDOW_POINTS, n - at)
            rows = np.zeros(held, self.spill.dtype)
            columns = self.spill.take_columns(np.array([first + at]), np.array([held]))
            for name in self.spill.names:
                rows[name] = columns[name]
            yield rows

    def _shell(self) -> VoxelData:
        """Return the voxel without rows: its key, and empty columns that tell which it has."""
        nodes = np.empty(0, NODE_DTYPE)
        return VoxelData(
            self.key,
            self.shift,
            LeafCells._make(column[:0] for column in self.cells),
            Nodes._make(nodes[name] for name in Nodes._fields),
            np.empty((0, 3), np.uint16),
            **{name: np.empty(0, self.spill.dtype[name]) for name in self.spill.names},
        )


def _windows(counts: NDArray[np.int64]) -> Iterator[tuple[int, int]]:
    """Cut cells into consecutive ranges of about WINDOW_POINTS points, and at least one cell.

    counts: (c,) points of each cell. Yields (first, past).
    """
    ends = np.cumsum(counts)
    first = 0
    while first < len(counts):
        before = int(ends[first - 1]) if first else 0
        past = max(first + 1, int(np.searchsorted(ends, before + WINDOW_POINTS, side="right")))
        yield first, past
        first = past
