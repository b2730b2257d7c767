"""Record of a voxel that does not fit in memory: its cells on disk, then ordered and compressed.

dense_voxel.py spills the cells of each part to files, in Morton order. Then the top hierarchy is
packed over the cells. In its order, the cells are read once more to bound it and to write the rows
of the record.
"""

import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.codec import (
    CELL_DTYPE,
    CELL_EXPANSION,
    NODE_DTYPE,
    NODE_EXPANSION,
    Record,
    cell_rows,
    node_rows,
    point_rows,
)
from ...schemas.archive.voxel import LeafCells, Nodes, VoxelData, top_shift
from ...schemas.archive.zstd_frame import RowStream, pwrite_all
from ...schemas.errors import CorruptError
from .. import build_limits
from ..config import BuildConfig
from ..kernels.points.octree_cells import by_axis, by_cell
from ..kernels.trees.bounding_sphere import MOMENTS
from ..kernels.trees.build_tree import EXTREMES
from .top_hierarchy import Top, pack_top
from .voxel_octree import (
    BuiltVoxel,
    CellTrees,
    VoxelPoints,
    block_points,
    leaf_runs,
)

# Limit of the points of cells that are read together. It is less than DENSE_POINTS, so that a heap
# (coincident_points.py) forms a separate window.
WINDOW_POINTS = 1 << 17


class CellSpill:
    """Cells made so far, on disk in Morton order; memory holds their corners, sizes and counts."""

    def __init__(self, scratch: Path, dtype: np.dtype) -> None:
        """Open spill files in the folder `scratch`, for points with the columns of `dtype`."""
        self.names = [name for name in dtype.names or () if name != "xyz"]
        self.dtype = dtype
        self.columns = np.dtype([(name, dtype[name]) for name in self.names])
        self._files = [tempfile.TemporaryFile(dir=scratch, buffering=0) for _ in range(4)]  # noqa: SIM115  __exit__
        self._ends = [0] * 4
        self._cells: list[tuple[NDArray[Any], ...]] = []

    def __enter__(self) -> "CellSpill":
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


class RecordLayout:
    """Writer of the record: orders the spilled cells as the top hierarchy over them."""

    def __init__(
        self,
        key: int,
        spill: CellSpill,
        voxel_steps: int,
        config: BuildConfig,
        archive_id: bytes,
        scratch: Path,
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
            is_heap = counts[first] > build_limits.DENSE_POINTS and self.cells.log2_size[first] == 0
            for rows in self._heap(first) if is_heap else self._points(first, past, stored):
                points.put(at_point, rows)
                at_point += len(rows)
        if self.top is not None:
            nodes.put(0, node_rows(self.top.rows()))
        cells = RowStream(self.scratch, CELL_DTYPE, c, CELL_EXPANSION)
        cells.put(0, cell_rows(self.key, self.archive_id, self.cells))
        leaves = int((-(-counts // self.config.leaf)).sum())
        record = Record(cells.frame(), nodes.frame(), points.frame(), c, nodes_total, total, leaves)
        return BuiltVoxel(self._empty_voxel(), record, self.low, self.high)

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

    def _empty_voxel(self) -> VoxelData:
        """Return the voxel without rows: its key, and an empty array for each of its columns."""
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
