"""Makes scenes: a façade, or a town of them, scanned and written, with the truth beside the scan."""

import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ...schemas.errors import BadRequestError
from .facade import SILL, build_facade
from .scanner import LATTICE, NOISE, TRIPOD, Place, RayScene, Scan, plan, scan
from .town import Lot, town_lots
from .truth import FacadeTruth, SceneTruth, StationTruth, write_truth
from .write import check_target, open_target

FEWEST, MOST = 1_000, 1_000_000_000
# A station is held in memory while it is scanned (about 100 bytes a point): more points, more stations.
MOST_PER_STATION = 1_000_000
# x, y and ground of the five stations of [Fig12]'s scene: four outside, from far to near, one in the nave.
STATIONS = ((0.8, -13.0, 0.0), (-6.0, -8.6, 0.0), (5.6, -7.4, 0.0), (0.5, -3.4, 0.0), (0.4, 5.2, SILL))

Progress = Callable[[int, int], None]


class MadeScene(NamedTuple):
    """What was written: the scan's files in the order of their stations, the truth, the count of points."""

    paths: tuple[Path, ...]
    truth: Path
    points: int


class _Job(NamedTuple):
    """One façade to scan: what rays may hit, where to stand, how many points it owes."""

    lot: Lot
    places: tuple[Place, ...]
    points: int


def make_facade(
    out: Path,
    *,
    points: int = 587_923,
    seed: int = 2012,
    door: float = 1.60,
    progress: Progress | None = None,
) -> MadeScene:
    """Make the façade and scan it into exactly `points` points, from five stations (more above 5 million).

    out: `.laz`, `.las` or `.e57` for one file, no suffix for a folder with a LAZ file a station; the truth is
    written beside it as `<name>.truth.json`.  door: clear width of the main door [m].
    The step between rays is chosen so that hits slightly exceed the count; a seeded choice thins them evenly.
    The same arguments give the same coordinates. progress(points written, points in all) after each station.
    """
    out = Path(out)
    _check(out, points)
    facade = build_facade(seed, door)
    count = max(len(STATIONS), -(-points // MOST_PER_STATION))
    job = _Job(Lot(facade.truth, lambda: facade.mesh), _places(count, seed), points)
    return _make(out, points, seed, [job], progress)


def make_town(out: Path, *, points: int, seed: int = 2012, progress: Progress | None = None) -> MadeScene:
    """Make a town of façades as dense as the paper's, as many as the count asks for, and scan each.

    `out`, truth and progress as in `make_facade`. Five stations a façade; rays see the neighbours too.
    """
    out = Path(out)
    _check(out, points)
    lots = town_lots(points, seed)
    owed = [points // len(lots) + (k < points % len(lots)) for k in range(len(lots))]
    jobs = (_Job(lot, _places(len(STATIONS), seed), n) for lot, n in zip(lots, owed, strict=True))
    return _make(out, points, seed, jobs, progress)


def _check(out: Path, points: int) -> None:
    """Refuse, before any work, what cannot be made."""
    check_target(out)
    if not FEWEST <= points <= MOST:
        raise BadRequestError(f"{points} points: expected {FEWEST} to {MOST}: ask for a count between")


def _places(count: int, seed: int) -> tuple[Place, ...]:
    """The first five stations, then as many as are wanted: two on the open forecourt to one in the nave."""
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
    return tuple(Place((x, y, z + TRIPOD), yaw) for (x, y, z), yaw in zip(spots[:count], yaws, strict=True))


def _make(out: Path, points: int, seed: int, jobs: Iterable[_Job], progress: Progress | None) -> MadeScene:
    """Scan job after job, station after station, and write; memory is bounded by one station and its mesh."""
    truth_path = out.with_name(f"{out.stem}.truth.json")
    truth_temporary = truth_path.with_name(f".{truth_path.name}.tmp")
    stations: list[StationTruth] = []
    facades: list[FacadeTruth] = []
    done = 0
    try:
        with open_target(out) as writer:
            for number, job in enumerate(jobs):
                mesh, truth = job.lot.surroundings(), job.lot.truth
                scene = RayScene(mesh)
                step, quotas = plan(scene, job.places, job.points)
                facades.append(truth)
                for k, (place, quota) in enumerate(zip(job.places, quotas, strict=True)):
                    made = _moved(scan(scene, place, step, quota, (seed, number, k)), truth.origin)
                    stations.append(
                        StationTruth(len(stations) + 1, made.place.position, place.yaw, made.step, quota)
                    )
                    writer.write(len(stations), made)
                    done += quota
                    if progress is not None:
                        progress(done, points)
            write_truth(truth_temporary, SceneTruth(seed, points, NOISE, tuple(stations), tuple(facades)))
        os.replace(truth_temporary, truth_path)
    finally:
        truth_temporary.unlink(missing_ok=True)
    paths = tuple(sorted(out.iterdir())) if out.is_dir() else (out,)
    return MadeScene(paths, truth_path, done)


def _moved(made: Scan, origin: tuple[float, float, float]) -> Scan:
    """The scan moved from a façade's frame into the world, on the lattice again."""
    x, y, z = np.add(made.place.position, origin).tolist()
    xyz = np.rint((made.xyz + np.asarray(origin)) / LATTICE) * LATTICE
    return made._replace(place=made.place._replace(position=(x, y, z)), xyz=xyz)
