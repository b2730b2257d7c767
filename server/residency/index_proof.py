"""Proved bounding boxes of voxels: a box of the index is used once the voxel's record proves it.

The broad phase does not read a voxel if the box around its points is out of reach. The index stores
this box, but an index may be forged: its checksum only proves that the index was not altered after
it was written. A voxel's grid cell cannot be wrong, because a record with a point outside its cell
is rejected. The broad phase therefore uses the cell as the voxel's box until the record has been
loaded and matches the index. From then on it uses the box in the index, even after the voxel is
evicted.
"""

import threading

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.archive import Archive
from ..kernels.core.voxel_tree import VoxelTree, make_voxel_tree, tighten
from ..kernels.core.voxels_in_reach import SceneIndex, VoxelsInReach
from ..runtime.stop_flag import NO_STOP, StopFlag

_Int64 = NDArray[np.int64]

# Entries of a reach processed between two checks of the stop flag: some milliseconds of work, and
# 200 bytes each.
ENTRIES_AT_ONCE = 1 << 15


class ProvedBounds:
    """Boxes around the points of each of the v voxels of an opened archive. Thread-safe.

    index: the boxes that the broad phase reads: the cell of an unproved voxel, and the box in the
    index of a proved one. A box only shrinks, one number at a time; a reader without the lock may
    see some of its numbers before the change and some after it.
    index_boxes: the boxes in the index, proved or not.
    proved: (v,) bool, voxels whose record matches its box in the index.
    unproved: the number of voxels not proved. Read it before `index`, and pass it to `unsettled`
    afterwards.
    """

    def __init__(self, archive: Archive) -> None:
        """Begin with no voxel proved."""
        header = archive.header
        steps = header.lattice.voxel_steps
        base = archive.coordinates * steps
        keys = archive.voxels["key"].astype(np.uint64)
        boxes = (base + archive.voxels["low"], base + archive.voxels["high"])
        self.index = SceneIndex(keys, base, base + (steps - 1), header.low, header.high)
        self.index_boxes = SceneIndex(keys, *boxes, header.low, header.high)
        self.proved: NDArray[np.bool_] = np.zeros(len(keys), bool)
        self.unproved = len(keys)
        self._order = np.empty(len(keys), np.int64)  # rows in order of their proof
        self._unknown = header.unknown
        self._lock = threading.Lock()
        self._trees: tuple[VoxelTree, VoxelTree] | None = None

    def prove(self, row: int) -> None:
        """Mark a voxel as proved: its record matches its box in the index."""
        if self.proved[row]:
            return
        low, high = self.index_boxes.low[row], self.index_boxes.high[row]
        with self._lock:
            if self.proved[row]:
                return
            self.index.low[row], self.index.high[row] = low, high
            if self._trees is not None:
                tighten(self._trees[0], row, low, high)
            self._order[len(self._order) - self.unproved] = row
            self.unproved -= 1
            self.proved[row] = True  # last: `unsettled` reads it first

    def unsettled(self, rows: _Int64, unproved: int) -> NDArray[np.bool_]:
        """Return the mask (n,) of rows whose box may have been read before it was the index's.

        unproved: its value before the boxes were read. A voxel proved since then is included,
        because its box may have been read while it changed.
        """
        found = ~self.proved[rows]
        # `prove` decrements `unproved` before it sets `proved`.
        voxels = len(self._order)
        since = self._order[voxels - unproved : voxels - self.unproved]
        if len(since):
            found |= np.isin(rows, since)
        return found

    def trees(self) -> tuple[VoxelTree, VoxelTree]:
        """Return the trees over the boxes of `index` and `index_boxes`, for rays and single points.

        The first call builds them.
        """
        trees = self._trees
        if trees is None:
            with self._lock:
                trees = self._trees
                if trees is None:
                    trees = (
                        make_voxel_tree(self.index.low, self.index.high, self._unknown),
                        make_voxel_tree(self.index_boxes.low, self.index_boxes.high, self._unknown),
                    )
                    self._trees = trees
        return trees

    def rows_to_prove(self, reach: VoxelsInReach, unproved: int, stop: StopFlag = NO_STOP) -> list[int]:
        """Find the rows in `reach` that would not be in it by the boxes in the index.

        Return them ascending, each once.
        reach: of k poses, computed with `index`.  unproved: its value before `reach` was computed.
        stop: once it is set, the result may be incomplete.
        """
        hidden = np.zeros(len(self.proved), bool)
        entries = int(reach.starts[-1]) if unproved else 0
        for begin in range(0, entries, ENTRIES_AT_ONCE):
            if stop:
                break
            rows = reach.rows[begin : min(begin + ENTRIES_AT_ONCE, entries)]
            at = np.flatnonzero(self.unsettled(rows, unproved) & ~hidden[rows])
            if not len(at):
                continue
            rows = rows[at]
            boxes = reach.boxes[np.searchsorted(reach.starts, begin + at, side="right") - 1]
            center, span = boxes.mean(axis=1), (boxes[:, 1, 0] - boxes[:, 0, 0]) / 2
            low, high = self.index_boxes.low[rows], self.index_boxes.high[rows]
            gap = np.maximum(np.maximum(low - center, center - high), 0.0)
            hidden[rows[(gap * gap).sum(axis=1) > span * span]] = True
        found: list[int] = np.flatnonzero(hidden).tolist()
        return found
