"""Generation of scenes: a façade or a town of façades, scanned and written with its ground truth."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ...schemas.errors import BadRequestError
from ...schemas.runtime.new_file import new_path
from .facade import SILL, build_facade
from .scanner import (
    LATTICE,
    NOISE,
    TRIPOD,
    RayScene,
    ScannerPose,
    SimulatedScan,
    plan_stations,
    simulate_scan,
)
from .town import Lot, town_lots
from .truth import FacadeTruth, SceneTruth, StationTruth, write_truth
from .write import check_target, open_target

FEWEST, MOST = 1_000, 1_000_000_000
# Maximum points of a station, which is held in memory while it is scanned (about 100 bytes a
# point). More points need more stations.
MAX_PER_STATION = 1_000_000
# x, y and ground height of the five stations of [Fig12]'s scene: four outside, from far to near,
# one in the nave.
STATIONS = ((0.8, -13.0, 0.0), (-6.0, -8.6, 0.0), (5.6, -7.4, 0.0), (0.5, -3.4, 0.0), (0.4, 5.2, SILL))

Progress = Callable[[int, int], None]


class GeneratedScene(NamedTuple):
    """Result of a generation.

    paths: the scan files, in the order of their stations.
    truth: the truth file.
    points: the number of points.
    """

    paths: tuple[Path, ...]
    truth: Path
    points: int


class _Job(NamedTuple):
    """One façade to scan: the lot to cast rays at, the scanner's poses, and the number of points."""

    lot: Lot
    places: tuple[ScannerPose, ...]
    points: int


def make_facade(
    out: Path,
    *,
    points: int = 587_923,
    seed: int = 2012,
    door: float = 1.60,
    progress: Progress | None = None,
) -> GeneratedScene:
    """Generate the façade and scan it into exactly `points` points.

    Five stations scan it, more above 5 million points. The step between rays is chosen for slightly
    more hits than the count; a seeded choice thins them evenly. The same arguments give the same
    coordinates.
    out: `.laz`, `.las` or `.e57` for one file, no suffix for a folder with one LAZ file per
    station; the truth is written beside it as `<name>.truth.json`.
    door: clear width of the main door [m].
    progress: called as progress(points written, points in total) after each station.
    """
    out = Path(out)
    _check(out, points)
    facade = build_facade(seed, door)
    count = max(len(STATIONS), -(-points // MAX_PER_STATION))
    job = _Job(Lot(facade.truth, lambda: facade.mesh), _places(count, seed), points)
    return _make(out, points, seed, [job], progress)


def make_town(
    out: Path, *, points: int, seed: int = 2012, progress: Progress | None = None
) -> GeneratedScene:
    """Generate a town of façades, each as dense as the paper's, and scan each from five stations.

    `points` determines the number of façades. Rays also hit the neighbouring façades. `out`, the
    truth file and `progress` are as in `make_facade`.
    """
    out = Path(out)
    _check(out, points)
    lots = town_lots(points, seed)
    owed = [points // len(lots) + (k < points % len(lots)) for k in range(len(lots))]
    jobs = (_Job(lot, _places(len(STATIONS), seed), n) for lot, n in zip(lots, owed, strict=True))
    return _make(out, points, seed, jobs, progress)


def _check(out: Path, points: int) -> None:
    """Refuse invalid arguments before any work. Raises BadRequestError."""
    check_target(out)
    if not FEWEST <= points <= MOST:
        raise BadRequestError(f"{points} points: expected {FEWEST} to {MOST}: choose a count in this range")


def _places(count: int, seed: int) -> tuple[ScannerPose, ...]:
    """Return `count` scanner poses: the first five stations, then seeded ones.

    Of the latter, two stand on the forecourt for each one in the nave.
    """
    rng = np.random.default_rng([seed, 0x57A7])
    spots = list(STATIONS)
    while len(spots) < count:
        inside = len(spots) % 3 == 2
        x, y = (
            (rng.uniform(-2.5, 2.5), rng.uniform(2.5, 10))
            if inside
            else (rng.uniform(-7.5, 7.5), rng.uniform(-15.5, -6.5))
        )
        spots.append((round(x, 3), round(y, 3), SILL if inside else 0.0))
    yaws = np.round(rng.uniform(-np.pi, np.pi, count), 6).tolist()
    return tuple(
        ScannerPose((x, y, z + TRIPOD), yaw) for (x, y, z), yaw in zip(spots[:count], yaws, strict=True)
    )


def _make(
    out: Path, points: int, seed: int, jobs: Iterable[_Job], progress: Progress | None
) -> GeneratedScene:
    """Scan each job, station by station, and write the files.

    Memory is bounded by one station and its mesh.
    """
    truth_path = out.with_name(f"{out.stem}.truth.json")
    stations: list[StationTruth] = []
    facades: list[FacadeTruth] = []
    done = 0
    with new_path(truth_path) as truth_temporary, open_target(out) as writer:
        for number, job in enumerate(jobs):
            mesh, truth = job.lot.surroundings(), job.lot.truth
            scene = RayScene(mesh)
            step, quotas = plan_stations(scene, job.places, job.points)
            facades.append(truth)
            for k, (place, quota) in enumerate(zip(job.places, quotas, strict=True)):
                scan = _moved(simulate_scan(scene, place, step, quota, (seed, number, k)), truth.origin)
                stations.append(
                    StationTruth(len(stations) + 1, scan.place.position, place.yaw, scan.step, quota)
                )
                writer.write(len(stations), scan)
                done += quota
                if progress is not None:
                    progress(done, points)
        write_truth(truth_temporary, SceneTruth(seed, points, NOISE, tuple(stations), tuple(facades)))
    paths = tuple(sorted(out.iterdir())) if out.is_dir() else (out,)
    return GeneratedScene(paths, truth_path, done)


def _moved(scan: SimulatedScan, origin: tuple[float, float, float]) -> SimulatedScan:
    """Return the scan moved from a façade's frame into the world, on the lattice again."""
    x, y, z = np.add(scan.place.position, origin).tolist()
    xyz = np.rint((scan.xyz + np.asarray(origin)) / LATTICE) * LATTICE
    return scan._replace(place=scan.place._replace(position=(x, y, z)), xyz=xyz)
