"""Store that reads and decodes voxels of an archive into the arena. It remembers none, and no failure.

Thread-safe. voxel_cache.py calls it, and remembers what is resident and what could not be loaded.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.archive import Archive
from ...schemas.archive.level import NODE_CLASS
from ...schemas.archive.voxel import top_shift
from ..kernels.core.node_bounds import lay_boxes
from ..kernels.core.scene_arrays import (
    LANES,
    Arena,
    block_words,
    lay_classes,
    lay_node_class,
    lay_out,
    resident_bytes,
    scan_run,
)


class VoxelStore:
    """Voxels of an archive by index row.

    archive: see schemas/archive/archive.py.  sizes: (v,) int64, bytes of each decoded voxel.
    is_as_stored: whether the points are all of the archive's, which its level describes.
    """

    is_as_stored = True

    def __init__(
        self,
        folder: str | Path,
        open_archive: Callable[[str | Path], Archive] = Archive,
    ) -> None:
        """Open the archive in `folder` with `open_archive`. Raise FormatError or CorruptError."""
        self.archive = open_archive(folder)
        rows, header = self.archive.voxels, self.archive.header
        # Nodes of a level enclose points that the level does not hold; an archive without slabs has the
        # paper's spheres alone, for comparison.
        self._with_boxes = bool(header.options.get("with_slab", True)) and not header.is_level
        self.sizes = resident_bytes(
            rows["rows"][:, 1].astype(np.int64),
            rows["leaves"].astype(np.int64),
            with_scan=header.scan_index,
            with_class=header.radius_class,
        )

    def hides(
        self, points: NDArray[np.float64], radii: NDArray[np.float64] | float = 0.0
    ) -> NDArray[np.bool_]:
        """Return which spheres (n,) this store leaves out: none.

        points: (n, 3), archive frame [m].  radii: (n,) or all of them [m].
        """
        return np.zeros(len(points), bool)

    def load(self, row: int, arena: Arena, offset: int) -> NDArray[np.int64]:
        """Read, check and lay out the voxel of index row `row` at byte `offset` of the arena.

        Return the offsets of its runs (3,) int64, see scene_arrays.py. Raise CorruptError or
        OSError.
        """
        record = self.archive.open_voxel(row)
        leaves = record.leaves
        where = np.empty(3, np.int64)
        shift = np.int64(top_shift(record.voxel_steps))
        voxel = (record.cells, record.nodes, shift)
        header = self.archive.header
        words = block_words(header.radius_class)
        lay_out(voxel, record.tree, arena, np.int64(offset), words, where)
        lanes = arena.halves[where[2] :]
        with self.archive.locating(row):
            record.read_points(lanes[: leaves * 3 * LANES].reshape(leaves, 3, LANES))
        if self._with_boxes:
            lay_boxes(len(record.links.first), words, header.lattice.step, arena, where)
        if header.radius_class:
            classes = np.empty((leaves, LANES), np.uint8)
            with self.archive.locating(row):
                record.read_classes(classes)
            lay_classes(record.tree, classes, arena.ints, where)
            if header.is_level:
                lay_node_class(len(record.links.first), NODE_CLASS, arena.ints, where)
        if header.scan_index:
            scans = arena.halves[scan_run(where[None], 0, words) :]
            record.read_scans(scans[: leaves * LANES].reshape(leaves, LANES))
        return where

    def close(self) -> None:
        """Close the archive's files."""
        self.archive.close()


# Function that opens the archive in a folder.
OpenStore = Callable[[str | Path], VoxelStore]
