"""Coarse bounds: the top nodes of every voxel, kept in memory to answer clear poses without a load.

[Fig12] section 4 keeps a voxel in memory whole or not at all. A descent begins with a small part of
the voxel, and often that part alone proves a pose clear. kernels/collide/coarse_clearance.py
defines this part and what it proves.
"""

import threading
from collections.abc import Callable, Iterator
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.voxel import top_shift
from ...schemas.errors import CorruptError
from ..kernels.collide.coarse_clearance import (
    SLOT_WORDS,
    CoarseArrays,
    any_with_coarse_bounds,
    copy_unproved_pairs,
    write_coarse_bounds,
)
from ..kernels.core.placed_avatar import Avatar
from ..kernels.core.scene_arrays import (
    BLOCK_WORDS,
    CLASS_SHIFT,
    LOCAL_MASK,
    ROW_WORDS,
    Arena,
    SceneArrays,
    lay_out,
)
from ..kernels.core.voxels_in_reach import VoxelsInReach
from .arena import ArenaBuffer
from .voxel_store import VoxelStore

# Share of the budget for coarse bounds, 6 KB a voxel.
BUDGET_SHARE = 1 / 16
# Bytes of the rows of a slot and of its entry in `count`.
SLOT_BYTES = 4 * SLOT_WORDS + 4
# The class with the largest spheres under every radius model (schemas/archive/radius_model.py).
LARGEST_CLASS = LOCAL_MASK << CLASS_SHIFT


class CoarseBounds:
    """Coarse bounds of one scene's voxels. Thread-safe.

    Slots are never evicted or overwritten: once all are taken, further voxels get no slot. A voxel
    without a slot has to be loaded. Overwriting slots would require a lock, and kernels read slots
    without a lock.

    arrays: arrays that kernels read.  bytes: size of the arrays, constant and at most the budget.
    """

    def __init__(self, voxels: int, budget_bytes: int) -> None:
        """Reserve slots for all `voxels` of a scene, or for as many as fit in the budget.

        There are no slots if the table with an entry for each voxel exceeds the budget by itself.
        The system commits the pages of a slot when it is written.
        """
        slots = min(voxels, max(0, budget_bytes - 4 * voxels) // SLOT_BYTES)
        words = np.empty(slots * SLOT_WORDS, np.float32)
        slot = np.full(voxels if slots else 0, -1, np.int32)
        self.arrays = CoarseArrays(words, words.view(np.int32), slot, np.zeros(slots, np.int32))
        self.bytes = words.nbytes + slot.nbytes + self.arrays.count.nbytes
        self._lock = threading.Lock()
        self._assigned = 0  # slots that were ever assigned; those returned since are in `_returned`
        self._returned: list[int] = []
        self._making: set[int] = set()

    @property
    def stored(self) -> int:
        """Return the number of voxels that have coarse bounds."""
        with self._lock:
            return self._assigned - len(self._returned) - len(self._making)

    @property
    def has_room_for_all(self) -> bool:
        """Return whether there is a slot for every voxel."""
        return len(self.arrays.count) >= len(self.arrays.slot) > 0

    @property
    def _has_free_slot(self) -> bool:
        return self._assigned - len(self._returned) < len(self.arrays.count)

    def rows_without_bounds(self) -> Iterator[int]:
        """Iterate over the rows of voxels without a slot, ascending, while slots are free.

        Slots may be filled during the iteration. Each row comes once, even if its voxel turns out
        to be unreadable.
        """
        for row in range(len(self.arrays.slot)):
            if not self._has_free_slot:
                return
            if self.arrays.slot[row] < 0 and row not in self._making:
                yield row

    def store_from_arena(self, row: int, arena: Arena, where: NDArray[np.int64]) -> None:
        """Store the coarse bounds of a voxel in the arena, unless it has a slot or none is free.

        where: (3,) int64, the voxel's runs (scene_arrays.py). The voxel must stay there until this
        method returns.
        """
        number = self._take(row)
        if number >= 0:
            self._write(row, number, arena, int(where[0]), 0)

    def store_from_archive(self, store: VoxelStore, row: int) -> None:
        """Read the nodes of a voxel from the archive, without points, and store its coarse bounds.

        The radius class of a node is computed from its points. If the archive has radius classes,
        these bounds therefore assume the largest class, and prove slightly less than those stored
        by `store_from_arena`.
        Raise CorruptError or OSError as `VoxelStore.load` does. The voxel then has no slot, and the
        call may be repeated.
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
        """Assign a slot to a voxel and return its number.

        Return -1 if the voxel has a slot, another thread is writing it, or no slot is free.
        """
        with self._lock:
            if not self._has_free_slot or self.arrays.slot[row] >= 0 or row in self._making:
                return -1
            self._making.add(row)
            if self._returned:
                return self._returned.pop()
            self._assigned += 1
            return self._assigned - 1

    def _give_back(self, row: int, number: int) -> None:
        """Return a slot that was not published."""
        with self._lock:
            self._making.discard(row)
            self._returned.append(number)

    def _write(self, row: int, number: int, arena: Arena, root: int, assumed: int) -> None:
        """Write a slot, then publish it: first its rows, then its count, and its number last."""
        try:
            count = write_coarse_bounds(
                arena.words, arena.ints, root, np.int32(assumed), self.arrays.ints, number
            )
        except BaseException:
            self._give_back(row, number)
            raise
        # Taking this lock orders the writes above before those below. A thread that sees the slot's
        # number, by which it finds the rows, therefore sees the rows too.
        with self._lock:
            self.arrays.count[number] = count
            self.arrays.slot[row] = number
            self._making.discard(row)


def _lay_out_tree(store: VoxelStore, row: int) -> Arena:
    """Lay out the nodes of a voxel, without points, as `VoxelStore.load` does, in a new arena."""
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


def drop_clear_pairs(
    arrays: SceneArrays,
    coarse: CoarseArrays,
    avatar: Avatar,
    poses: NDArray[np.float64],
    reach: VoxelsInReach,
) -> tuple[VoxelsInReach, int]:
    """Remove from `reach` the pairs of pose and voxel that coarse bounds prove clear.

    Return the new reach and the number of pairs removed; return `reach` itself if none is removed.
    poses: (k, 4, 4) float64, checked.  reach: the reach of these poses and this avatar.
    Voxels that are resident or have no slot stay, and the order stays. Every removed pair is one
    that `collide_poses` would find clear.
    """
    needed = reach.starts[-1]
    slot = coarse.slot
    if not len(slot) or not any_with_coarse_bounds(arrays.where, slot, reach.rows, needed, arrays.stop):
        return reach, 0
    starts, rows = np.empty_like(reach.starts), np.empty(needed, np.int64)
    removed = copy_unproved_pairs(poses, avatar, arrays, coarse, reach, starts, rows)
    return (reach._replace(starts=starts, rows=rows), removed) if removed else (reach, 0)


def make_coarse_bounds(store: VoxelStore, budget_bytes: int) -> CoarseBounds | None:
    """Return storage for coarse bounds of all voxels, or of as many as their budget share holds.

    Return None if the budget holds no coarse bounds beside the largest voxel.
    """
    voxels, largest = len(store.sizes), int(store.sizes.max(initial=0))
    most = min(int(budget_bytes * BUDGET_SHARE), budget_bytes - ArenaBuffer.rounded(largest))
    coarse = CoarseBounds(voxels, most)
    return coarse if len(coarse.arrays.count) else None


def coarse_filler(coarse: CoarseBounds, store: VoxelStore) -> Callable[[], bool]:
    """Return a function that stores the coarse bounds of the next voxel without them.

    It returns False when all voxels have them.
    """
    missing = coarse.rows_without_bounds()

    def fill_one() -> bool:
        row = next(missing, None)
        if row is None:
            return False
        # An unreadable voxel gets no coarse bounds. The request that loads it reports the error.
        with suppress(CorruptError, OSError):
            coarse.store_from_archive(store, row)
        return True

    return fill_one
