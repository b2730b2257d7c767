"""Rates that `solidcloud plan` goes by, from builds of two sizes by one worker and by two."""

import os
import platform
import statistics
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import laspy
import numpy as np
from solidcloud.builder.measure import read_rates
from solidcloud.builder.plan import Rates, Stage
from solidcloud.builder.sample import CUBES

from .build_limits import write_seconds
from .build_runs import REST, Built
from .machine import cpu_name, say

SMALL, LARGE = 1_000_000, 10_000_000
WRITTEN = 256 << 20
# Reading the scans twice, survey and spool, is how a build is made.
PASSES = 2


def fit_stage(times: Mapping[tuple[int, int], float]) -> Stage:
    """A stage from its seconds at (points, jobs): two sizes, one job and two.

    Nothing is below 0, and two jobs are at most twice as fast.
    """
    small, large = min(p for p, _ in times), max(p for p, _ in times)
    one, two = (max(0.0, times[large, jobs] - times[small, jobs]) / (large - small) for jobs in (1, 2))
    parallel = min(max(0.0, 2 * (one - two)), one)
    serial = one - parallel
    start = times[small, 1] - small * (serial + parallel)
    return Stage(max(0.0, start), serial, parallel)


def fit_stages(builds: Mapping[tuple[int, int], Sequence[Built]]) -> dict[str, Stage]:
    """All stages of builds at (points, jobs), the best time of each, for what slows it is not the builder."""
    names = list(dict.fromkeys(name for runs in builds.values() for run in runs for name in run.stages))
    found = {
        name: fit_stage({at: min(run.stages.get(name, 0.0) for run in runs) for at, runs in builds.items()})
        for name in names
    }
    found["start, end"] = found.pop(REST)
    return found


def fit_workers(builds: Mapping[tuple[int, int], Sequence[Built]], stages: Mapping[str, Stage]) -> float:
    """Seconds that starting processes takes: what builds by two jobs take beyond what the stages say."""
    beyond = [
        min(run.seconds for run in runs) - sum(stage.seconds(points, jobs) for stage in stages.values())
        for (points, jobs), runs in builds.items()
        if jobs == 2
    ]
    return max(0.0, statistics.median(beyond))


def fit_memory(builds: Mapping[tuple[int, int], Sequence[Built]]) -> tuple[float, float, float]:
    """Memory of the first process, of each other, and of a point [bytes]."""
    peak = {at: statistics.median(run.watched.peak or 0 for run in runs) for at, runs in builds.items()}
    small, large = min(p for p, _ in peak), max(p for p, _ in peak)
    point = max(0.0, max(peak[large, jobs] - peak[small, jobs] for jobs in (1, 2)) / (large - small))
    process = max(0.0, peak[small, 1] - point * small)
    worker = max(0.0, (peak[small, 2] - point * small - process) / 2)
    return process, worker, point


def surface(las: Path) -> float:
    """The surface of a scan [m^2], as builder/sample.py counts it, from all points."""
    found: set[tuple[int, int, int]] = set()
    with laspy.open(las) as file:
        for chunk in file.chunk_iterator(1 << 20):
            cubes = np.floor(np.stack([chunk.x, chunk.y, chunk.z], axis=1) / CUBES[0]).astype(np.int64)
            found.update(map(tuple, np.unique(cubes, axis=0).tolist()))
    return len(found) * CUBES[0] ** 2


def measure_rates(
    scan_of: Callable[[int], Path],
    build: Callable[[int, int, float | None], Built],
    folder: Path,
    paper_points: int,
    repeat: int,
) -> Rates:
    """Build and read what rates need. scan_of: points -> a façade.  build: points, jobs, step -> a build of it."""
    builds = {
        (points, jobs): [build(points, jobs, None) for _ in range(repeat)]
        for points in (SMALL, LARGE)
        for jobs in (1, 2)
    }
    paper = scan_of(paper_points)
    area = surface(paper)
    archive = []
    for points, step in ((paper_points, 1e-4), (paper_points, 1e-3), (LARGE, 1e-3), (LARGE, 1e-4)):
        one = builds[LARGE, 2][0] if (points, step) == (LARGE, 1e-4) else build(points, 2, step)
        pitch = (surface(scan_of(points)) / points) ** 0.5
        archive.append((pitch / step, one.bytes_a_point))
        if (points, step) == (paper_points, 1e-4):
            voxels = one.summary["voxels"]
    say("reading each format")
    read = read_rates(folder)
    process, worker, point = fit_memory(builds)
    stages = fit_stages(builds)
    cores = os.cpu_count() or 1
    return Rates(
        machine=f"{platform.machine()}, {cpu_name()}",
        cores=cores,
        rests_on=f"builds of made façades of {SMALL:,} and {LARGE:,} points, LAS, 0.1 mm, voxels of 8 m, 1 and 2 jobs",
        stages=stages,
        workers=fit_workers(builds, stages),
        read=read,
        passes=PASSES,
        archive=sorted(archive),
        process=process,
        worker=worker,
        point=point,
        disk=WRITTEN / write_seconds(folder, WRITTEN),
        density=paper_points / area,
        crossed=voxels * 64 / area,
    )
