"""Index row -> decoded voxel, written into the arena. Safe to call from several threads."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..schemas.archive import Archive
from ..schemas.errors import CorruptError
from ..schemas.voxel import top_shift
from .kernels.front import MOST_LEVELS
from .kernels.layout import (
    LANES,
    Arena,
    block_words,
    lay_classes,
    lay_out,
    resident_bytes,
    scan_run,
)


class Store:
    """An archive's voxels by index row.

    archive: see schemas/archive.py.  sizes: (v,) int64, bytes of each voxel once decoded.
    """

    def __init__(self, folder: str | Path, open_archive: Callable[[str | Path], Archive] = Archive) -> None:
        """Open the archive in `folder`; open_archive: how. Raises FormatError or CorruptError."""
        self.archive = open_archive(folder)
        rows, header = self.archive.voxels, self.archive.header
        self.sizes = resident_bytes(
            rows["rows"][:, 1].astype(np.int64),
            rows["leaves"].astype(np.int64),
            with_scan=header.scan_index,
            with_class=header.radius_class,
        )

    def load(self, row: int, arena: Arena, offset: int) -> NDArray[np.int64]:
        """Read, check and lay out the voxel of index row `row` at byte `offset` of the arena.

        Returns where its runs are (3,) int64, see layout.py. Raises CorruptError, OSError.
        """
        return self.decode(row, self.archive.read_frames(row), arena, offset)

    def decode(
        self, row: int, frames: tuple[bytes, bytes, bytes], arena: Arena, offset: int
    ) -> NDArray[np.int64]:
        """`load` from the frames already read (`Archive.read_frames`), for the benchmark to time alone."""
        record = self.archive.open_voxel(row, frames)
        links, leaves = record.links, record.leaves
        if leaves != int(self.archive.voxels["leaves"][row]):
            raise CorruptError(
                f"{self.archive.where(row)}: {leaves} leaf nodes, the index says otherwise: rebuild it"
            )
        if links.height > MOST_LEVELS:
            raise CorruptError(
                f"{self.archive.where(row)}: {links.height} levels, expected at most {MOST_LEVELS}: rebuild it"
            )
        where = np.empty(3, np.int64)
        shift = np.int64(top_shift(record.voxel_steps))
        voxel = (record.cells, record.nodes, shift)
        header = self.archive.header
        words = block_words(header.radius_class)
        lay_out(voxel, record.tree, arena, np.int64(offset), words, where)
        lanes = arena.halves[where[2] :]
        with self.archive.locating(row):
            record.read_points(lanes[: leaves * 3 * LANES].reshape(leaves, 3, LANES))
        if header.radius_class:
            classes = np.empty((leaves, LANES), np.uint8)
            with self.archive.locating(row):
                record.read_classes(classes)
            lay_classes(record.tree, classes, arena.ints, where)
        if header.scan_index:
            scans = arena.halves[scan_run(where[None], 0, words) :]
            record.read_scans(scans[: leaves * LANES].reshape(leaves, LANES))
        return where

    def close(self) -> None:
        """Close the archive's files."""
        self.archive.close()


# Opens the archive in a folder.
OpenStore = Callable[[str | Path], Store]
