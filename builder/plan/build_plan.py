"""Estimate of a build before it begins: bytes, memory, time by stage, voxels, and limits.

The estimate follows from a few properties of the scene (`SceneStats`: of existing scans, found by
`scan_sample.py`, or of a hypothetical number of points) and from measured rates (rates.py). A stage
takes a constant time plus a time per point. The part shared among workers was determined by
measuring with one worker and with two.

Bytes per point are those of a packed sample (`packed_sample.py`) and hold within 15 %. Without a
sample they are guessed from the density of points on surfaces. Times hold within a factor of 1.5 if
the scene resembles a scanned building. An estimate lists its assumptions.
"""

import math
import os
import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

from ...schemas.archive.units import MAX_SCANS
from ...schemas.archive.voxel_grid import KEY_BIAS, voxel_edge
from ..build_limits import (
    MAX_PREVIEW_POINTS,
    PREVIEW_PART,
    RANGE_POINTS,
    RANGES,
    WHOLE_PREVIEW_POINTS,
    jobs_that_fit,
    memory_share,
    shard_points,
)
from ..config import BuildConfig
from ..passes.spool_pass import run_points
from ..run.executor import worker_count
from ..sources.lattice_step import STEPS
from ..spool.run_files import spool_dtype
from .rates import Rates

# Bytes of the index apart from its voxels, and per voxel (schemas/FORMAT.md); of a shard's file
# apart from the records, for HDF5 itself, per voxel (measured: 1,020 to 1,050); and per voxel in a
# run's directory, which every process reads.
HEADER_BYTES = 7500
INDEX_BYTES = 100
GROUP_BYTES = 1030
DIRECTORY_BYTES = 40
# Approximate number of runs over which a voxel is spread: overlapping scans, and adjacent ranges of
# a scan.
RUNS_A_VOXEL = 8
# Bytes per point of the preview (preview.py).
PREVIEW_BYTES = 6
# The length of a frame is uint32 in the index (schemas/FORMAT.md).
MAX_FRAME = 1 << 32
# A folder with more files than this is slow to list on most file systems.
MANY_FILES = 1_000_000
# The densest voxel holds about this multiple of the mean (measured: 7 on a generated façade in
# voxels of 8 m, 3 of 2 m).
DENSEST = 8
# The archive's bytes are within this factor of an estimate, with a packed sample and without.
MEASURED_WITHIN, GUESSED_WITHIN = 1.15, 2.5


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneStats:
    """Known properties of the points to build.

    points, scans: their numbers.  largest: points of the largest scan.  input_bytes: of the files;
    None: not known.
    formats: format -> points.  step: lattice step [m]; None: the default.  area: of the
    surfaces [m^2].
    voxels: (edge [m], number of voxels with points) if sampled; otherwise the number follows from
    the area.
    extent: greatest length along an axis [m], or None.  assumed: sentences.
    packed: bytes per point of the records of a sample, with scan and intensity if they are kept;
    None: not measured.
    warnings: lines about scans that are probably a mistake.
    """

    points: int
    scans: int
    largest: int
    input_bytes: int | None
    formats: Mapping[str, int]
    step: float | None
    area: float
    voxels: tuple[float, float] | None = None
    extent: float | None = None
    assumed: tuple[str, ...] = ()
    packed: float | None = None
    warnings: tuple[str, ...] = ()


def hypothetical_scene(
    points: int, rates: Rates, density: float | None = None, scans: int | None = None
) -> SceneStats:
    """Return a hypothetical scene. density: points/m^2 of surface; None: that of the façade.

    scans: their number; None: scans of 1.4 million points each, as in [Fig12] section 3: 700 scans,
    10^9 points.
    """
    dense = density or rates.density
    number = scans or max(1, round(points / 1.4e6))
    like = "given" if density else "as in a façade of 587,923 points"
    return SceneStats(
        points=points,
        scans=number,
        largest=math.ceil(points / number),
        input_bytes=None,
        formats={"las": points},
        step=None,
        area=points / dense,
        assumed=(
            f"{dense:,.0f} points a square metre of surface ({like})",
            f"{number:,} scans in LAS ({'given' if scans else '1.4 million points each, as in [Fig12] section 3'})",
        ),
    )


class Limit(NamedTuple):
    """Limit of a build. found: amount that the build needs.  most: amount that is available.

    advice: what to do if the limit binds.
    """

    what: str
    found: float
    most: float
    unit: str
    advice: str

    @property
    def binds(self) -> bool:
        """Return whether the build needs more than is available."""
        return self.found > self.most


@dataclass(frozen=True, slots=True, kw_only=True)
class BuildPlan:
    """Estimate of a build; see `estimate`. disk_bytes: most at one time, apart from the scans.

    archive_within: factor; the archive takes at least archive_bytes divided by it and at most
    archive_bytes times it.
    """

    points: int
    scans: int
    lattice_step: float
    density: float
    voxels: int
    points_a_voxel: float
    jobs: int
    archive_bytes: int
    bytes_a_point: float
    archive_within: float
    index_bytes: int
    spool_bytes: int
    preview_bytes: int
    disk_bytes: int
    shards: int
    runs: int
    memory_bytes: int
    stages: dict[str, float]
    seconds: float
    rests_on: tuple[str, ...]
    assumed: tuple[str, ...]
    limits: tuple[Limit, ...] = field(default=())
    warnings: tuple[str, ...] = ()

    def as_json(self) -> dict[str, Any]:
        """Return a JSON value; each limit says whether it binds."""
        limits = [{**limit._asdict(), "binds": limit.binds} for limit in self.limits]
        return {**asdict(self), "limits": limits}


def estimate(scene: SceneStats, config: BuildConfig, rates: Rates, target: Path | None = None) -> BuildPlan:
    """Estimate the build of a scene.

    target: location of the archive, to check free space; None: no check.
    """
    step = config.resolution or scene.step or STEPS[0]
    pitch = math.sqrt(scene.area / scene.points)
    voxels = _voxels(scene, voxel_edge(config.voxel, step), rates)
    jobs = jobs_that_fit(worker_count(config.jobs, scene.points), config)
    bytes_of = {"scan": 0.2, "intensity": 2.0, "rgb": 2.5, "classification": 0.2}
    measured = set() if scene.packed is None else {"scan", "intensity"}
    columns = sum(bytes_of[name] for name in config.keep - measured) + (config.models != {"mean"})
    each = columns + (rates.bytes_a_point(pitch / step) if scene.packed is None else scene.packed)
    size = round(scene.points * each + voxels * (INDEX_BYTES + GROUP_BYTES)) + HEADER_BYTES
    spool = scene.points * spool_dtype(config).itemsize
    runs = _runs(scene, config, jobs)
    directories = min(runs * voxels, scene.points, RUNS_A_VOXEL * voxels + runs) * DIRECTORY_BYTES
    stages = _seconds(scene, config, rates, jobs, size + spool)
    plan = BuildPlan(
        points=scene.points,
        scans=scene.scans,
        lattice_step=step,
        density=scene.points / scene.area,
        voxels=voxels,
        points_a_voxel=scene.points / voxels,
        jobs=jobs,
        archive_bytes=size,
        bytes_a_point=size / scene.points,
        archive_within=MEASURED_WITHIN if scene.packed is not None else GUESSED_WITHIN,
        index_bytes=voxels * INDEX_BYTES,
        spool_bytes=spool,
        preview_bytes=round(
            PREVIEW_BYTES
            * min(MAX_PREVIEW_POINTS, max(WHOLE_PREVIEW_POINTS, scene.points / PREVIEW_PART), scene.points)
        ),
        disk_bytes=size + spool,
        shards=max(1, math.ceil(scene.points / shard_points(scene.points))),
        runs=runs,
        memory_bytes=_memory(scene, config, rates, jobs, voxels * INDEX_BYTES + directories * jobs),
        stages=stages,
        seconds=sum(stages.values()),
        rests_on=(f"{rates.rests_on}, on {rates.machine}, {rates.cores} cores",),
        assumed=(*scene.assumed, *_assumed(config, jobs)),
        warnings=scene.warnings,
    )
    return replace(plan, limits=_limits(plan, scene, config, directories, target))


def _voxels(scene: SceneStats, edge: float, rates: Rates) -> int:
    """Return the number of voxels with points, from a sample of this edge or from the area."""
    if scene.voxels is not None and scene.voxels[0] == edge:
        return max(1, round(scene.voxels[1]))
    return max(1, min(scene.points, round(rates.crossed * scene.area / edge**2)))


def _runs(scene: SceneStats, config: BuildConfig, jobs: int) -> int:
    """Return the number of runs.

    survey_pass.py cuts scans into ranges, spool_pass.py ranges into runs.
    """
    mean = scene.points / scene.scans
    a_range = _range_points(mean)
    a_run = min(a_range, run_points(memory_share(jobs, config), spool_dtype(config)))
    return max(scene.scans, math.ceil(scene.scans * math.ceil(mean / a_range) * math.ceil(a_range / a_run)))


def _range_points(points: float) -> float:
    """Return the points of a range, as survey_pass.py cuts a scan of `points` points."""
    return min(max(points / RANGES, RANGE_POINTS[0]), RANGE_POINTS[1], points)


def _seconds(
    scene: SceneStats, config: BuildConfig, rates: Rates, jobs: int, written: int
) -> dict[str, float]:
    """Return the seconds of each stage.

    The passes that read are slower for formats other than LAS.
    """
    working = min(jobs, os.cpu_count() or 1)
    reading = sum(
        points * max(0.0, rates.read.get(name, rates.read["las"]) - rates.read["las"])
        for name, points in scene.formats.items()
    )
    # A scan that can seek is read in ranges, by several workers; any other by one worker.
    mean = scene.points / scene.scans
    ranges = math.ceil(mean / _range_points(mean)) if set(scene.formats) <= {"las", "laz"} else 1
    reading /= min(working, scene.scans * ranges)
    found = {name: stage.seconds(scene.points, working) for name, stage in rates.stages.items()}
    if jobs > 1:
        found["workers"] = rates.workers
    if config.radius is not None:
        found.pop("radius", None)
    for name in ("survey", "spool")[: rates.passes]:
        found[name] = found.get(name, 0.0) + reading
    least = written / rates.disk
    total = sum(found.values())
    if least > total:  # the disk is the bottleneck
        found["waiting for the disk"] = least - total
    return found


def _memory(scene: SceneStats, config: BuildConfig, rates: Rates, jobs: int, tables: float) -> int:
    """Return the memory of all processes. Tables that grow with voxels are added to --memory."""
    base = rates.process + (jobs * rates.worker if jobs > 1 else 0)
    return round(min(base + rates.point * scene.points, max(base, config.memory_bytes)) + tables)


def _assumed(config: BuildConfig, jobs: int) -> tuple[str, ...]:
    """Return the assumptions of an estimate."""
    said = [f"{jobs} jobs on {os.cpu_count()} cores, each as fast as the measured ones, and no other load"]
    said.append(
        "the disk delivers scans as fast as they are decoded: a slow disk or network adds to survey and spool"
    )
    if config.models != {"mean"}:
        said.append(
            "radius classes: their bytes are included, their time (2.5 µs a point of one core) is not"
        )
    if config.thin is not None or config.outliers is not None or config.moving is not None:
        said.append(
            "filters leave out no point; their time (0.3 to 3 µs a point of one core) is not included"
        )
    if config.cells != "octree":
        said.append("time of octree cells: balanced ones take longer")
    if config.leaf_cells is not None:
        said.append(
            f"bytes of cells of up to {config.cell_points:,} points: their size follows from --leaf-cells when all "
            "points are read; a quarter of it adds 1 % (the time to choose, 0.05 µs a point, is not included)"
        )
    return tuple(said)


def _limits(
    plan: BuildPlan, scene: SceneStats, config: BuildConfig, directories: float, target: Path | None
) -> tuple[Limit, ...]:
    """Return the limits of the build. Some grow with it although --memory is kept."""
    dense = plan.points_a_voxel * DENSEST * plan.bytes_a_point
    edge = voxel_edge(config.voxel, plan.lattice_step)
    found = [
        Limit("voxels along an axis", (scene.extent or math.sqrt(scene.area)) / edge, KEY_BIAS, "voxels",
              "give a larger --voxel, or build in parts"),
        Limit("the densest voxel, compressed", dense, MAX_FRAME, "bytes", "give a smaller --voxel"),
        Limit("index, held by build and server", plan.index_bytes, config.memory_bytes, "bytes",
              "give a larger --voxel: the index takes 100 bytes a voxel"),
        Limit("directories of runs, in each process", directories, config.memory_bytes / plan.jobs, "bytes",
              "give a larger --voxel or --memory, or build in parts"),
        Limit("files of the spool in one folder", 2 * plan.runs, MANY_FILES, "files", "build in parts"),
    ]  # fmt: skip
    if "scan" in config.keep or config.thin or config.outliers or config.moving:
        found.append(
            Limit(
                "scans, as --keep scan and filters number them",
                scene.scans,
                MAX_SCANS,
                "scans",
                "build in parts",
            )
        )
    if target is not None:
        free = shutil.disk_usage(next(p for p in (target, *target.absolute().parents) if p.exists())).free
        found.insert(
            0, Limit("room on the disk", plan.disk_bytes, free, "bytes", "make room, or use another disk")
        )
    return tuple(found)
