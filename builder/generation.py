"""One generation more of an archive: scans added or removed, and only the voxels built that this touches.

What is added is added.py's, what is removed removed.py's; both are built by rebuild.py, and put in the old one's place
by change.py.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from ..schemas.errors import BadRequestError, ScanError
from .added import Wanted, box_of, no_longer_unknown, source_of, spool_added, survey_added
from .change import changing, scan_name
from .pipeline import open_inputs
from .progress import Progress
from .rebuild import ChangeSummary, Difference, rebuild
from .removed import find_removed, rows_of
from .resume import changed_inputs, described
from .spool import Spool

# What removing a scan leaves in its place, so that the numbers of the others stay.
REMOVED = "removed"


def add_scans(
    target: Path,
    paths: Sequence[Path],
    *,
    again: bool = False,
    new_only: bool = False,
    strict: bool = False,
    jobs: int = 0,
    memory_bytes: int = 2 << 30,
    progress: Progress | None = None,
) -> ChangeSummary:
    """Add scans to the archive in `target`: on its lattice, with its options, `radius` as it is stored.

    again: also scans that are in already; new_only: leave those out instead.  strict: refuse a scan with points that
    are not finite. The records are those that a build of all scans would have, on the same lattice and but for the
    numbers of scans, which go on from those there are. ScanError for a scan that cannot be used, BadRequestError for
    one that is in already, FormatError and CorruptError for an archive that cannot be read, or records that read back
    otherwise than they were written; the archive is then what it was.
    """
    if again and new_only:
        raise BadRequestError(
            "--new and --again together: expected one: is a scan that is in left out, or had twice?"
        )
    with changing(Path(target), jobs, memory_bytes, progress) as change:
        inputs = open_inputs(paths, change.config)
        what = described(inputs, change.config)

        def check_unchanged() -> None:
            """A scan's hash need not go with the points that were read of it later."""
            if changed := changed_inputs(inputs, change.config, what):
                raise ScanError(
                    f"{changed}: changed while it was read, expected files that stay as they are: add it again"
                )

        if change.reads_all:
            change.readers(change.points)  # voxels that are too large now do not get smaller
        surveys = survey_added(change, inputs, Wanted(again, new_only, strict))
        try:
            moved, places = spool_added(change, surveys)
        except ScanError:
            check_unchanged()
            raise
        check_unchanged()
        added = tuple(source_of(survey) for survey in surveys)
        header = no_longer_unknown(change.archive.header, surveys)
        header = replace(header, sources=(*header.sources, *added), moved_max=max(header.moved_max, moved))
        new = Spool(change.folder / "spool", change.dtype, header.lattice)
        counts = dict(zip(new.keys.tolist(), new.counts.tolist(), strict=True))
        boxes = {key: box_of(key, new) for key in counts}
        names = tuple(scan_name(source) for source in added)
        return rebuild(change, Difference(header, names, boxes, places=places, added=counts), check_unchanged)


def remove_scans(
    target: Path,
    scans: Sequence[str],
    *,
    jobs: int = 0,
    memory_bytes: int = 2 << 30,
    progress: Progress | None = None,
) -> ChangeSummary:
    """Remove scans from the archive in `target`, which must have been built with `keep` of "scan".

    scans: each a source's path as the index has it (all scans of a file of several), or PATH[INDEX], or its row. A
    source stays in its row, with no points, so that the numbers of the others stay. BadRequestError for a scan that is
    not in, and for the last ones; FormatError and CorruptError for an archive that cannot be read; the archive is then
    what it was.
    """
    with changing(Path(target), jobs, memory_bytes, progress) as change:
        header = change.archive.header
        if not header.scan_index:
            raise BadRequestError(
                f"{target}: built without --keep scan, so no point says which scan it is of: build again with "
                "it, or of the scans that are to stay"
            )
        rows = rows_of(header.sources, scans, target)
        found = find_removed(change, rows)
        boxes = {int(change.archive.voxels["key"][f.row]): f.box for f in found}
        sources = tuple(
            replace(s, count=0, fault=f"{scan_name(s)}: {REMOVED} in generation {header.generation + 1}")
            if row in rows
            else s
            for row, s in enumerate(header.sources)
        )
        names = tuple(scan_name(header.sources[row]) for row in sorted(rows))
        return rebuild(change, Difference(replace(header, sources=sources), names, boxes, rows))
