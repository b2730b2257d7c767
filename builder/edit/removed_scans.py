"""Selection of the scans to remove from an archive, and search for the voxels with their points."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ...schemas.archive.index import Source
from ...schemas.errors import BadRequestError, CorruptError
from .archive_change import Change, scan_name
from .stored_points import FindUnit, VoxelOfScans, find_scans


def rows_of(sources: Sequence[Source], scans: Sequence[str], target: Path) -> frozenset[int]:
    """Return the rows of the sources that `scans` names.

    Raise BadRequestError for a scan that is not in the archive, and for removing all scans.
    """
    held = {row: s for row, s in enumerate(sources) if not s.fault}
    rows: set[int] = set()
    for text in scans:
        wanted = {row for row, s in held.items() if text in (s.path, scan_name(s), f"{s.path} [{s.index}]")}
        if not wanted and text.isdecimal() and int(text) in held:
            wanted = {int(text)}
        if not wanted:
            there = ", ".join(f"{row}: {scan_name(s)}" for row, s in list(held.items())[:10])
            more = f" and {len(held) - 10} more (solidcloud info)" if len(held) > 10 else ""
            raise BadRequestError(f"{target}: {text} is not a scan of this archive, which has {there}{more}")
        rows |= wanted
    if not rows:
        raise BadRequestError(f"{target}: no scan is named: name at least one")
    if not any(s.count for row, s in held.items() if row not in rows):
        raise BadRequestError(f"{target}: nothing would be left: remove the folder, or leave a scan in")
    return frozenset(rows)


def find_removed(change: Change, scans: frozenset[int]) -> list[VoxelOfScans]:
    """Find the voxels that hold points of these scans.

    Raise CorruptError unless all of their points are found.
    """
    archive = change.archive
    rows = np.arange(len(archive.voxels))
    units = [FindUnit(change.target, held, points, scans) for held, points in change.units_of(rows)]
    with change.reading(change.points), change.stage("find", archive.header.points, "points"):
        found: list[VoxelOfScans] = [voxel for part in change.run(find_scans, units) for voxel in part]
    for scan in sorted(scans):
        count, stored = sum(f.counts.get(scan, 0) for f in found), archive.header.sources[scan].count
        if count != stored:
            raise CorruptError(
                f"{change.target}: {count} points of scan {scan}, the index says {stored}: see solidcloud validate"
            )
    return found
