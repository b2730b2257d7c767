"""Bounds of voxels: what the index says of them, and what their records have proved.

The broad phase leaves a voxel unread where no box around its points is in reach. The index says which box that is, and
an index may be forged: its checksum says that it is the one that was written, and no more. A voxel's cell of the grid
cannot be wrong, because a record is refused where a point lies outside it. So the box of a voxel is its cell until its
record has been loaded and found to be what the index says; from then on, evicted or not, it is the one in the index.
"""

import threading

import numpy as np
from numpy.typing import NDArray

from ..schemas.archive import Archive
from .kernels.reach import Reach, SceneIndex
from .kernels.voxel_tree import VoxelTree, make_voxel_tree, tighten

_Int64 = NDArray[np.int64]


class Bounds:
    """Boxes around the points of each of the v voxels of an opened archive. Thread-safe.

    index: what the broad phase reads. Its boxes only ever become smaller, a number at a time: who reads them without a
    lock while a voxel is proved reads a box between the two.  said: the same by the index alone, proved or not.
    proved: (v,) bool, the voxels whose box is that of the index.  left: how many are not; it changes once a box has
    become what the index says, so a reader that finds it unchanged knows of every box that it may have read half.
    """

    def __init__(self, archive: Archive) -> None:
        """Nothing is proved yet."""
        header = archive.header
        steps = header.lattice.voxel_steps
        base = archive.coordinates * steps
        keys = archive.voxels["key"].astype(np.uint64)
        said = (base + archive.voxels["low"], base + archive.voxels["high"])
        self.index = SceneIndex(keys, base, base + (steps - 1), header.low, header.high)
        self.said = SceneIndex(keys, *said, header.low, header.high)
        self.proved: NDArray[np.bool_] = np.zeros(len(keys), bool)
        self.left = len(keys)
        self._unknown = header.unknown
        self._lock = threading.Lock()
        self._trees: tuple[VoxelTree, VoxelTree] | None = None

    def prove(self, row: int) -> None:
        """The record of a voxel has been read, and its points are where the index says."""
        if self.proved[row]:
            return
        low, high = self.said.low[row], self.said.high[row]
        with self._lock:
            if self.proved[row]:
                return
            self.index.low[row], self.index.high[row] = low, high
            if self._trees is not None:
                tighten(self._trees[0], row, low, high)
            self.left -= 1  # first: `doubted` reads them the other way round
            self.proved[row] = True

    def trees(self) -> tuple[VoxelTree, VoxelTree]:
        """Trees over the boxes, for rays and loose points: of `index`, and of `said`. Made when first asked for."""
        trees = self._trees
        if trees is None:
            with self._lock:
                trees = self._trees
                if trees is None:
                    trees = (
                        make_voxel_tree(self.index.low, self.index.high, self._unknown),
                        make_voxel_tree(self.said.low, self.said.high, self._unknown),
                    )
                    self._trees = trees
        return trees

    def doubted(self, reach: Reach, left: int) -> list[int]:
        """Return the rows, each once, that are in reach of a pose, but would not be by the index.

        reach: of `index`.  left: as it was before the reach was computed.
        """
        if not left:
            return []
        rows = reach.rows[: reach.starts[-1]]
        at = np.flatnonzero(~self.proved[rows])
        if left != self.left:  # a voxel was proved meanwhile: its box may have been read half
            at = np.arange(len(rows))
        if not len(at):
            return []
        pose = np.searchsorted(reach.starts, at, side="right") - 1
        center, span = reach.boxes.mean(axis=1)[pose], (reach.boxes[:, 1] - reach.boxes[:, 0])[pose, 0] / 2
        low, high = self.said.low[rows[at]], self.said.high[rows[at]]
        gap = np.maximum(np.maximum(low - center, center - high), 0.0)
        found: list[int] = np.unique(rows[at][(gap * gap).sum(axis=1) > span * span]).tolist()
        return found
