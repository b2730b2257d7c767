"""User who always requests what was evicted: either most recently or longest ago.

The user predicts evictions with a local LRU model. The cache under test may evict differently; the
requests are then still what an LRU cache would have evicted. The poses stand in the middle of a
voxel's points and not on a floor. The requests are recorded as a trace.
"""

from collections import OrderedDict
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ....avatars.avatar_model import AvatarModel
from .archive_voxels import read_voxels

Floats = NDArray[np.float64]


class LruModel:
    """Least-recently-used cache of at most `budget` bytes, with the order of evictions."""

    def __init__(self, sizes: NDArray[np.int64], budget: int) -> None:
        """Create an empty model. sizes: (v,) bytes of each row."""
        self._sizes, self._budget = sizes.tolist(), budget
        self.resident: OrderedDict[int, None] = OrderedDict()  # most recently used at the end
        self.evicted: OrderedDict[int, None] = OrderedDict()  # most recently evicted at the end
        self.bytes = 0

    def use(self, rows: Iterable[int]) -> None:
        """Request rows together: load absent rows, and evict the least recently used others."""
        wanted = list(rows)
        for row in wanted:
            if row not in self.resident:
                self.bytes += self._sizes[row]
                self.evicted.pop(row, None)
            self.resident[row] = None
            self.resident.move_to_end(row)
        while self.bytes > self._budget and len(self.resident) > len(wanted):
            row = next(iter(self.resident))
            del self.resident[row]
            self.bytes -= self._sizes[row]
            self.evicted[row] = None


class Adversary:
    """Chooses the next position such that an evicted row is needed. All users of a process share one."""

    def __init__(self, boxes: Floats, model: LruModel, center: Floats, reach: float) -> None:
        """Create an adversary.

        boxes: (v, 2, 3) of each voxel's points, world [m].
        center, reach: of the avatar's root sphere [m].
        """
        self._boxes, self._model = boxes, model
        self._center, self._reach = center, reach
        self._fresh = 0  # rows below have been requested once
        self._needed: dict[int, list[int]] = {}

    def pose(self, recent: bool) -> Floats:
        """Return the next pose (4, 4).

        recent: at the row evicted most recently, else at the row evicted first.
        Initially it visits one voxel after the other, until as many are evicted as the cache holds:
        the first and the last evicted rows then differ.
        """
        model = self._model
        if self._fresh < len(self._boxes) and len(model.evicted) < max(1, len(model.resident)):
            row = self._fresh
            self._fresh += 1
        elif model.evicted:
            row = next(reversed(model.evicted) if recent else iter(model.evicted))
        else:  # the cache holds them all
            row = self._fresh = self._fresh % len(self._boxes)
            self._fresh += 1
        self._model.use(self.needed(row))
        pose = np.eye(4)
        pose[:3, 3] = self._middle(row) - self._center
        return pose

    def _middle(self, row: int) -> Floats:
        return self._boxes[row].mean(axis=0)

    def needed(self, row: int) -> list[int]:
        """Return the rows that a position in the middle of this row needs, the row itself included."""
        if row not in self._needed:
            middle = self._middle(row)
            gap = np.maximum(0.0, np.maximum(self._boxes[:, 0] - middle, middle - self._boxes[:, 1]))
            self._needed[row] = np.flatnonzero((gap**2).sum(axis=1) <= self._reach**2).tolist()
        return self._needed[row]


def make_adversary(archive: Path, budget: int, avatar: AvatarModel) -> Adversary:
    """Create an adversary for the voxels of an archive, against a cache of `budget` bytes."""
    voxels = read_voxels(archive)
    reach = float(avatar.arrays.radius[0]) + avatar.radius + voxels.radius
    return Adversary(voxels.boxes, LruModel(voxels.sizes, budget), avatar.arrays.center[0], reach)
