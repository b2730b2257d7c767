"""Rates that `solidcloud plan` uses, fitted to builds of several sizes by one worker and by two."""

import os
import platform
import statistics
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import laspy
import numpy as np
from solidcloud.builder.plan.measure_rates import read_rates
from solidcloud.builder.plan.rates import Rates, StageRate
from solidcloud.builder.plan.scan_sample import CUBES
from solidcloud.server.report.common.bench_results import BUSY
from solidcloud.server.report.common.machine import cpu_name, say

from .build_limits import write_seconds
from .build_runs import REST, Built

Builds = Mapping[tuple[int, int], Sequence[Built]]
# Time to start two processes [s], for a machine too busy to measure it.
USUAL_WORKERS = 1.2

# A build of TINY takes little more than its start. Up to SMALL the closest neighbours of all points
# are searched (RADIUS_SAMPLE).
TINY, SMALL, LARGE = 20_000, 1_000_000, 10_000_000
SIZES = ((TINY, 1), (SMALL, 1), (LARGE, 1), (SMALL, 2), (LARGE, 2))
WRITTEN = 256 << 20
# A build reads the scans twice: survey and spool.
PASSES = 2


def fit_stage(times: Mapping[tuple[int, int], float]) -> StageRate:
    """Fit a stage to its seconds at SIZES, (points, jobs).

    No parameter is below 0, and two jobs are at most twice as fast as one.
    """
    one, two = (max(0.0, times[LARGE, jobs] - times[SMALL, jobs]) / (LARGE - SMALL) for jobs in (1, 2))
    parallel = min(max(0.0, 2 * (one - two)), one)
    start = max(0.0, times[TINY, 1] - TINY * one)
    first = max(0.0, (times[SMALL, 1] - start) / SMALL - one)
    return StageRate(start, first, one - parallel, parallel)


def calm_times(name: str, builds: Builds) -> dict[tuple[int, int], float]:
    """Return the least seconds of a stage at each of SIZES, which other work disturbs least.

    On a busy machine a build by one job is assumed to take its processor time, and two jobs half of
    that. On an idle machine this holds within a tenth, except for the start and the end.
    """
    if not is_busy(builds):
        return {at: min(run.stages.get(name, 0.0) for run in runs) for at, runs in builds.items()}
    found = {}
    for points, jobs in builds:
        alone = [
            run.stages.get(name, 0.0) * min(1.0, run.watched.cpu / run.seconds) for run in builds[points, 1]
        ]
        found[points, jobs] = min(alone) / (1 if name in (REST, "publish") else jobs)
    return found


def is_busy(builds: Builds) -> bool:
    """Return whether other work on the machine affected the times."""
    return max(run.watched.others or 0.0 for runs in builds.values() for run in runs) > BUSY


def fit_stages(builds: Builds) -> dict[str, StageRate]:
    """Fit all stages to builds at SIZES."""
    names = list(dict.fromkeys(name for runs in builds.values() for run in runs for name in run.stages))
    found = {name: fit_stage(calm_times(name, builds)) for name in names}
    found["start, end"] = found.pop(REST)
    return found


def fit_workers(builds: Builds, stages: Mapping[str, StageRate]) -> float:
    """Return the seconds of starting processes.

    This is the time of builds by two jobs beyond that of the stages.
    """
    if is_busy(builds):
        return USUAL_WORKERS
    beyond = [
        min(run.seconds for run in runs) - sum(stage.seconds(points, jobs) for stage in stages.values())
        for (points, jobs), runs in builds.items()
        if jobs == 2
    ]
    return max(0.0, statistics.median(beyond))


def fit_memory(builds: Builds) -> tuple[float, float, float]:
    """Return the memory of the first process, of each further process, and of a point [bytes]."""
    peak = {at: statistics.median(run.watched.peak or 0 for run in runs) for at, runs in builds.items()}
    point = max(0.0, max(peak[LARGE, jobs] - peak[SMALL, jobs] for jobs in (1, 2)) / (LARGE - SMALL))
    process = max(0.0, peak[SMALL, 1] - point * SMALL)
    worker = max(0.0, (peak[SMALL, 2] - point * SMALL - process) / 2)
    return process, worker, point


def surface(las: Path) -> float:
    """Return the surface of a scan [m^2] as builder/plan/scan_sample.py counts it, from all points."""
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
    """Run the builds and reads that the rates need, and fit the rates.

    scan_of: points -> a façade.
    build: points, jobs, step -> a build of it.
    """
    builds = {(points, jobs): [build(points, jobs, None) for _ in range(repeat)] for points, jobs in SIZES}
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
    busy = " while other work ran, by processor time" if is_busy(builds) else ""
    return Rates(
        machine=f"{platform.machine()}, {cpu_name()}",
        cores=cores,
        rests_on=f"builds of made façades of {SMALL:,} and {LARGE:,} points, LAS, 0.1 mm, voxels of 8 m{busy}",
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
