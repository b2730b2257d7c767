"""Sealing of an archive and its level: digests of their records in the index, and an HMAC beside it.

The records are not changed. The level is sealed before the archive, and in each the index before
the HMAC. A seal that does not belong to its index is refused by a reader with the key, so that an
archive whose sealing was interrupted counts as not sealed, and is readable as before without a key.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from ...schemas.archive.archive import Archive, read_index
from ...schemas.archive.archive_writer import write_columns
from ...schemas.archive.index import INDEX_NAME, RECORD_DIGEST, SEALED_VERSION
from ...schemas.archive.level import open_level
from ...schemas.archive.seal import SEAL_NAME, make_seal, record_digests
from ...schemas.process.interrupts import check_interrupt
from ...schemas.process.new_file import new_file
from ..resume.lock import locked
from ..run.executor import Progress, Silent


class SealSummary(NamedTuple):
    """Result of sealing. voxels: of archive and level.  bytes: of their records."""

    archive: Path
    voxels: int
    bytes: int
    with_level: bool


def seal_archive(target: Path, key: bytes, progress: Progress | None = None) -> SealSummary:
    """Seal the archive in `target` with a key, in place of an earlier seal if there is one.

    Every record is read and decompressed first: a seal vouches for what is there. A level of
    another generation, which readers ignore, is not sealed. Raise FormatError or CorruptError if
    the archive cannot be read.
    """
    progress = progress or Silent()
    target = Path(target)
    with locked(target), Archive(target) as archive:
        level = open_level(archive)
        opened = [archive] if level is None else [level, archive]
        try:
            total = sum(int(each.voxels["frame_bytes"].sum(dtype=np.int64)) for each in opened)
            progress.start("seal", total, "bytes")
            for each in opened:
                _seal(each, key, progress)
            progress.finish()
            return SealSummary(target, sum(len(each.voxels) for each in opened), total, level is not None)
        finally:
            if level is not None:
                level.close()


def _seal(archive: Archive, key: bytes, progress: Progress) -> None:
    """Write the digests of the records of an archive, or of a level, and its seal."""
    digests = []
    for row in range(len(archive.voxels)):
        check_interrupt()
        frames = archive.read_frames(row)
        archive.open_voxel(row, frames)
        digests.append(record_digests(*frames))
        progress.advance(sum(map(len, frames)))
    found = read_index(archive.folder / INDEX_NAME)
    columns = {**found.columns, RECORD_DIGEST: np.stack(digests)}
    digest = write_columns(archive.folder / INDEX_NAME, SEALED_VERSION, found.archive_id, columns)
    with new_file(archive.folder / SEAL_NAME) as file:
        file.write(make_seal(key, SEALED_VERSION, digest))
