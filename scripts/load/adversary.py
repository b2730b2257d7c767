"""A user who always asks for what was evicted: most recently, or longest ago. It keeps an LRU of its own to know.

The cache it works against may evict otherwise; then what it asks for is still what least recent use would have let go.
Its poses stand in the middle of a voxel's points and not on a floor. What was asked is recorded as a trace.
"""

from collections import OrderedDict
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from solidcloud.server.avatar import AvatarModel

from .voxels import read_voxels

Floats = NDArray[np.float64]


class LruModel:
    """Least recently used rows go first, never more than `budget` bytes; and which were evicted, in what order."""

    def __init__(self, sizes: NDArray[np.int64], budget: int) -> None:
        """sizes: (v,) bytes of each row."""
        self._sizes, self._budget = sizes.tolist(), budget
        self.resident: OrderedDict[int, None] = OrderedDict()  # used last at the end
        self.evicted: OrderedDict[int, None] = OrderedDict()  # evicted last at the end
        self.bytes = 0

    def use(self, rows: Iterable[int]) -> None:
        """Demand rows together: those that are not resident are loaded, and the oldest others make room."""
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
    """Where to stand next, so that what was evicted is needed. All users of a process share one."""

    def __init__(self, boxes: Floats, model: LruModel, center: Floats, reach: float) -> None:
        """boxes: (v, 2, 3) of each voxel's points, world [m].  center, reach: of the avatar's root sphere [m]."""
        self._boxes, self._model = boxes, model
        self._center, self._reach = center, reach
        self._fresh = 0  # rows below were asked for once
        self._needed: dict[int, list[int]] = {}

    def pose(self, recent: bool) -> Floats:
        """The next pose (4, 4). recent: at what was evicted last, else at what was evicted first.

        Before, one voxel after the other, until as many were evicted as there are in the cache: evicted first and
        evicted last are not the same then.
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
        """The rows that standing in the middle of this one needs, itself among them."""
        if row not in self._needed:
            middle = self._middle(row)
            gap = np.maximum(0.0, np.maximum(self._boxes[:, 0] - middle, middle - self._boxes[:, 1]))
            self._needed[row] = np.flatnonzero((gap**2).sum(axis=1) <= self._reach**2).tolist()
        return self._needed[row]


def make_adversary(archive: Path, budget: int, avatar: AvatarModel) -> Adversary:
    """One for the voxels of an archive, against a cache of `budget` bytes."""
    voxels = read_voxels(archive)
    reach = float(avatar.arrays.radius[0]) + avatar.radius + voxels.radius
    return Adversary(voxels.boxes, LruModel(voxels.sizes, budget), avatar.arrays.center[0], reach)
