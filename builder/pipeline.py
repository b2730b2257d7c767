"""Build of an archive from scans: survey, spool, voxels, radius, verify, publish.

builder/DESIGN.md lists the memory of each pass. The archive is made in a hidden folder beside the
target and renamed at the end. The target name therefore never refers to a partial archive. When a
build is interrupted, finished work stays in the hidden folder, and the same command resumes from
it.
"""

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from ..schemas.archive.archive import Archive
from ..schemas.archive.archive_writer import write_index
from ..schemas.archive.index import SHARD_FOLDER, Header
from ..schemas.archive.level import LEVEL_FOLDER
from ..schemas.archive.voxel_grid import Lattice
from ..schemas.archive.vtkhdf import PREVIEW_NAME
from ..schemas.errors import BadRequestError, CorruptError, FormatError, ScanError, SolidcloudError
from ..schemas.runtime.interrupts import check_interrupt
from .build_limits import (
    ARCHIVE_BYTES_A_POINT,
    DENSE_POINTS,
    MAX_RECORD_POINTS,
    RADIUS_SAMPLE,
    SCRATCH_BYTES_A_POINT,
    readers_that_fit,
)
from .config import SCAN_COLUMNS, BuildConfig
from .passes.build_shards import Shard, build_shards
from .passes.dataset_header import archive_id, make_header
from .passes.level_pass import write_level
from .passes.point_spacing import archive_mean
from .passes.preview import write_preview
from .passes.spool_pass import spool_scans
from .passes.survey_pass import Survey, choose_lattice, survey_scans
from .passes.verify import verify_archive
from .resume.build_identity import changed_inputs, describe_build, is_up_to_date
from .resume.kept_work import BuildDirectory, build_directory, building_folder, remove_finished_work
from .resume.lock import locked
from .resume.transaction import Transaction, check_target, made_parents, publish_folder, recover
from .run.executor import Progress
from .sources.coincident_scans import coincident_sources, coincident_text
from .sources.scan_files import InputFile, open_input_files
from .sources.scan_warnings import ScanFacts, find_warnings
from .spool.run_files import filter_dtype, spool_dtype
from .spool.spool import Spool

# Approximate bytes per point of a file whose header does not declare their number: text.
BYTES_A_POINT = 30
# Identical points are detected before the build, points that quantising makes equal only late.
ONE_POINT = "a single distinct point has no closest point: give --radius"


class BuildSummary(NamedTuple):
    """Result of a build.

    bytes: of index and shards.  preview_bytes, level_bytes: of the preview and of the level of
    detail, 0 if there is none.
    stages: seconds of each stage.  skipped: reason -> points left out.
    lattice_step, moved_max, radius, radius_error: [m], see schemas/archive/index.py Header.
    faults: faults of the scans that were left out.
    already: whether the archive with the same scans and options existed, so that nothing was built.
    warnings: lines about scans in the archive that are probably wrong.
    columns: kept column of the scans -> number of points whose scan has it; the others have zeros.
    """

    archive: Path
    points: int
    voxels: int
    shards: int
    bytes: int
    preview_bytes: int
    level_bytes: int
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
    columns: Mapping[str, int] = MappingProxyType({})


def build_archive(
    paths: Sequence[Path],
    target: Path,
    config: BuildConfig,
    progress: Progress | None = None,
    warn: Callable[[str], None] | None = None,
) -> BuildSummary:
    """Build an archive in the folder `target` from scan files and folders.

    If an earlier build of the target was interrupted, resume it.

    The archive's bytes depend on the points, the contents of the files, the paths as given (in the
    index alone) and the options in `config.identity()`. They do not depend on the order of paths,
    the number of jobs, the memory bound, or how often the build was interrupted. An existing
    archive of the same scans and options is left as it is.

    warn: receives each warning about the scans (scan_warnings.py) as soon as the survey shows it;
    the summary lists them too.

    Raise ScanError naming every unusable scan (`skip_bad` leaves these out and marks their region
    as unknown), and BadRequestError for impossible options. If the survey of a new build raises one
    of these, no files remain. Raise SolidcloudError if the disk or a process fails; finished work
    is then kept.
    """
    begin = time.perf_counter()
    target = Path(target)
    build = Transaction("build", target, building_folder(target), config, progress)
    with made_parents(target), locked(target), build.machine_errors():
        inputs = open_input_files(paths, config.spacing, config.keep, config.drop_classes)
        what = describe_build(inputs, config)
        recover(target)
        if not config.overwrite and not config.fresh and _is_whole(inputs, build):
            remove_finished_work(target, what)
            with Archive(target) as archive:
                header, voxels, shards = archive.header, len(archive.voxels), archive.shard_count()
            facts = [ScanFacts(scan) for item in inputs for scan in item.scans]
            found = _warn(inputs, facts, config, header.lattice.step, warn)
            return _summary(build, header, inputs, voxels, shards, begin, found, already=True)
        check_target(target, config.overwrite)
        with build_directory(target, what, fresh=config.fresh) as build_dir:
            header, built, found = _build(inputs, what, build_dir, build, warn)
            _check_unchanged(inputs, what, build_dir, config)
            check_interrupt()
            with build.timed("publish"):
                publish_folder(build_dir.archive, target, config.overwrite)
    return _summary(build, header, inputs, sum(len(s.rows) for s in built), len(built), begin, found)


def _build(
    inputs: Sequence[InputFile],
    what: Mapping[str, Any],
    build_dir: BuildDirectory,
    build: Transaction,
    warn: Callable[[str], None] | None,
) -> tuple[Header, list[Shard], tuple[str, ...]]:
    """Run all passes; `build_dir.archive` then contains a verified archive. Return the warnings too."""
    about, config = sum(_about(item) for item in inputs), build.config
    with build.workers(about):
        build_dir.staffed = True
        surveys, faulty = survey_scans(inputs, about, build_dir, build)
        facts = [s.facts for s in surveys]
        lattice, lattice_source = choose_lattice(surveys, facts, config)
        found = _warn(inputs, facts, config, lattice.step, warn)
        _check_request(surveys, lattice, config)
        build_dir.surveyed = True
        points = sum(s.count for s in surveys)
        dtype = filter_dtype(config) if config.filter_passes else spool_dtype(config)
        final = points * (_run_bytes_a_point(config) + ARCHIVE_BYTES_A_POINT)
        build.check_space(final, build_dir.folder)
        try:
            spooled = spool_scans(surveys, lattice, dtype, build_dir, build)
        except ScanError:
            _check_unchanged(inputs, what, build_dir, config)
            raise
        _check_unchanged(inputs, what, build_dir, config)
        runs = [name for s in spooled for name in s.runs]
        places = sum(s.places for s in spooled) % (1 << 64)
        spool = Spool(build_dir.folder / "spool", dtype, lattice, runs, places)
        spool, left_out = filter_points(spool, build_dir, build)
        filtered = [
            {reason: of[number] for reason, of in left_out.items() if number in of}
            for number in range(len(surveys))
        ]
        final -= (points - int(spool.counts.sum())) * (spool.dtype.itemsize + ARCHIVE_BYTES_A_POINT)
        dense = np.sort(spool.counts[spool.counts > DENSE_POINTS])[-build.executor.jobs :]
        build.check_space(final + int(dense.sum()) * SCRATCH_BYTES_A_POINT, build_dir.folder)
        _check_voxels(spool)
        if config.leaf_cells is not None:
            from .passes.cell_size import choose_cell_points  # most builds do not need its kernel

            build.config = config = replace(config, cell_points=choose_cell_points(spool, build))
        readers = readers_that_fit(spool.counts, build.executor.jobs, config)
        identity = archive_id(spooled, lattice, config)
        shards = build_shards(spool, identity, build_dir, build)
        moved_max = max(s.moved_max for s in spooled)
        header = make_header(
            surveys, faulty, filtered, lattice, lattice_source, identity, moved_max, shards, config
        )
        build.executor.at_once = readers
        header = _measure_radius(header, shards, build_dir.archive, build)
        _read_back(build_dir.archive, header.points, spool, build)
    return header, shards, found


def _warn(
    inputs: Sequence[InputFile],
    facts: Sequence[ScanFacts],
    config: BuildConfig,
    step: float,
    warn: Callable[[str], None] | None,
) -> tuple[str, ...]:
    """Return the warnings about the scans, and pass each to `warn`. step: of the lattice [m]."""
    notes = [item.note for item in inputs if item.note]
    found = (*notes, *(warning.text for warning in find_warnings(facts, config.radius, step)))
    if warn is not None:
        for text in found:
            warn(text)
    return found


def filter_points(
    spool: Spool, build_dir: BuildDirectory, build: Transaction
) -> tuple[Spool, dict[str, dict[int, int]]]:
    """Run the filter passes, if there are any.

    Return the spool and the points left out of each scan, by reason.
    """
    config = build.config
    if not config.filter_passes:
        return spool, {}
    from .passes.filter_pass import filtered_spool  # most builds do not need its kernels, which this loads

    with build.stage("filter", config.filter_passes * int(spool.counts.sum()), "points"):
        return filtered_spool(
            spool, config, build_dir.folder, build.executor, build.progress, build_dir.journal
        )


def _check_request(surveys: Sequence[Survey], lattice: Lattice, config: BuildConfig) -> None:
    """Refuse a request that the survey shows to be impossible, before any work would be lost."""
    if config.filter_passes:
        from .passes.filter_rules import make_rules  # most builds have no filters

        make_rules(config, lattice)
    low, high = np.min([s.low for s in surveys], axis=0), np.max([s.high for s in surveys], axis=0)
    if config.radius is None and (low == high).all():
        if (count := sum(s.count for s in surveys)) == 1:
            raise BadRequestError(ONE_POINT)
        first, others = surveys[0], len(surveys) - 1
        where = f"{first.path}{f' and {others} more scans' if others else ''}"
        raise ScanError(coincident_text(where, first.scan.index if first.scan else 0, count))


def _check_voxels(spool: Spool) -> None:
    """Refuse a voxel with more points than a record can hold, before hours of work on it."""
    most = int(spool.counts.max())
    if most > MAX_RECORD_POINTS:
        raise SolidcloudError(
            f"a voxel of {spool.lattice.voxel_size:g} m holds {most} points, expected at most {MAX_RECORD_POINTS}: "
            "give a smaller --voxel and --fresh"
        )


def _check_unchanged(
    inputs: Sequence[InputFile], what: Mapping[str, Any], build_dir: BuildDirectory, config: BuildConfig
) -> None:
    """Discard the build and raise ScanError if a file changed since before it was read.

    Data that was read first, such as its hash, may then not match data that was read last. The
    check is made when everything is read, and again before the archive gets its name, because
    writes through a memory map or on another host may become visible late.
    """
    if changed := changed_inputs(inputs, config, what):
        build_dir.start_over()
        raise ScanError(
            f"{changed}: changed while it was read, expected files that do not change: build again"
        )


def _read_back(folder: Path, points: int, spool: Spool, build: Transaction) -> None:
    """Read back everything that was written, to make level and preview and to verify every record.

    The records must contain the points of the scans: a disk may return other data than was written.
    Raise CorruptError if anything differs.
    """
    fault = ""
    paths: tuple[Path, ...] = ()
    try:
        try:
            if build.config.level:
                with build.stage("level", points, "points"):
                    write_level(folder, build.executor, build.progress)
            with build.stage("preview", points, "points"):
                write_preview(folder, build.executor, build.progress)
        except CorruptError as error:
            fault, paths = str(error), error.paths
        with build.timed("verify"):
            report = verify_archive(
                folder, progress=build.progress, executor=build.executor, places=spool.places
            )
        if report.faults:
            fault = report.faults[0]
            paths = (*map(Path, report.damaged), *((spool.folder,) if report.others else ()))
    except FormatError as error:  # the damage of an index may be anywhere: everything is rebuilt
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


def _is_whole(inputs: Sequence[InputFile], build: Transaction) -> bool:
    """Return whether the archive is already complete."""
    if not build.target.is_dir():
        return False
    total = sum(item.path.stat().st_size for item in inputs if item.scans)
    with build.stage("compare", total, "bytes"):
        return is_up_to_date(build.target, inputs, build.config, build.progress.advance)


def _summary(
    build: Transaction,
    header: Header,
    inputs: Sequence[InputFile],
    voxels: int,
    shards: int,
    begin: float,
    warnings: tuple[str, ...],
    *,
    already: bool = False,
) -> BuildSummary:
    """Make the summary of a complete archive."""
    target = build.target
    sizes = {f.relative_to(target): f.stat().st_size for f in target.rglob("*") if f.is_file()}
    preview, level = (
        sizes.pop(Path(PREVIEW_NAME), 0),
        [name for name in sizes if name.parts[0] == LEVEL_FOLDER],
    )
    level_bytes = sum(sizes.pop(name) for name in level)
    return BuildSummary(
        archive=target,
        points=header.points,
        voxels=voxels,
        shards=shards,
        bytes=sum(sizes.values()),
        preview_bytes=preview,
        level_bytes=level_bytes,
        seconds=time.perf_counter() - begin,
        stages=build.seconds,
        lattice_step=header.lattice.step,
        lattice_source=header.lattice_source,
        moved_max=header.moved_max,
        radius=header.radius,
        radius_error=header.radius_error,
        skipped=dict(sum((Counter(s.skipped) for s in header.sources), Counter())),
        faults=tuple(s.fault for s in header.sources if s.fault),
        already=already,
        warnings=(*warnings, *coincident_sources(header.sources)),
        columns=_column_counts(header, inputs, build.config),
    )


def _column_counts(header: Header, inputs: Sequence[InputFile], config: BuildConfig) -> dict[str, int]:
    """Return `BuildSummary.columns`."""
    points = {(source.path, source.index): source.count for source in header.sources}
    scans = [scan for item in inputs for scan in item.scans]
    return {
        name: sum(points.get((str(scan.path), scan.index), 0) for scan in scans if name in scan.columns)
        for name in SCAN_COLUMNS
        if name in config.keep
    }


def _run_bytes_a_point(config: BuildConfig) -> int:
    """Return the bytes per point of all runs. Every filter pass is assumed to keep all points."""
    return config.filter_passes * filter_dtype(config).itemsize + spool_dtype(config).itemsize


def _measure_radius(header: Header, shards: list[Shard], folder: Path, build: Transaction) -> Header:
    """Run the fourth pass: measure the mean closest-point distance, then write the final index."""
    rows = np.concatenate([s.rows for s in shards])
    names = [(s.name, s.size) for s in shards]
    if build.config.radius is not None:
        header = replace(header, radius=build.config.radius)
        write_index(folder, header, rows, names)
        return header
    write_index(folder, header, rows, names)  # a preliminary index, which only the workers read
    with build.stage("radius", header.points, "points"):
        found = archive_mean(folder, RADIUS_SAMPLE, build.executor, build.progress)
    if found.sample == 0:
        raise BadRequestError(ONE_POINT)
    header = replace(header, radius=found.mean / 2, radius_error=found.error / 2, radius_sample=found.sample)
    write_index(folder, header, rows, names)
    return header
