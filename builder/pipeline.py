"""Scans -> archive: survey, spool, voxels, radius, verify, publish. builder/DESIGN.md says what each pass holds.

Everything is made in a hidden folder beside the target and renamed at the end: there is never half an archive under the
name asked for. What is done stays there when a build is interrupted, and the same command goes on from it.
"""

import base64
import errno
import shutil
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..schemas.archive import SHARD_FOLDER, Archive, write_index
from ..schemas.errors import BadRequestError, CorruptError, ScanError, SolidcloudError
from ..schemas.index import VOXEL_DTYPE, Header
from ..schemas.voxel_grid import Lattice
from .config import RADIUS_SAMPLE, BuildConfig
from .dense import DENSE_POINTS
from .executor import Executor, make_executor, worker_count
from .header import archive_id, make_header
from .journal import Journal, Work, resumed
from .memory import jobs_that_fit as jobs_that_fit
from .memory import memory_share
from .partition import (
    RunsHold,
    Spooled,
    SpoolUnit,
    dump_spooled,
    load_spooled,
    run_points,
    spool_range,
)
from .preview import write_preview
from .progress import Progress, Silent
from .resume import described, is_whole
from .scan_list import Input
from .scan_list import inputs as scans_of
from .shards import Shard, ShardUnit, build_shard, plan_shards
from .spacing import archive_mean
from .spool import KEYS_SUFFIX, RUN_SUFFIX, Spool, spool_dtype
from .survey import (
    RangeUnit,
    Survey,
    choose_lattice,
    dump_part,
    hash_file,
    joined,
    load_part,
    ranges,
    survey_range,
    unopened,
)
from .verify import verify_archive
from .workplace import (
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

# Bytes a point that building one voxel holds at its peak (measured with 10^7 points in one voxel: 128).
VOXEL_BYTES_A_POINT = 160
# The column of scan numbers is uint16 (schemas/FORMAT.md).
MAX_SCANS = 1 << 16
# Bytes a point on disk at the end, at most (5 is the goal at 0.1 mm), to refuse a build that cannot finish.
ARCHIVE_BYTES_A_POINT = 6
# Bytes a point that a dense voxel takes besides while it is built (dense.py); one a job is.
SCRATCH_BYTES_A_POINT = 21
# A point of a file whose header says nothing of their number takes about so many bytes: text.
BYTES_A_POINT = 30


class BuildSummary(NamedTuple):
    """What was built. bytes: of the archive.  stages: seconds of each.  skipped: reason -> points left out.

    lattice_step, moved_max, radius, radius_error: [m], see schemas/archive.py Header.  faults: scans left out.
    already: nothing was built, for the archive was there, of the same scans with the same options.
    """

    archive: Path
    points: int
    voxels: int
    shards: int
    bytes: int
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


class _Stages:
    """Times the stages and passes them on to the listener."""

    def __init__(self, progress: Progress) -> None:
        self.progress = progress
        self.seconds: dict[str, float] = {}

    @contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """A stage that says itself what it does."""
        begin = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - begin

    @contextmanager
    def stage(self, name: str, total: int, unit: str) -> Iterator[None]:
        """A stage of so much work."""
        with self.timed(name):
            self.progress.start(name, total, unit)
            try:
                yield
            finally:
                self.progress.finish()


def build_archive(
    paths: Sequence[Path], target: Path, config: BuildConfig, progress: Progress | None = None
) -> BuildSummary:
    """Build an archive in the folder `target` from scan files and folders of them; go on where such a build ended.

    The archive's bytes depend on the points, their files' content, the paths as given (in the index alone) and the
    options in `config.identity()`; not on the order of paths, the number of jobs, the memory bound, or how often the
    build was interrupted. An archive that is there already, of the same scans and options, is left as it is.
    Raises ScanError naming every scan that cannot be used (with `skip_bad` they are left out and their region is
    unknown) and BadRequestError for impossible options, and leaves nothing behind then; SolidcloudError where the disk
    or a process failed, and keeps what is done.
    """
    begin = time.perf_counter()
    target = Path(target)
    stages = _Stages(progress or Silent())
    with made_parents(target), locked(target), _disk_errors(target):
        inputs = open_inputs(paths, config)
        what = described(inputs, config)
        recover(target)
        if not config.overwrite and not config.fresh and _is_whole(target, inputs, config, stages):
            forget_finished(target, what)
            with Archive(target) as archive:
                header, voxels, shards = archive.header, len(archive.voxels), archive.shard_count()
            return _summary(target, header, voxels, shards, begin, stages, already=True)
        check_target(target, config.overwrite)
        with workplace(target, what, fresh=config.fresh) as place:
            header, built = _build(inputs, place, target, config, stages)
            with stages.timed("publish"):
                publish_folder(place.archive, target, config.overwrite)
    return _summary(target, header, sum(len(s.rows) for s in built), len(built), begin, stages)


def _build(
    inputs: Sequence[Input], place: Workplace, target: Path, config: BuildConfig, stages: _Stages
) -> tuple[Header, list[Shard]]:
    """All passes: what is in `place.archive` when this returns is an archive, and verified."""
    about = sum(_about(item) for item in inputs)
    with make_executor(config, jobs_that_fit(worker_count(config.jobs, about), config)) as executor:
        surveys, faulty = _survey(inputs, about, place, executor, config, stages)
        place.surveyed = True
        lattice, lattice_source = choose_lattice(surveys, config)
        points = sum(s.count for s in surveys)
        dtype = _spool_rows(config)
        final = points * (dtype.itemsize + ARCHIVE_BYTES_A_POINT)
        _check_space(target.parent, place.folder, final)
        spooled = _spool(surveys, lattice, dtype, place, executor, config, stages)
        spool = Spool(place.folder / "spool", dtype, lattice)
        spool, left_out = _filter(spool, place, executor, config, stages)
        filtered = [
            {reason: of[number] for reason, of in left_out.items() if number in of}
            for number in range(len(surveys))
        ]
        dense = np.sort(spool.counts[spool.counts > DENSE_POINTS])[-executor.jobs :]
        _check_space(target.parent, place.folder, final + int(dense.sum()) * SCRATCH_BYTES_A_POINT)
        identity = archive_id(spooled, lattice, config)
        shards = _build_shards(spool, identity, place, executor, config, stages)
        moved_max = max(s.moved_max for s in spooled)
        header = make_header(
            surveys, faulty, filtered, lattice, lattice_source, identity, moved_max, shards, config
        )
        header = _measure_radius(header, shards, place.archive, executor, config, stages)
        _read_back(place.archive, header.points, executor, stages)
    return header, shards


def _read_back(folder: Path, points: int, executor: Executor, stages: _Stages) -> None:
    """Read what was written, for a preview and to the last record. Raises CorruptError where it is something else."""
    fault = ""
    try:
        with stages.stage("preview", points, "points"):
            write_preview(folder, executor, stages.progress)
        with stages.timed("verify"):
            report = verify_archive(folder, progress=stages.progress, executor=executor)
        fault = next(iter(report.faults), "")
    except CorruptError as error:
        fault = str(error)
    if fault:
        raise CorruptError(f"{fault}: what was written is not what reads back: check disk and memory")


def open_inputs(paths: Sequence[Path], config: BuildConfig) -> list[Input]:
    """The files that the paths stand for, files, folders or a list of scans, opened: their headers are read."""
    return scans_of(paths, config.spacing)


def _about(item: Input) -> int:
    """About how many points a file holds."""
    declared = [scan.declared_count for scan in item.scans]
    if None not in declared:
        return sum(count or 0 for count in declared)
    return item.path.stat().st_size // BYTES_A_POINT


def _is_whole(target: Path, inputs: Sequence[Input], config: BuildConfig, stages: _Stages) -> bool:
    """Whether the archive is there already."""
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
    stages: _Stages,
    *,
    already: bool = False,
) -> BuildSummary:
    """What is said of an archive that is there."""
    return BuildSummary(
        archive=target,
        points=header.points,
        voxels=voxels,
        shards=shards,
        bytes=sum(f.stat().st_size for f in target.rglob("*") if f.is_file()),
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
    )


@contextmanager
def _disk_errors(target: Path) -> Iterator[None]:
    """Name the disk, and what to do, where it has failed; what is done stays in the hidden folder."""
    try:
        yield
    except OSError as error:
        folder = building_folder(target)
        # HDF5 puts the number into its text alone.
        full = error.errno in (errno.ENOSPC, errno.EDQUOT) or f"errno = {errno.ENOSPC}" in str(error)
        found = "no space left on the disk" if full else str(error)
        what = "make room" if full else "check the disk"
        where = f" ({error.filename})" if full and error.filename else ""
        raise SolidcloudError(
            f"{target.parent}: {found}{where}: {what}, then give the same command again: it goes on from what is done, "
            f"in {folder}"
        ) from error


def _survey(
    inputs: Sequence[Input],
    about: int,
    place: Workplace,
    executor: Executor,
    config: BuildConfig,
    stages: _Stages,
) -> tuple[list[Survey], list[Survey]]:
    """Read every scan once; returns the usable ones, in an order of their content, and the faulty ones."""
    inputs = sorted(inputs, key=lambda item: str(item.path))  # the notes are named by this order
    scans = [scan for item in inputs for scan in item.scans]
    files = [item.path for item in inputs if item.scans]
    units = [
        (f"survey/{number:06d}-{unit.start:012d}", unit)
        for number, scan in enumerate(scans)
        for unit in ranges(scan, about)
    ]
    hashing = [(f"survey/sha256-{number:06d}", path) for number, path in enumerate(files)]
    with stages.stage("survey", sum(unit.points for _, unit in units), "points"):
        both: list[tuple[str, Path | RangeUnit]] = [*hashing, *units]
        work: Work[Path | RangeUnit, Any] = Work(_hash_or_survey, _dump_either, _load_either)
        found = resumed(place.journal, executor, work, both, stages.progress, _points_of)
    sha256 = dict(zip(files, found, strict=False))
    surveys, at = [], len(hashing)
    for scan in scans:
        count = len(ranges(scan, about))
        surveys.append(joined(scan, found[at : at + count], sha256[scan.path]))
        at += count
    surveys += [unopened(item.path, item.fault, item.region) for item in inputs if not item.scans]
    good = sorted((s for s in surveys if not s.fault), key=_content_order)
    faulty = sorted((s for s in surveys if s.fault), key=_content_order)
    _check_surveys(good, faulty, inputs, config)
    return good, faulty


def _hash_or_survey(unit: Path | RangeUnit) -> Any:
    """A unit of the survey: a file to be hashed, or a range to be read."""
    return survey_range(unit) if isinstance(unit, RangeUnit) else hash_file(unit)


def _dump_either(result: Any) -> Any:
    """A result of the survey, as its note says it."""
    return list(result) if isinstance(result, tuple) else dump_part(result)


def _load_either(noted: Any) -> Any:
    """A result of the survey from its note."""
    return tuple(noted) if isinstance(noted, list) else load_part(noted)


def _points_of(unit: Path | RangeUnit) -> int:
    """Points that a unit of the survey reads."""
    return unit.points if isinstance(unit, RangeUnit) else 0


def _check_surveys(
    good: list[Survey], faulty: list[Survey], inputs: Sequence[Input], config: BuildConfig
) -> None:
    """Refuse scans that cannot be built as the options ask."""
    if faulty and not config.skip_bad:
        more = "" if len(faulty) == 1 else "".join(f"\n  {s.fault}" for s in faulty[1:])
        raise ScanError(
            f"{faulty[0].fault}{more} (--skip-bad leaves such scans out and marks their region unknown)"
        )
    if not good:
        first = inputs[0].path if inputs else "nothing"
        raise ScanError(f"{first}: no usable scan, expected at least one: check the files")
    if ("scan" in config.keep or _is_filtered(config)) and len(good) > MAX_SCANS:
        raise BadRequestError(
            f"--keep scan, or a filter, with {len(good)} scans: expected at most {MAX_SCANS}: build in parts"
        )
    unclean = [s for s in good if s.unclean]
    if unclean and config.strict:
        wrong = sum(s.unclean for s in unclean)
        raise ScanError(
            f"{unclean[0].path}: {wrong} points that are not finite, expected none with --strict: clean the scan"
        )


def _content_order(survey: Survey) -> tuple[str, int, str]:
    """Scans are numbered by their files' content, so that the order they are given in changes nothing."""
    return survey.sha256, survey.scan.index if survey.scan else -1, str(survey.path)


def _check_space(disk: Path, folder: Path, needed: int) -> None:
    """Refuse a build whose files cannot all be on the disk, with what is there of them in `folder`."""
    there = sum(f.stat().st_size for f in folder.rglob("*") if f.is_file())
    free = shutil.disk_usage(disk).free
    if needed > free + there:
        raise SolidcloudError(
            f"{disk}: {free} bytes free, the build needs about {needed - there}: make room or use another disk"
        )


def _spool(
    surveys: list[Survey],
    lattice: Lattice,
    dtype: np.dtype,
    place: Workplace,
    executor: Executor,
    config: BuildConfig,
    stages: _Stages,
) -> list[Spooled]:
    """Second pass: quantised points, sorted into voxels, on disk."""
    folder = place.folder / "spool"
    most = run_points(memory_share(executor.jobs, config), dtype)
    units = []
    for number, survey in enumerate(surveys):
        for part in survey.parts:
            assert survey.scan is not None
            name = f"{number:06d}-{part.start:012d}"
            unit = SpoolUnit(
                survey.scan,
                number,
                part.start,
                part.stop,
                part.count,
                lattice,
                config,
                dtype,
                folder,
                name,
                most,
            )
            units.append((f"spool/{name}", unit))
    _sweep_spool(place.journal, folder)
    work = Work(spool_range, dump_spooled, load_spooled, RunsHold(folder))
    with stages.stage("spool", sum(s.count for s in surveys), "points"):
        return resumed(place.journal, executor, work, units, stages.progress, lambda unit: unit.count)


def _sweep_spool(journal: Journal, folder: Path) -> None:
    """Delete the runs that no note vouches for: of a unit that was killed, whose runs may be cut otherwise now."""
    noted = {
        Path(name).stem
        for note in folder.glob("*.json")
        for name in (journal.recall(f"spool/{note.stem}") or {"runs": {}})["runs"]
    }
    for suffix in (RUN_SUFFIX, KEYS_SUFFIX):
        for path in folder.glob(f"*{suffix}"):
            if path.stem not in noted:
                path.unlink()


def _is_filtered(config: BuildConfig) -> bool:
    """Whether points are to be left out; most builds have no use for builder/filter.py, and do not load it."""
    return not (config.thin is None and config.outliers is None and config.moving is None)


def _spool_rows(config: BuildConfig) -> np.dtype:
    """A row of the spool: what the filters need besides what is kept, where there are any."""
    if not _is_filtered(config):
        return spool_dtype(config)
    from .filter import filter_dtype

    return filter_dtype(config)


def _filter(
    spool: Spool, place: Workplace, executor: Executor, config: BuildConfig, stages: _Stages
) -> tuple[Spool, dict[str, dict[int, int]]]:
    """The optional pass between: points are left out; also how many of each scan, by reason."""
    if not _is_filtered(config):
        return spool, {}
    from .filter import filter_passes, filtered_spool

    total = filter_passes(config) * int(spool.counts.sum())
    with stages.stage("filter", total, "points"):
        return filtered_spool(spool, config, place.folder, executor, stages.progress, place.journal)


def _build_shards(
    spool: Spool,
    identity: bytes,
    place: Workplace,
    executor: Executor,
    config: BuildConfig,
    stages: _Stages,
) -> list[Shard]:
    """Third pass: every voxel's octree and hierarchies, into shards; those with the most points first."""
    folder = place.archive / SHARD_FOLDER
    # Beside the voxel itself, or a part of it.
    most_near = max(1 << 16, memory_share(executor.jobs, config) // (2 * VOXEL_BYTES_A_POINT))
    plans = plan_shards(spool.keys, spool.counts)
    units = [
        (
            f"done/{number:06d}",
            ShardUnit(number, 0, keys, points, spool, spool.lattice, config, most_near, identity, folder),
        )
        for number, (keys, points) in enumerate(plans)
    ]
    units.sort(key=lambda named: -named[1].points)
    work = Work(build_shard, dump_shard, load_shard, ShardHolds(folder))
    with stages.stage("build", sum(points for _, points in plans), "points"):
        shards = resumed(place.journal, executor, work, units, stages.progress, lambda unit: unit.points)
    named = {shard.name for shard in shards}
    for path in folder.iterdir():
        if path.name not in named:
            path.unlink()
    return [shard for _, shard in sorted(zip((unit.number for _, unit in units), shards, strict=True))]


def dump_shard(shard: Shard) -> dict[str, Any]:
    """A shard as its note says it."""
    return {
        **shard._asdict(),
        "rows": base64.b85encode(shard.rows.tobytes()).decode(),
        "radius_counts": shard.radius_counts.tolist(),
    }


def load_shard(noted: dict[str, Any]) -> Shard:
    """A shard from its note."""
    rows = np.frombuffer(base64.b85decode(noted["rows"]), VOXEL_DTYPE)
    return Shard(**{**noted, "rows": rows, "radius_counts": np.array(noted["radius_counts"], np.int64)})


@dataclass(frozen=True, slots=True)
class ShardHolds:
    """Whether the shard that a note speaks of is in `folder`, as long as it was."""

    folder: Path

    def __call__(self, shard: Shard) -> bool:
        path = self.folder / shard.name
        return path.is_file() and path.stat().st_size == shard.size


def _measure_radius(
    header: Header,
    shards: list[Shard],
    folder: Path,
    executor: Executor,
    config: BuildConfig,
    stages: _Stages,
) -> Header:
    """Fourth pass: the mean closest-point distance over what is stored; then the final index is written."""
    rows = np.concatenate([s.rows for s in shards])
    names = [(s.name, s.size) for s in shards]
    if config.radius is not None:
        header = replace(header, radius=config.radius)
        write_index(folder, header, rows, names)
        return header
    write_index(folder, header, rows, names)  # for the workers to read by; nobody else sees this folder
    with stages.stage("radius", header.points, "points"):
        found = archive_mean(folder, RADIUS_SAMPLE, executor, stages.progress)
    if found.sample == 0:
        raise BadRequestError("a single distinct point has no closest point: give --radius")
    header = replace(header, radius=found.mean / 2, radius_error=found.error / 2, radius_sample=found.sample)
    write_index(folder, header, rows, names)
    return header
