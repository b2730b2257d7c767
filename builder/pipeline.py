"""Build of an archive from scans: survey, spool, voxels, radius, verify, publish.

builder/DESIGN.md lists what each pass holds. Everything is made in a hidden folder beside the
target and renamed at the end; the target name therefore never refers to part of an archive.
Finished work stays in the hidden folder when a build is interrupted, and the same command resumes
from it.
"""

import errno
import shutil
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..schemas.archive.archive import Archive
from ..schemas.archive.archive_writer import write_index
from ..schemas.archive.index import SHARD_FOLDER, Header
from ..schemas.archive.voxel_grid import Lattice
from ..schemas.archive.vtkhdf import PREVIEW_NAME
from ..schemas.errors import BadRequestError, CorruptError, FormatError, ScanError, SolidcloudError
from ..schemas.process.interrupts import check_interrupt
from ..schemas.process.os_errors import os_error_words
from .config import RADIUS_SAMPLE, BuildConfig
from .passes.build_shards import Shard
from .passes.dataset_header import archive_id, make_header
from .passes.filter_rules import filter_dtype, filter_passes
from .passes.point_spacing import archive_mean
from .passes.preview import write_preview
from .passes.resumable_passes import (
    build_shards,
    check_filters,
    filter_points,
    spool_rows,
    spool_scans,
    survey_scans,
)
from .passes.survey import Survey, choose_lattice
from .passes.verify import verify_archive
from .resume.build_directory import (
    Workplace,
    building_folder,
    check_target,
    forget_finished,
    locked,
    made_parents,
    publish_folder,
    recover,
    workplace,
)
from .resume.build_identity import changed_inputs, described, is_whole
from .run.executor import Executor, worker_count
from .run.make_executor import make_executor
from .run.memory_shares import jobs_that_fit, readers_that_fit
from .run.progress import Progress, Silent
from .run.stages import Stages
from .sources.coincident_scans import coincident_sources, coincident_text
from .sources.scan_files import InputFile, open_input_files
from .spool.spool import Spool, spool_dtype
from .voxel.dense_voxel import DENSE_POINTS

# Most bytes per point on disk at the end (the target is 5 at 0.1 mm). A build that cannot fit is
# refused.
ARCHIVE_BYTES_A_POINT = 6
# Additional bytes per point of a dense voxel while it is built (dense_voxel.py); each job builds at most
# one.
SCRATCH_BYTES_A_POINT = 21
# Approximate bytes per point of a file whose header does not declare their number: text.
BYTES_A_POINT = 30
# The points of a record are numbered by int32 (schemas/archive/voxel.py Links).
MOST_POINTS = (1 << 31) - 1
# Points that become one by quantising are detected late, identical points at once.
ONE_POINT = "a single distinct point has no closest point: give --radius"


class BuildSummary(NamedTuple):
    """Result of a build.

    bytes: of index and shards.  preview_bytes: of the preview, 0 if it was deleted.
    stages: seconds of each stage.  skipped: reason -> points left out.
    lattice_step, moved_max, radius, radius_error: [m], see schemas/archive/index.py Header.
    faults: of the scans left out.
    already: nothing was built, because the archive existed already, with the same scans and
    options.
    warnings: sentences about scans that are in the archive and look wrong.
    """

    archive: Path
    points: int
    voxels: int
    shards: int
    bytes: int
    preview_bytes: int
    seconds: float
    stages: dict[str, float]
    lattice_step: float
    lattice_source: str
    moved_max: float
    radius: float
    radius_error: float
    skipped: dict[str, int]
    faults: tuple[str, ...]
    already: bool = False
    warnings: tuple[str, ...] = ()


def build_archive(
    paths: Sequence[Path], target: Path, config: BuildConfig, progress: Progress | None = None
) -> BuildSummary:
    """Build an archive in the folder `target` from scan files and folders.

    If an earlier build of the target was interrupted, resume it.

    The archive's bytes depend on the points, the contents of the files, the paths as given (in the
    index alone) and the options in `config.identity()`. They do not depend on the order of paths,
    the number of jobs, the memory bound, or how often the build was interrupted. An existing
    archive of the same scans and options is left as it is.

    Raise ScanError naming every unusable scan (`skip_bad` leaves these out and marks their region
    as unknown), and BadRequestError for impossible options. If the survey of a build that this call
    began detects the error, nothing is left behind. Raise SolidcloudError if the disk or a process
    fails. The finished work is then kept.
    """
    begin = time.perf_counter()
    target = Path(target)
    stages = Stages(progress or Silent())
    with made_parents(target), locked(target), _machine_errors(target):
        inputs = open_input_files(paths, config.spacing)
        what = described(inputs, config)
        recover(target)
        if not config.overwrite and not config.fresh and _is_whole(target, inputs, config, stages):
            forget_finished(target, what)
            with Archive(target) as archive:
                header, voxels, shards = archive.header, len(archive.voxels), archive.shard_count()
            return _summary(target, header, voxels, shards, begin, stages, already=True)
        check_target(target, config.overwrite)
        with workplace(target, what, fresh=config.fresh) as place:
            header, built = _build(inputs, what, place, target, config, stages)
            _check_unchanged(inputs, what, place, config)
            check_interrupt()
            with stages.timed("publish"):
                publish_folder(place.archive, target, config.overwrite)
    return _summary(target, header, sum(len(s.rows) for s in built), len(built), begin, stages)


def _build(
    inputs: Sequence[InputFile],
    what: Mapping[str, Any],
    place: Workplace,
    target: Path,
    config: BuildConfig,
    stages: Stages,
) -> tuple[Header, list[Shard]]:
    """Run all passes; `place.archive` then contains a verified archive."""
    about = sum(_about(item) for item in inputs)
    with make_executor(config, jobs_that_fit(worker_count(config.jobs, about), config)) as executor:
        place.staffed = True
        surveys, faulty = survey_scans(inputs, about, place, executor, config, stages)
        lattice, lattice_source = choose_lattice(surveys, config)
        _check_request(surveys, lattice, config)
        place.surveyed = True
        points = sum(s.count for s in surveys)
        dtype = spool_rows(config)
        final = points * (_run_bytes_a_point(config) + ARCHIVE_BYTES_A_POINT)
        _check_space(target.parent, place.folder, final)
        try:
            spooled = spool_scans(surveys, lattice, dtype, place, executor, config, stages)
        except ScanError:
            _check_unchanged(inputs, what, place, config)
            raise
        _check_unchanged(inputs, what, place, config)
        runs = [name for s in spooled for name in s.runs]
        places = sum(s.places for s in spooled) % (1 << 64)
        spool = Spool(place.folder / "spool", dtype, lattice, runs, places)
        spool, left_out = filter_points(spool, place, executor, config, stages)
        filtered = [
            {reason: of[number] for reason, of in left_out.items() if number in of}
            for number in range(len(surveys))
        ]
        final -= (points - int(spool.counts.sum())) * (spool.dtype.itemsize + ARCHIVE_BYTES_A_POINT)
        dense = np.sort(spool.counts[spool.counts > DENSE_POINTS])[-executor.jobs :]
        _check_space(target.parent, place.folder, final + int(dense.sum()) * SCRATCH_BYTES_A_POINT)
        _check_voxels(spool, config)
        readers = readers_that_fit(spool.counts, executor.jobs, config)
        identity = archive_id(spooled, lattice, config)
        shards = build_shards(spool, identity, place, executor, config, stages)
        moved_max = max(s.moved_max for s in spooled)
        header = make_header(
            surveys, faulty, filtered, lattice, lattice_source, identity, moved_max, shards, config
        )
        executor.at_once = readers
        header = _measure_radius(header, shards, place.archive, executor, config, stages)
        _read_back(place.archive, header.points, spool, executor, stages)
    return header, shards


def _check_request(surveys: Sequence[Survey], lattice: Lattice, config: BuildConfig) -> None:
    """Refuse a request that the survey shows to be impossible, before any work would be lost."""
    check_filters(config, lattice)
    low, high = np.min([s.low for s in surveys], axis=0), np.max([s.high for s in surveys], axis=0)
    if config.radius is None and (low == high).all():
        if (count := sum(s.count for s in surveys)) == 1:
            raise BadRequestError(ONE_POINT)
        first, others = surveys[0], len(surveys) - 1
        where = f"{first.path}{f' and {others} more scans' if others else ''}"
        raise ScanError(coincident_text(where, first.scan.index if first.scan else 0, count))


def _check_voxels(spool: Spool, config: BuildConfig) -> None:
    """Refuse a voxel with more points than a record can hold, before it costs hours."""
    most = int(spool.counts.max())
    if most > MOST_POINTS:
        raise SolidcloudError(
            f"a voxel of {config.voxel:g} m holds {most} points, expected at most {MOST_POINTS}: give a smaller "
            "--voxel and --fresh"
        )


def _check_unchanged(
    inputs: Sequence[InputFile], what: Mapping[str, Any], place: Workplace, config: BuildConfig
) -> None:
    """Raise ScanError and start over if a file changed since before it was read.

    What was read of it first, above all its hash, may not match what was read last. This is checked
    as soon as everything is read, and again before the archive gets its name: writes through a
    memory map, or on another host, may become visible late.
    """
    if changed := changed_inputs(inputs, config, what):
        place.start_over()
        raise ScanError(
            f"{changed}: changed while it was read, expected files that stay as they are: build again"
        )


def _read_back(folder: Path, points: int, spool: Spool, executor: Executor, stages: Stages) -> None:
    """Read back everything that was written, to make the preview and to verify every record.

    The points of the records must be those of the scans, because data on disk may change while in
    use. Raise CorruptError if anything differs.
    """
    fault = ""
    paths: tuple[Path, ...] = ()
    try:
        try:
            with stages.stage("preview", points, "points"):
                write_preview(folder, executor, stages.progress)
        except CorruptError as error:
            fault, paths = str(error), error.paths
        with stages.timed("verify"):
            report = verify_archive(folder, progress=stages.progress, executor=executor, places=spool.places)
        if report.faults:
            fault = report.faults[0]
            paths = (*map(Path, report.damaged), *((spool.folder,) if report.others else ()))
    except FormatError as error:  # a damaged index does not tell its cause: everything is rebuilt
        fault, paths = str(error), (*sorted((folder / SHARD_FOLDER).iterdir()), spool.folder)
    if fault:
        raise CorruptError(
            f"{fault}: the data read back differ from the data written: check disk and memory; the same command "
            "rebuilds what is damaged",
            paths,
        )


def _about(item: InputFile) -> int:
    """Estimate the number of points in a file."""
    declared = [scan.declared_count for scan in item.scans]
    if None not in declared:
        return sum(count or 0 for count in declared)
    return item.path.stat().st_size // BYTES_A_POINT


def _is_whole(target: Path, inputs: Sequence[InputFile], config: BuildConfig, stages: Stages) -> bool:
    """Return whether the archive is already complete."""
    if not target.is_dir():
        return False
    total = sum(item.path.stat().st_size for item in inputs if item.scans)
    with stages.stage("compare", total, "bytes"):
        return is_whole(target, inputs, config, stages.progress.advance)


def _summary(
    target: Path,
    header: Header,
    voxels: int,
    shards: int,
    begin: float,
    stages: Stages,
    *,
    already: bool = False,
) -> BuildSummary:
    """Make the summary of a complete archive."""
    sizes = {f.relative_to(target).as_posix(): f.stat().st_size for f in target.rglob("*") if f.is_file()}
    return BuildSummary(
        archive=target,
        points=header.points,
        voxels=voxels,
        shards=shards,
        bytes=sum(size for name, size in sizes.items() if name != PREVIEW_NAME),
        preview_bytes=sizes.get(PREVIEW_NAME, 0),
        seconds=time.perf_counter() - begin,
        stages=stages.seconds,
        lattice_step=header.lattice.step,
        lattice_source=header.lattice_source,
        moved_max=header.moved_max,
        radius=header.radius,
        radius_error=header.radius_error,
        skipped=dict(sum((Counter(s.skipped) for s in header.sources), Counter())),
        faults=tuple(s.fault for s in header.sources if s.fault),
        already=already,
        warnings=coincident_sources(header.sources),
    )


@contextmanager
def _machine_errors(target: Path) -> Iterator[None]:
    """Turn a disk or memory failure into an error that says what to do.

    The finished work stays in the hidden folder.
    """
    folder = building_folder(target)
    try:
        yield
    except MemoryError as error:
        raise SolidcloudError(
            f"{target}: out of memory ({error or 'no details'}): give fewer --jobs or a smaller --memory, or stop "
            f"other programs, then give the same command again: it resumes from the finished work in {folder}"
        ) from error
    except OSError as error:
        # HDF5 puts the errno into its message only.
        full = error.errno in (errno.ENOSPC, errno.EDQUOT) or f"errno = {errno.ENOSPC}" in str(error)
        found = os_error_words(OSError(errno.ENOSPC, "") if full else error)
        where = f" ({error.filename})" if error.filename else ""
        raise SolidcloudError(
            f"{target.parent}{where}: {found}, then give the same command again: it resumes from the finished work in "
            f"{folder}"
        ) from error


def _run_bytes_a_point(config: BuildConfig) -> int:
    """Return the bytes per point of all runs. Every filter pass is assumed to keep all points."""
    return filter_passes(config) * filter_dtype(config).itemsize + spool_dtype(config).itemsize


def _check_space(disk: Path, folder: Path, needed: int) -> None:
    """Refuse a build whose files do not fit on the disk.

    Files already in `folder` count as room.
    """
    there = sum(f.stat().st_size for f in folder.rglob("*") if f.is_file())
    free = shutil.disk_usage(disk).free
    if needed > free + there:
        raise SolidcloudError(
            f"{disk}: {free} bytes free, the build needs about {needed - there}: make room or use another disk"
        )


def _measure_radius(
    header: Header,
    shards: list[Shard],
    folder: Path,
    executor: Executor,
    config: BuildConfig,
    stages: Stages,
) -> Header:
    """Run the fourth pass: measure the mean closest-point distance, then write the final index."""
    rows = np.concatenate([s.rows for s in shards])
    names = [(s.name, s.size) for s in shards]
    if config.radius is not None:
        header = replace(header, radius=config.radius)
        write_index(folder, header, rows, names)
        return header
    write_index(folder, header, rows, names)  # for the workers; nothing else reads this folder
    with stages.stage("radius", header.points, "points"):
        found = archive_mean(folder, RADIUS_SAMPLE, executor, stages.progress)
    if found.sample == 0:
        raise BadRequestError(ONE_POINT)
    header = replace(header, radius=found.mean / 2, radius_error=found.error / 2, radius_sample=found.sample)
    write_index(folder, header, rows, names)
    return header
