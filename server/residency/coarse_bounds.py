"""Coarse tops: a few nodes of every voxel, kept in memory, that settle far and clear poses without any load.

[Fig12] section 4 keeps voxels in memory whole or not at all. What a descent looks at first is a small part of a voxel,
and where it is enough, nothing has to be read: kernels/overlap/coarse_overlap.py says which part, and what it proves.
"""

import threading
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.voxel import top_shift
from ..kernels.core.pose_transform import Avatar
from ..kernels.core.voxel_layout import (
    BLOCK_WORDS,
    CLASS_SHIFT,
    LOCAL_MASK,
    ROW_WORDS,
    Arena,
    SceneArrays,
    lay_out,
)
from ..kernels.core.voxels_in_reach import Reach
from ..kernels.overlap.coarse_overlap import SLOT_WORDS, CoarseArrays, any_to_settle, settle_pairs, take_top
from .voxel_store import Store

# A slot's rows, and its place in `count`.
SLOT_BYTES = 4 * SLOT_WORDS + 4
# The class of which no sphere is larger, whatever the radius model (schemas/archive/radius_model.py).
LARGEST_CLASS = LOCAL_MASK << CLASS_SHIFT


class Coarse:
    """The coarse tops of one scene's voxels. Thread-safe.

    A voxel that has one keeps it: nothing is evicted, and once there is no room, voxels that come later have none. To
    be without costs a load; kernels read slots without a lock, so to write one again would cost a lock.

    arrays: what kernels read.  bytes: what they take, at most the budget; the same from the start.
    """

    def __init__(self, voxels: int, budget_bytes: int) -> None:
        """Make room for so many voxels of a scene's, or as many as fit; none where the table of voxels alone does not.

        The system commits a slot's pages when it is written.
        """
        slots = min(voxels, max(0, budget_bytes - 4 * voxels) // SLOT_BYTES)
        words = np.empty(slots * SLOT_WORDS, np.float32)
        slot = np.full(voxels if slots else 0, -1, np.int32)
        self.arrays = CoarseArrays(words, words.view(np.int32), slot, np.zeros(slots, np.int32))
        self.bytes = words.nbytes + slot.nbytes + self.arrays.count.nbytes
        self._lock = threading.Lock()
        self._begun = 0  # slots that were ever given out; those given back since are in `_back`
        self._back: list[int] = []
        self._making: set[int] = set()

    @property
    def known(self) -> int:
        """How many voxels have a slot."""
        with self._lock:
            return self._begun - len(self._back) - len(self._making)

    @property
    def holds_all(self) -> bool:
        """Whether there is a slot for every voxel."""
        return len(self.arrays.count) >= len(self.arrays.slot) > 0

    @property
    def _room(self) -> bool:
        return self._begun - len(self._back) < len(self.arrays.count)

    def missing(self) -> Iterator[int]:
        """The rows of voxels without a slot, ascending, while there is room. May be gone through while they are filled.

        Each is named once: also those that turn out to be unreadable.
        """
        for row in range(len(self.arrays.slot)):
            if not self._room:
                return
            if self.arrays.slot[row] < 0 and row not in self._making:
                yield row

    def remember(self, row: int, arena: Arena, where: NDArray[np.int64]) -> None:
        """Keep the top of a voxel that has been laid out in the arena, unless it is kept, or there is no room.

        where: (3,) int64, its runs (voxel_layout.py). It must stay there until this returns.
        """
        number = self._take(row)
        if number >= 0:
            self._write(row, number, arena, int(where[0]), 0)

    def fill(self, store: Store, row: int) -> None:
        """Keep the top of a voxel of the archive, as `remember` does; its points are not read.

        The radius classes of nodes come from points: where the archive has them, the rows say the largest there is,
        and prove a little less than those of a voxel that was remembered.
        Raises CorruptError, OSError as `Store.load`: then it has none, and may be tried again.
        """
        number = self._take(row)
        if number < 0:
            return
        try:
            arena = _lay_out_tree(store, row)
        except BaseException:
            self._give_back(row, number)
            raise
        self._write(row, number, arena, 0, LARGEST_CLASS if store.archive.header.radius_class else 0)

    def _take(self, row: int) -> int:
        """A slot for a voxel to be written into; -1: it has one, is being given one, or there is none."""
        with self._lock:
            if not self._room or self.arrays.slot[row] >= 0 or row in self._making:
                return -1
            self._making.add(row)
            if self._back:
                return self._back.pop()
            self._begun += 1
            return self._begun - 1

    def _give_back(self, row: int, number: int) -> None:
        """Take back a slot that nobody has seen."""
        with self._lock:
            self._making.discard(row)
            self._back.append(number)

    def _write(self, row: int, number: int, arena: Arena, root: int, assumed: int) -> None:
        """Write a slot, then publish it: its rows, its count, and only then where it is."""
        try:
            count = take_top(arena.words, arena.ints, root, np.int32(assumed), self.arrays.ints, number)
        except BaseException:
            self._give_back(row, number)
            raise
        # Between what is written above and below the interpreter's lock was let go and this one is taken: who sees the
        # slot's number, which is where its rows are found, sees the rows.
        with self._lock:
            self.arrays.count[number] = count
            self.arrays.slot[row] = number
            self._making.discard(row)


def _lay_out_tree(store: Store, row: int) -> Arena:
    """The nodes of a voxel as `Store.load` lays them out, at the beginning of an arena of their own; no points."""
    tree = store.archive.open_tree(row)
    links = tree.links
    words = np.empty(ROW_WORDS * len(links.first) + BLOCK_WORDS * tree.leaves, np.float32)
    arena = Arena(words, words.view(np.int32), words.view(np.uint16))
    shift = np.int64(top_shift(store.archive.header.lattice.voxel_steps))
    lay_out(
        (tree.cells, tree.nodes, shift),
        (links.first, links.is_leaf, links.cell),
        arena,
        np.int64(0),
        BLOCK_WORDS,
        np.empty(3, np.int64),
    )
    return arena


def settle(
    arrays: SceneArrays, coarse: CoarseArrays, avatar: Avatar, poses: NDArray[np.float64], reach: Reach
) -> tuple[Reach, int]:
    """`reach` without the pairs of pose and voxel that coarse tops prove clear, and how many these are.

    poses: (k, 4, 4) float64, checked, and `reach` theirs; avatar: the one it was found for. Voxels that are resident or
    have no slot stay, in their order. Left out are those that `overlap_poses` would find clear, and no others.
    `reach` itself, where there is nothing to leave out.
    """
    needed = reach.starts[-1]
    if not len(coarse.count) or not any_to_settle(arrays.where, coarse.slot, reach.rows, needed):
        return reach, 0
    starts, rows = np.empty_like(reach.starts), np.empty(needed, np.int64)
    settled = settle_pairs(poses, avatar, arrays, coarse, reach, starts, rows)
    return (reach._replace(starts=starts, rows=rows), settled) if settled else (reach, 0)
