"""Journalled passes of a build: survey, spool, filters, shards. Certified work is not repeated.

Each pass takes the build folder, an executor and the options, and returns what the next one needs.
"""

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...schemas.archive.archive_writer import file_checksum
from ...schemas.archive.index import SHARD_FOLDER, VOXEL_DTYPE
from ...schemas.archive.voxel_grid import Lattice
from ...schemas.errors import BadRequestError, ScanError
from ..config import BuildConfig
from ..resume.build_directory import Workplace
from ..resume.journal import Work, resumed
from ..run.executor import Executor
from ..run.memory_shares import memory_share
from ..run.stages import Stages
from ..sources.scan_files import InputFile
from ..spool.spool import KEYS_SUFFIX, RUN_SUFFIX, Spool, spool_dtype
from ..spool.spool_pass import (
    RunsHold,
    Spooled,
    SpoolUnit,
    dump_spooled,
    load_spooled,
    run_points,
    spool_range,
)
from ..voxel.dense_voxel import check_normals
from .build_shards import Shard, ShardUnit, build_shard, plan_shards
from .filter_rules import filter_dtype, filter_passes, is_filtered, make_rules
from .survey import (
    RangeUnit,
    Survey,
    dump_part,
    hash_file,
    joined,
    load_part,
    ranges,
    survey_range,
    unopened,
)
from .verify_runs import check_runs

# Bytes per point at the peak of building one voxel (measured with 10^7 points in one voxel: 128).
VOXEL_BYTES_A_POINT = 160
# The column of scan numbers is uint16 (schemas/FORMAT.md).
MAX_SCANS = 1 << 16


def survey_scans(
    inputs: Sequence[InputFile],
    about: int,
    place: Workplace,
    executor: Executor,
    config: BuildConfig,
    stages: Stages,
) -> tuple[list[Survey], list[Survey]]:
    """Read every scan once; return the usable scans, ordered by content, and the faulty ones."""
    inputs = sorted(inputs, key=lambda item: str(item.path))  # this order numbers the journal entries
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
    """Run a unit of the survey: hash a file, or read a range."""
    return survey_range(unit) if isinstance(unit, RangeUnit) else hash_file(unit)


def _dump_either(result: Any) -> Any:
    """Convert a result of the survey to its journal entry."""
    return list(result) if isinstance(result, tuple) else dump_part(result)


def _load_either(noted: Any) -> Any:
    """Convert a journal entry to a result of the survey."""
    return tuple(noted) if isinstance(noted, list) else load_part(noted)


def _points_of(unit: Path | RangeUnit) -> int:
    """Return the number of points that a unit of the survey reads."""
    return unit.points if isinstance(unit, RangeUnit) else 0


def _check_surveys(
    good: list[Survey], faulty: list[Survey], inputs: Sequence[InputFile], config: BuildConfig
) -> None:
    """Refuse scans that cannot be built with these options."""
    if faulty and not config.skip_bad:
        more = "" if len(faulty) == 1 else "".join(f"\n  {s.fault}" for s in faulty[1:])
        raise ScanError(
            f"{faulty[0].fault}{more} (--skip-bad leaves such scans out and marks their region unknown)"
        )
    if not good:
        first = inputs[0].path if inputs else "nothing"
        raise ScanError(f"{first}: no usable scan, expected at least one: check the files")
    if ("scan" in config.keep or is_filtered(config)) and len(good) > MAX_SCANS:
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
    """Return the sort key of a scan. It depends on content, so the order of paths has no effect."""
    return survey.sha256, survey.scan.index if survey.scan else -1, str(survey.path)


def spool_scans(
    surveys: list[Survey],
    lattice: Lattice,
    dtype: np.dtype,
    place: Workplace,
    executor: Executor,
    config: BuildConfig,
    stages: Stages,
) -> list[Spooled]:
    """Run the second pass: write quantised points to disk, sorted by voxel."""
    check_runs(place, stages)
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
    notes = [place.journal.recall(f"spool/{note.stem}") for note in folder.glob("*.json")]
    _sweep_spool(folder, {name for noted in notes if noted for name in noted["runs"]})
    work = Work(spool_range, dump_spooled, load_spooled, RunsHold(folder))
    with stages.stage("spool", sum(s.count for s in surveys), "points"):
        spooled = resumed(place.journal, executor, work, units, stages.progress, lambda unit: unit.count)
    # A range that had lost a run was spooled again, possibly into fewer runs than before.
    _sweep_spool(folder, {name for found in spooled for name in found.runs})
    return spooled


def _sweep_spool(folder: Path, vouched: set[str]) -> None:
    """Delete uncertified runs, because a spool consists of all runs in its folder."""
    stems = {Path(name).stem for name in vouched}
    for suffix in (RUN_SUFFIX, KEYS_SUFFIX):
        for path in folder.glob(f"*{suffix}"):
            if path.stem not in stems:
                path.unlink(missing_ok=True)  # a worker that was given up may have removed it already


def spool_rows(config: BuildConfig) -> np.dtype:
    """Return the dtype of a spool row, including the columns that only the filters need."""
    if not is_filtered(config):
        return spool_dtype(config)
    return filter_dtype(config)


def check_filters(config: BuildConfig, lattice: Lattice) -> None:
    """Raise BadRequestError for filters that are impossible on this lattice."""
    if is_filtered(config):
        make_rules(config, lattice)


def filter_points(
    spool: Spool, place: Workplace, executor: Executor, config: BuildConfig, stages: Stages
) -> tuple[Spool, dict[str, dict[int, int]]]:
    """Run the optional filter pass.

    Return the spool and the points left out of each scan, by reason.
    """
    if not is_filtered(config):
        return spool, {}
    from .filter import filtered_spool  # most builds do not need its kernels, which this import loads

    total = filter_passes(config) * int(spool.counts.sum())
    with stages.stage("filter", total, "points"):
        return filtered_spool(spool, config, place.folder, executor, stages.progress, place.journal)


def build_shards(
    spool: Spool,
    identity: bytes,
    place: Workplace,
    executor: Executor,
    config: BuildConfig,
    stages: Stages,
) -> list[Shard]:
    """Run the third pass: build every voxel and write the shards. The largest are built first."""
    check_normals(spool.counts, config)
    folder = place.archive / SHARD_FOLDER
    # Points of the surroundings that may be held beside the voxel itself, or a part of it.
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
            path.unlink(missing_ok=True)
    return [shard for _, shard in sorted(zip((unit.number for _, unit in units), shards, strict=True))]


def dump_shard(shard: Shard) -> dict[str, Any]:
    """Convert a shard to its journal entry."""
    return {
        **shard._asdict(),
        "rows": base64.b85encode(shard.rows.tobytes()).decode(),
        "radius_counts": shard.radius_counts.tolist(),
    }


def load_shard(noted: dict[str, Any]) -> Shard:
    """Convert a journal entry to a shard."""
    rows = np.frombuffer(base64.b85decode(noted["rows"]), VOXEL_DTYPE)
    return Shard(**{**noted, "rows": rows, "radius_counts": np.array(noted["radius_counts"], np.int64)})


@dataclass(frozen=True, slots=True)
class ShardHolds:
    """Check that the shard of a journal entry is in `folder`, byte for byte.

    This reads the shard once; no pass does so otherwise.
    """

    folder: Path

    def __call__(self, shard: Shard) -> bool:
        path = self.folder / shard.name
        return path.is_file() and path.stat().st_size == shard.size and file_checksum(path) == shard.checksum
