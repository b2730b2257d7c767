"""Adding and removing scans: makes a new generation of an archive.

Only the affected voxels are rebuilt. added_scans.py prepares the scans to add, removed_scans.py
selects those to remove, rebuild_voxels.py rebuilds the voxels, and archive_change.py publishes the
result.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from ...schemas.errors import BadRequestError, ScanError
from ..resume.build_identity import changed_inputs, describe_build
from ..run.executor import Progress
from ..sources.scan_files import open_input_files
from ..sources.scan_warnings import step_warning, unit_warnings
from ..spool.spool import Spool
from .added_scans import AddOptions, box_of, no_longer_unknown, source_of, spool_added, survey_added
from .archive_change import changing, scan_name
from .rebuild_voxels import ChangeSpec, ChangeSummary, rebuild
from .removed_scans import find_removed, rows_of

# Marks a removed scan, which keeps its row, so that the numbers of the others stay the same.
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
    """Add scans to the archive in `target`, with its lattice, options and stored `radius`.

    again: also add scans that the archive already contains.  new_only: skip those instead.
    strict: refuse a scan with points that are not finite, or beyond 1e9 m.

    The records equal those of a build of all scans on the same lattice, except for the numbers of
    the new scans, which follow the existing ones. Raise ScanError for an unusable scan,
    BadRequestError for a scan that the archive already contains, FormatError and CorruptError if
    the archive cannot be read or if the data read back differ from the data written. After an error
    the archive is unchanged.
    """
    if again and new_only:
        raise BadRequestError(
            "--new and --again together: expected one of them: skip scans already in the archive, or add them twice?"
        )
    with changing(Path(target), jobs, memory_bytes, progress) as change:
        inputs = open_input_files(
            paths, change.config.spacing, change.config.keep, change.config.drop_classes
        )
        what = describe_build(inputs, change.config)

        def check_unchanged() -> None:
            """Raise ScanError if a file changed: its hash may not match the points read later."""
            if changed := changed_inputs(inputs, change.config, what):
                raise ScanError(
                    f"{changed}: changed while it was read, expected files that stay as they are: add it again"
                )

        if change.reads_all:
            change.readers(change.points)  # refuse early: a voxel that is too large does not shrink
        surveys = survey_added(change, inputs, AddOptions(again, new_only, strict))
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
        spec = ChangeSpec(header, names, boxes, places=places, added=counts)
        summary = rebuild(change, spec, check_unchanged)
        notes = [item.note for item in inputs if item.note]
        notes += [note for survey in surveys if survey.scan is not None for note in survey.scan.notes]
        units = unit_warnings([survey.scan for survey in surveys if survey.scan is not None])
        notes += [each.text for each in units]
        coarse = step_warning([survey.facts for survey in surveys], header.lattice.step)
        return summary._replace(warnings=(*notes, *summary.warnings, *coarse))


def remove_scans(
    target: Path,
    scans: Sequence[str],
    *,
    jobs: int = 0,
    memory_bytes: int = 2 << 30,
    progress: Progress | None = None,
) -> ChangeSummary:
    """Remove scans from the archive in `target`, which must have been built with `keep` of "scan".

    scans: each is the path of a source in the index (for all scans of the file), PATH[INDEX], or
    the row of a source. A removed source keeps its row, without points, so that the numbers of the
    others stay the same. Raise BadRequestError for a scan that is not in the archive and for
    removing all remaining scans, FormatError and CorruptError if the archive cannot be read. After
    an error the archive is unchanged.
    """
    with changing(Path(target), jobs, memory_bytes, progress) as change:
        header = change.archive.header
        if not header.scan_index:
            raise BadRequestError(
                f"{target}: built without --keep scan, so the points do not record their scan: build again with "
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
        return rebuild(change, ChangeSpec(replace(header, sources=sources), names, boxes, rows))
