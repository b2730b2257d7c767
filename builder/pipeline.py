"""Scans -> archive: survey, spool, voxels, radius, verify, publish. builder/DESIGN.md says what each pass holds.

Everything is made in a hidden folder beside the target and renamed at the end: there is never half an archive
under the name asked for, and a failure leaves nothing behind.
"""

import hashlib
import json
import shutil
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..schemas.archive import SHARD_FOLDER, write_index
from ..schemas.errors import BadRequestError, CorruptError, ScanError, SolidcloudError
from ..schemas.index import Header, Source
from ..schemas.radius_model import RADIUS_CLASSES
from ..schemas.voxel_grid import Lattice
from .config import RADIUS_SAMPLE, BuildConfig
from .executor import Executor, ProcessExecutor, worker_count
from .partition import (
    SPOOL_BYTES_A_POINT,
    Run,
    RunSpool,
    Spooled,
    SpoolUnit,
    Survey,
    choose_lattice,
    open_all,
    spool_dtype,
    spool_scan,
    survey_scan,
    unopened,
)
from .progress import Progress, Silent
from .shards import Shard, ShardUnit, build_shard, plan_shards
from .sources import NOT_FINITE, scan_files, sha256_of
from .spacing import archive_mean
from .verify import verify_archive
from .workplace import locked, made_parents, publish_folder, workplace

# Bytes a point that building one voxel holds at its peak (measured with 10^7 points in one voxel: 128).
VOXEL_BYTES_A_POINT = 160
# The column of scan numbers is uint16 (schemas/FORMAT.md).
MAX_SCANS = 1 << 16
# Bytes a point on disk at the end, at most (5 is the goal at 0.1 mm), to refuse a build that cannot finish.
ARCHIVE_BYTES_A_POINT = 6


class BuildSummary(NamedTuple):
    """What was built. bytes: of the archive.  stages: seconds of each.  skipped: reason -> points left out.

    lattice_step, moved_max, radius, radius_error: [m], see schemas/archive.py Header.  faults: scans left out.
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


class _Stages:
    """Times the stages and passes them on to the listener."""

    def __init__(self, progress: Progress) -> None:
        self.progress = progress
        self.seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str, total: int, unit: str) -> Iterator[None]:
        begin = time.perf_counter()
        self.progress.start(name, total, unit)
        try:
            yield
        finally:
            self.progress.finish()
            self.seconds[name] = time.perf_counter() - begin


def build_archive(
    paths: Sequence[Path], target: Path, config: BuildConfig, progress: Progress | None = None
) -> BuildSummary:
    """Build an archive in the folder `target` from scan files and folders of them.

    The archive's bytes depend on the points, their files' content, the paths as given (in the index alone) and the
    options in `config.identity()`; not on the order of paths, the number of jobs or the memory bound. Raises
    ScanError naming every scan that cannot be used (with `skip_bad` they are left out and their region is unknown),
    BadRequestError for impossible options, and leaves nothing behind then.
    """
    begin = time.perf_counter()
    target = Path(target)
    stages = _Stages(progress or Silent())
    files = scan_files(paths)
    with made_parents(target), locked(target), workplace(target, config.overwrite) as folder:
        surveys, faulty = _survey(files, config, stages)
        lattice, lattice_source = choose_lattice(surveys, config)
        points = sum(s.count for s in surveys)
        jobs = worker_count(config.jobs, points)
        _check_space(target.parent, points, config)
        with ProcessExecutor(jobs) as executor:
            spooled = _spool(surveys, lattice, folder, executor, config, stages)
        header = _header(surveys, faulty, spooled, lattice, lattice_source, config)
        keys, counts = _voxel_counts(spooled)
        with ProcessExecutor(_jobs_that_fit(jobs, int(counts.max()), config)) as executor:
            plans = plan_shards(keys, counts)
            shards = _build_voxels(spooled, plans, header, folder, executor, config, stages)
            header = _measure_radius(header, shards, folder, executor, config, stages)
        shutil.rmtree(folder / "spool")
        report = verify_archive(folder, progress=stages.progress)
        if report.faults:
            raise CorruptError(
                f"{report.faults[0]}: what was written is not what reads back: check disk and memory"
            )
        publish_folder(folder, target, config.overwrite)
    return BuildSummary(
        archive=target,
        points=header.points,
        voxels=sum(len(s.rows) for s in shards),
        shards=len(shards),
        bytes=sum(f.stat().st_size for f in target.rglob("*.h5")),
        seconds=time.perf_counter() - begin,
        stages=stages.seconds,
        lattice_step=lattice.step,
        lattice_source=lattice_source,
        moved_max=header.moved_max,
        radius=header.radius,
        radius_error=header.radius_error,
        skipped=dict(sum((Counter(s.skipped) for s in header.sources), Counter())),
        faults=tuple(s.fault for s in header.sources if s.fault),
    )


def _survey(paths: list[Path], config: BuildConfig, stages: _Stages) -> tuple[list[Survey], list[Survey]]:
    """Read every scan once; returns the usable ones, in an order of their content, and the faulty ones."""
    opened = [(path, *open_all(path, config.spacing)) for path in paths]
    scans = [scan for _, found, _ in opened for scan in found]
    total = sum(scan.declared_count or 0 for scan in scans)
    with stages.stage("survey", total, "points"):
        sha256 = cache(sha256_of)  # a file of many scans is hashed once
        surveys = [survey_scan(scan, stages.progress.advance, sha256) for scan in scans]
    for path, found, fault in opened:
        if not found:
            surveys.append(unopened(path, fault))
    good = sorted((s for s in surveys if not s.fault), key=_content_order)
    faulty = sorted((s for s in surveys if s.fault), key=_content_order)
    if faulty and not config.skip_bad:
        more = "" if len(faulty) == 1 else "".join(f"\n  {s.fault}" for s in faulty[1:])
        raise ScanError(
            f"{faulty[0].fault}{more} (--skip-bad leaves such scans out and marks their region unknown)"
        )
    if not good:
        raise ScanError(
            f"{paths[0] if paths else 'nothing'}: no usable scan, expected at least one: check the files"
        )
    if "scan" in config.keep and len(good) > MAX_SCANS:
        raise BadRequestError(
            f"--keep scan with {len(good)} scans: expected at most {MAX_SCANS}: build in parts"
        )
    wrong = sum(_not_finite(s) for s in good)
    if wrong and config.strict:
        first = next(s for s in good if _not_finite(s))
        raise ScanError(
            f"{first.path}: {wrong} points that are not finite, expected none with --strict: clean the scan"
        )
    return good, faulty


def _not_finite(survey: Survey) -> int:
    """Points, or triangles of a sampled mesh, that were left out because they are not finite."""
    dropped = survey.scan.dropped if survey.scan else {}
    return survey.not_finite + sum(n for reason, n in dropped.items() if reason == NOT_FINITE)


def _content_order(survey: Survey) -> tuple[str, int, str]:
    """Scans are numbered by their files' content, so that the order they are given in changes nothing."""
    return survey.sha256, survey.scan.index if survey.scan else -1, str(survey.path)


def _check_space(folder: Path, points: int, config: BuildConfig) -> None:
    """Refuse a build whose spool and archive cannot fit on the disk."""
    needed = points * (spool_dtype(config).itemsize + ARCHIVE_BYTES_A_POINT)
    free = shutil.disk_usage(folder).free
    if needed > free:
        raise SolidcloudError(
            f"{folder}: {free} bytes free, the build needs about {needed}: make room or use another disk"
        )


def _spool(
    surveys: list[Survey],
    lattice: Lattice,
    folder: Path,
    executor: Executor,
    config: BuildConfig,
    stages: _Stages,
) -> list[Spooled]:
    """Second pass: quantised points, sorted into voxels, on disk."""
    run_points = max(1 << 16, config.memory_bytes // (executor.jobs * SPOOL_BYTES_A_POINT))
    units = [
        SpoolUnit(s.scan, number, s.count, lattice, config, folder / "spool", run_points)
        for number, s in enumerate(surveys)
        if s.scan is not None
    ]
    with stages.stage("spool", sum(s.count for s in surveys), "points"):
        return list(executor.map(spool_scan, units, stages.progress, lambda unit: unit.count))


def _header(
    surveys: list[Survey],
    faulty: list[Survey],
    spooled: list[Spooled],
    lattice: Lattice,
    lattice_source: str,
    config: BuildConfig,
) -> Header:
    """What is known before any voxel is built; the radius comes later."""
    low = lattice.to_lattice(np.min([s.low for s in surveys], axis=0)[None])[0]
    high = lattice.to_lattice(np.max([s.high for s in surveys], axis=0)[None])[0]
    content = [sum(s.content[i] for s in spooled) % (1 << 64) for i in range(2)]
    identity = json.dumps(config.identity(), sort_keys=True).encode()
    origin = np.array([*lattice.origin, lattice.step], "<f8").tobytes()
    archive_id = hashlib.sha256(identity + origin + np.array(content, "<u8").tobytes()).digest()[:16]
    sources = [
        Source(
            str(s.path), s.scan.index, s.scan.format, s.sha256, s.count, s.scan.pose,
            {**spool.dropped, **({NOT_FINITE: _not_finite(s)} if _not_finite(s) else {})},
        )
        for s, spool in zip(surveys, spooled, strict=True)
        if s.scan is not None
    ]  # fmt: skip
    sources += [
        Source(
            str(s.path),
            s.scan.index if s.scan else 0,
            s.scan.format if s.scan else "",
            s.sha256,
            0,
            np.eye(4),
            {},
            s.fault,
        )
        for s in faulty
    ]
    lost = [s for s in faulty if not s.empty]
    boxes = [
        np.stack([lattice.to_lattice(s.region[:1])[0] - 1, lattice.to_lattice(s.region[1:])[0] + 1])
        for s in lost
        if s.region is not None
    ]
    return Header(
        archive_id=archive_id,
        lattice=lattice,
        lattice_source=lattice_source,
        points=sum(s.count for s in surveys),
        low=low,
        high=high,
        radius=0.0,
        radius_model="mean" if config.radius is None else "given",
        radius_error=0.0,
        radius_sample=0,
        moved_max=max(s.moved_max for s in spooled),
        degree=config.degree,
        leaf=config.leaf,
        scan_index="scan" in config.keep,
        intensity="intensity" in config.keep,
        models=config.stored_models(),
        radius_counts=np.zeros(RADIUS_CLASSES, np.int64),
        radius_capped=0,
        options=config.identity(),
        sources=tuple(sources),
        unknown=np.array(boxes, np.int64).reshape(-1, 2, 3),
        unknown_everywhere=any(s.region is None for s in lost),
    )


def _voxel_counts(spooled: list[Spooled]) -> tuple[NDArray[np.uint64], NDArray[np.int64]]:
    """The keys of all voxels, ascending, and how many points each holds."""
    runs = [run for s in spooled for run in s.runs]
    keys, where = np.unique(np.concatenate([run.keys for run in runs]), return_inverse=True)
    counts = np.bincount(where, np.concatenate([np.diff(run.starts) for run in runs]))
    return keys, counts.astype(np.int64)


def _jobs_that_fit(jobs: int, densest: int, config: BuildConfig) -> int:
    """Processes that may each hold the densest voxel: fewer where their number was left open, else refused."""
    needed = densest * VOXEL_BYTES_A_POINT
    fit = config.memory_bytes // needed
    if fit < (jobs if config.jobs else 1):
        raise BadRequestError(
            f"a voxel of {densest} points takes about {needed >> 20} MB to build, {jobs if config.jobs else 1} at a "
            "time: give a smaller --voxel, a larger --memory or fewer --jobs"
        )
    return min(jobs, fit)


def _build_voxels(
    spooled: list[Spooled],
    plans: list[tuple[tuple[int, ...], int]],
    header: Header,
    folder: Path,
    executor: Executor,
    config: BuildConfig,
    stages: _Stages,
) -> list[Shard]:
    """Third pass: every voxel's octree and hierarchies, into the shards planned."""
    runs: tuple[Run, ...] = tuple(run for s in spooled for run in s.runs)
    shards = folder / SHARD_FOLDER
    spool: Any = RunSpool(runs, spool_dtype(config), header.lattice)
    # Beside the densest voxel, which may take all the memory while it is built and half of it before.
    most_near = max(1 << 16, config.memory_bytes // (executor.jobs * 2 * VOXEL_BYTES_A_POINT))
    units = [
        ShardUnit(
            number, 0, keys, points, spool, header.lattice, config, most_near, header.archive_id, shards
        )
        for number, (keys, points) in enumerate(plans)
    ]
    with stages.stage("build", header.points, "points"):
        return list(executor.map(build_shard, units, stages.progress, lambda unit: unit.points))


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
    header = replace(
        header,
        radius_counts=np.sum([s.radius_counts for s in shards], axis=0, dtype=np.int64),
        radius_capped=sum(s.radius_capped for s in shards),
    )
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
