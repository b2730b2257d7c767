"""Store of an archive without the points inside some boxes, for the effect `through`.

Answers are those of an archive whose scans never had these points. A point is in a box if its world
coordinates lie between low and high on each axis, both included. World coordinates are computed as
for every answer: `Lattice.to_world`, then the archive's pose (rigid_transform.py).

Points are masked when their voxel is loaded. A block keeps its other points, in their order. The
bounds above it stay: they enclose more than is left, so queries may visit more nodes. A node without
points is moved so far away that no query meets it. Voxels whose cell lies inside a box are left out
of the index. The other voxels keep their memory, and the header its bounds (`outside`), counts and
radius. Regions of scans that were left out remain unknown inside a box.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...schemas.errors import BadRequestError
from ..kernels.core.scene_arrays import (
    BLOCK_WORDS,
    COUNT,
    COUNTED,
    FIRST,
    LANES,
    ROW_WORDS,
    Arena,
    block_words,
)
from ..residency.arena import ArenaBuffer
from ..residency.voxel_store import VoxelStore
from .rigid_transform import archive_pose, transform_boxes, transform_points

# Upper bound of the rounding error of a transformed corner, relative to the largest coordinate. A
# larger value only makes more voxels be masked, point by point.
_ROUNDING = 1e-14
# Place of a node without points [steps]: its square fits float32, and no reach extends to it.
_FAR_AWAY = np.float32(1 << 40)


class MaskedStore(VoxelStore):
    """Voxels of an archive without the points inside some boxes."""

    is_as_stored = False

    def __init__(self, folder: str | Path, boxes: Sequence[ArrayLike], pose: ArrayLike | None = None) -> None:
        """Open the archive in `folder`, at `pose` in the world; None: at the identity.

        boxes: (2, 3) each, low and high, world [m].
        Raise FormatError or CorruptError as `VoxelStore` does, BadRequestError if the boxes contain
        all voxels, and for a pose that is not rigid.
        """
        self._boxes = [np.asarray(box, np.float64) for box in boxes]
        self._pose = archive_pose(pose)
        super().__init__(folder)
        archive, steps = self.archive, self.archive.header.lattice.voxel_steps
        base = archive.coordinates * steps
        try:
            # A voxel inside is never read, so nothing would show that its box in the index is too small:
            # its whole cell counts.
            kept = ~self._are_inside(*self._world_boxes(base, base + (steps - 1)))
            if not kept.any():
                raise BadRequestError(
                    f"{folder}: the boxes of the effect `through` contain all of its points: leave the archive out of "
                    "the scene, or give smaller boxes"
                )
            self._meets = self._meets_box(base + archive.voxels["low"], base + archive.voxels["high"])[kept]
        except BaseException:
            self.close()
            raise
        archive.voxels, archive.coordinates = archive.voxels[kept], archive.coordinates[kept]
        self.sizes = self.sizes[kept]

    def _are_inside(self, low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which world boxes, low and high (n, 3) each, lie inside a box [m]."""
        found = np.zeros(len(low), bool)
        for least, greatest in self._boxes:
            found |= ((low >= least) & (high <= greatest)).all(axis=1)
        return found

    def _meets_box(self, low: NDArray[np.int64], high: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return which lattice boxes, low and high (n, 3) each, may have points in a box."""
        world_low, world_high = self._world_boxes(low, high)
        found = np.zeros(len(low), bool)
        for least, greatest in self._boxes:
            found |= ((world_low <= greatest) & (world_high >= least)).all(axis=1)
        return found

    def _world_boxes(
        self, low: NDArray[np.int64], high: NDArray[np.int64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return world boxes [m] that enclose lattice boxes, low and high (v, 3) each."""
        lattice = self.archive.header.lattice
        world = lattice.to_world(low), lattice.to_world(high)
        if self._pose is None:
            return world
        far = max(float(np.abs(side).max()) for side in (*world, self._pose[:3, 3]))
        least, greatest = transform_boxes(self._pose, *world)
        return least - far * _ROUNDING, greatest + far * _ROUNDING

    def hides(
        self, points: NDArray[np.float64], radii: NDArray[np.float64] | float = 0.0
    ) -> NDArray[np.bool_]:
        """Return which spheres (n,) lie in a box. points: (n, 3), archive frame [m].  radii: (n,) [m]."""
        world = points if self._pose is None else transform_points(self._pose, points)
        around = np.asarray(radii)[..., None]
        return self._are_inside(world - around, world + around)

    def count_hidden(self) -> int:
        """Return the number of points in the boxes. Raise CorruptError or OSError.

        The voxels that a box meets are read.
        """
        found = self.archive.header.points
        found -= int(self.archive.voxels["rows"][:, 2].sum(dtype=np.int64))
        for row in np.flatnonzero(self._meets).tolist():
            arena = ArenaBuffer(ArenaBuffer.rounded(int(self.sizes[row]))).arena
            blocks, _ = self._blocks(row, arena, self.load(row, arena, 0))
            found += int(self.archive.voxels["rows"][row, 2]) - int(blocks[:, 3].sum())
        return found

    def load(self, row: int, arena: Arena, offset: int) -> NDArray[np.int64]:
        """Read and lay out a voxel as `VoxelStore.load` does, without the points inside the boxes."""
        where = super().load(row, arena, offset)
        if self._meets[row]:
            self._mask(row, arena, where)
        return where

    def _blocks(
        self, row: int, arena: Arena, where: NDArray[np.int64]
    ) -> tuple[NDArray[np.int32], NDArray[np.uint16]]:
        """Return the blocks (b, words) and lanes (b, 3, LANES) of a voxel in the arena."""
        leaves = int(self.archive.voxels["leaves"][row])
        words = block_words(self.archive.header.radius_class)
        lanes = arena.halves[where[2] :][: leaves * 3 * LANES].reshape(leaves, 3, LANES)
        return arena.ints[where[1] :][: leaves * words].reshape(leaves, words), lanes

    def _mask(self, row: int, arena: Arena, where: NDArray[np.int64]) -> None:
        """Remove the points inside the boxes from a voxel in the arena.

        where: (3,), its runs, see scene_arrays.py.
        """
        header, (blocks, lanes) = self.archive.header, self._blocks(row, arena, where)
        low = blocks[:, :3] + self.archive.coordinates[row] * header.lattice.voxel_steps
        chosen = np.flatnonzero(self._meets_box(low, low + lanes.max(axis=2)))
        steps = (low[chosen, :, None] + lanes[chosen]).transpose(0, 2, 1).reshape(-1, 3)
        hidden = self.hides(header.lattice.to_world(steps)).reshape(-1, LANES)
        hidden |= np.arange(LANES) >= blocks[chosen, 3, None]  # lanes after the last point repeat it
        counts = LANES - hidden.sum(axis=1)
        # The points that stay come first, and the last of them is repeated.
        taken = np.argsort(hidden, axis=1, kind="stable")
        taken = np.take_along_axis(taken, np.minimum(np.arange(LANES), counts[:, None] - 1), axis=1)
        lanes[chosen] = np.take_along_axis(lanes[chosen], taken[:, None], axis=2)
        if header.radius_class:
            classes = blocks[:, BLOCK_WORDS:].view(np.uint8)
            classes[chosen] = np.take_along_axis(classes[chosen], taken, axis=1)
        if header.scan_index:
            scans = arena.halves[where[2] + lanes.size :][: len(lanes) * LANES].reshape(-1, LANES)
            scans[chosen] = np.take_along_axis(scans[chosen], taken, axis=1)
        blocks[chosen, 3] = counts
        _remove_nodes(arena, where, blocks[:, 3])


def _remove_nodes(arena: Arena, where: NDArray[np.int64], counts: NDArray[np.int32]) -> None:
    """Write the numbers of points (b,) of a voxel's blocks into its nodes; move empty nodes far away."""
    ints, words = (view[where[0] : where[1]].reshape(-1, ROW_WORDS) for view in (arena.ints, arena.words))
    leaves = np.flatnonzero(ints[:, FIRST] < 0)
    held = counts[~ints[leaves, FIRST]]
    ints[leaves, COUNT] = ints[leaves, COUNT] & ~COUNTED | held
    inner = np.flatnonzero(ints[:, FIRST] >= 0)
    parent, children = np.zeros(len(ints), np.int64), ints[inner, COUNT] & COUNTED
    begins = np.repeat(ints[inner, FIRST] - np.cumsum(children) + children, children)
    parent[begins + np.arange(len(begins))] = np.repeat(inner, children)
    is_empty = np.ones(len(ints), bool)
    alive = leaves[held > 0]
    while is_empty[alive].any():  # up to the root, which is its own parent
        is_empty[alive] = False
        alive = np.unique(parent[alive])
    words[is_empty, : ROW_WORDS - 2] = 0.0
    words[is_empty, :3], words[is_empty, 7] = _FAR_AWAY, np.finfo(np.float32).tiny
