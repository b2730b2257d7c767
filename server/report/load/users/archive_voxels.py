"""Voxels of an archive as a load test needs them: keys, positions of the points, decoded sizes."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....residency.arena import ArenaBuffer
from ....residency.voxel_store import VoxelStore


class Voxels(NamedTuple):
    """Voxels by index row.

    keys: (v,) uint64, ascending.
    boxes: (v, 2, 3) of each one's points, world [m].
    sizes: (v,) int64, bytes each takes in a cache.
    radius: of the scan's points [m].
    points: their number.
    """

    keys: NDArray[np.uint64]
    boxes: NDArray[np.float64]
    sizes: NDArray[np.int64]
    radius: float
    points: int = 0

    @property
    def decoded(self) -> int:
        """Return the total decoded bytes."""
        return int(self.sizes.sum())

    def rows(self, keys: NDArray[np.uint64]) -> NDArray[np.int64]:
        """Return the rows of the voxels of these keys; unknown keys are omitted."""
        at = np.searchsorted(self.keys, keys)
        known = at < len(self.keys)
        known[known] = self.keys[at[known]] == keys[known]
        return at[known]


def read_voxels(archive: Path) -> Voxels:
    """Read the voxels of the archive in this folder."""
    store = VoxelStore(archive)
    try:
        found, header = store.archive, store.archive.header
        lattice = header.lattice
        base = found.coordinates * lattice.voxel_steps
        corners = np.stack([base + found.voxels["low"], base + found.voxels["high"]], axis=1)
        boxes = corners * lattice.step + np.array(lattice.origin)
        sizes = np.array([ArenaBuffer.rounded(int(size)) for size in store.sizes], np.int64)
        keys = found.voxels["key"].astype(np.uint64)
        return Voxels(keys, boxes, sizes, float(header.radius), header.points)
    finally:
        store.close()
