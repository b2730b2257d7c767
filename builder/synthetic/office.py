"""Office scanned from two stations, with stray points whose numbers are known.

A room with a door to a corridor, a desk and a column. Both stations stand in the room, so that the
scans overlap. The strays are added to what the rays hit:

- dust: single points in the air of the room, each in one scan;
- a person who walked through the door while the second scan was made: level bands of a figure, in
  that scan only.

Strays keep a distance of CLEARANCE from all solids. Unlike the façade's, the scans have no mixed
returns, so that every other point is one of a surface.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from ...schemas.errors import BadRequestError
from ...schemas.runtime.new_file import new_path
from .figure import figure_points
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
from .scenes import GeneratedScene
from .shapes import Parts
from .truth import DoorTruth, OfficeTruth, StationTruth, StrayTruth, write_truth
from .write import check_target, open_target

POINTS = 600_000
# The room: x, y and z [m]; beyond the wall at y = 0, WALL thick, the corridor to y = CORRIDOR_Y.
ROOM_X, ROOM_Y, ROOM_Z = (-3.0, 3.0), (0.0, 5.0), (0.0, 2.6)
WALL, CORRIDOR_Y = 0.15, -2.0
# Clear width and height of the door, at x = 0. A person in it leaves less than 0.25 m on either side.
DOOR_WIDTH, DOOR_HEIGHT = 1.0, 2.1
# The desk: low and high corner of its top [m].
DESK = ((-2.6, 3.4, 0.72), (-1.1, 4.2, 0.75))
LEG = 0.05
# The column: x, y and radius [m].
COLUMN = (1.9, 1.7, 0.2)
# x and y of the stations [m]. Both see the floor behind the door.
STATIONS = ((0.9, 3.6), (-0.8, 2.2))
DUST = 240
# Heights of the dust [m].
DUST_Z = (0.4, 1.9)
# Least distance of strays from a solid, along an axis [m].
CLEARANCE = 0.21
# Bands of the person: lower edges and height [m], and the number of points of the whole figure.
BANDS, BAND, FIGURE_POINTS = (0.45, 0.70, 0.95, 1.20, 1.45), 0.05, 3000

Box = tuple[tuple[float, float], tuple[float, float], tuple[float, float]]


def office_solids() -> list[Box]:
    """Return the solids of the office but the column, as intervals of x, y and z [m]."""
    (x0, x1), (_, y1), (z0, z1) = ROOM_X, ROOM_Y, ROOM_Z
    half, thick, low = DOOR_WIDTH / 2, 0.2, CORRIDOR_Y
    walls: list[Box] = [
        ((x0 - thick, x0), (low, y1), (z0, z1)),
        ((x1, x1 + thick), (low, y1), (z0, z1)),
        ((x0, x1), (y1, y1 + thick), (z0, z1)),
        ((x0, x1), (low - thick, low), (z0, z1)),
        ((x0, -half), (-WALL, 0.0), (z0, z1)),
        ((half, x1), (-WALL, 0.0), (z0, z1)),
        ((-half, half), (-WALL, 0.0), (DOOR_HEIGHT, z1)),
        ((x0, x1), (low, y1), (z0 - thick, z0)),
        ((x0, x1), (low, y1), (z1, z1 + thick)),
    ]
    (dx0, dy0, dz0), (dx1, dy1, dz1) = DESK
    legs: list[Box] = [
        ((x, x + LEG), (y, y + LEG), (z0, dz0)) for x in (dx0, dx1 - LEG) for y in (dy0, dy1 - LEG)
    ]
    return [*walls, ((dx0, dx1), (dy0, dy1), (dz0, dz1)), *legs]


def solid_distances(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distance (n,) of points (n, 3) from the nearest solid [m], the largest of the three axes.

    The column counts as a box.
    """
    x, y, radius = COLUMN
    column: Box = ((x - radius, x + radius), (y - radius, y + radius), ROOM_Z)
    found = np.full(len(points), np.inf)
    for box in [*office_solids(), column]:
        low, high = np.array(box).T
        found = np.minimum(found, np.maximum(low - points, points - high).max(axis=1))
    return found


def make_office(
    out: Path, *, seed: int = 2012, progress: Callable[[int, int], None] | None = None
) -> GeneratedScene:
    """Generate the office and scan it from two stations into POINTS points and the strays.

    The same seed gives the same coordinates. The strays are the last points of each scan.
    out: `.e57`, or no suffix for a folder with one LAZ file per station: the scans must stay apart,
    because only one of them saw the person. The truth is written beside it as `<name>.truth.json`.
    progress: called as progress(points written, points in total) after each station.
    """
    out = Path(out)
    check_target(out)
    if out.suffix.lower() not in ("", ".e57"):
        raise BadRequestError(
            f"{out}: one file for two scans: expected .e57, or no suffix for a folder: rename the output"
        )
    truth_path = out.with_name(f"{out.stem}.truth.json")
    rays = RayScene(_mesh())
    rng = np.random.default_rng([seed, 0x0FF1CE])
    yaws = np.round(rng.uniform(-np.pi, np.pi, len(STATIONS)), 6).tolist()
    places = [ScannerPose((x, y, TRIPOD), yaw) for (x, y), yaw in zip(STATIONS, yaws, strict=True)]
    step, quotas = plan_stations(rays, places, POINTS)
    strays = _strays(seed, rng)
    total = POINTS + sum(len(points) for of in strays for points in of.values())
    stations: list[StationTruth] = []
    known: list[StrayTruth] = []
    done = 0
    with new_path(truth_path) as truth_temporary, open_target(out) as writer:
        for number, (place, quota, added) in enumerate(zip(places, quotas, strays, strict=True), 1):
            scan = simulate_scan(rays, place, step, quota, (seed, 0x0FF1CE, number), mixed=False)
            first = len(scan.xyz)
            for kind, points in added.items():
                known.append(StrayTruth(kind, number, first, len(points)))
                first += len(points)
            scan = _with_points(scan, np.concatenate(list(added.values())))
            stations.append(StationTruth(number, place.position, place.yaw, scan.step, len(scan.xyz)))
            writer.write(number, scan)
            done += len(scan.xyz)
            if progress is not None:
                progress(done, total)
        half = DOOR_WIDTH / 2
        door = DoorTruth("main", -half, half, -WALL, 0.0, 0.0, DOOR_HEIGHT, DOOR_HEIGHT)
        write_truth(truth_temporary, OfficeTruth(seed, done, NOISE, tuple(stations), door, tuple(known)))
    paths = tuple(sorted(out.iterdir())) if out.is_dir() else (out,)
    return GeneratedScene(paths, truth_path, done)


def _mesh() -> trimesh.Trimesh:
    """Return the solids as one mesh."""
    parts = Parts()
    for box in office_solids():
        parts.box(*box)
    parts.cylinder(*COLUMN, ROOM_Z)
    return parts.mesh()


def _strays(seed: int, rng: np.random.Generator) -> list[dict[str, NDArray[np.float64]]]:
    """Return the strays of each scan: kind -> points (n, 3) [m]."""
    low, high = np.array([ROOM_X, ROOM_Y, DUST_Z]).T
    dust = np.empty((0, 3))
    while len(dust) < DUST:
        drawn = rng.uniform(low, high, (4 * DUST, 3))
        dust = np.concatenate([dust, drawn[solid_distances(drawn) > CLEARANCE]])[:DUST]
    of_first = rng.uniform(size=DUST) < 0.5
    figure = figure_points(FIGURE_POINTS, seed)
    heights = figure[:, 2:] - np.array(BANDS)
    person = figure[((heights >= 0) & (heights < BAND)).any(axis=1)] - np.array([0.0, WALL / 2, 0.0])
    person = person[solid_distances(person) > CLEARANCE]
    return [{"dust": dust[of_first]}, {"dust": dust[~of_first], "person": person}]


def _with_points(scan: SimulatedScan, points: NDArray[np.float64]) -> SimulatedScan:
    """Append points (n, 3) [m], as dark as a grazing return, to a scan."""
    xyz = np.concatenate([scan.xyz, np.rint(points / LATTICE) * LATTICE])
    intensity = np.concatenate([scan.intensity, np.full(len(points), 100, np.uint16)])
    return scan._replace(xyz=xyz, intensity=intensity)
