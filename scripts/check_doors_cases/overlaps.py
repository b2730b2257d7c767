"""Users placed in contact with sheets, jambs, corners and scans, who try to leave in eight directions."""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.pipeline import build_archive
from solidcloud.schemas.scene.scene_file import ArchiveItem, SceneFile
from solidcloud.server.avatars.avatar_model import make_avatar
from solidcloud.server.scene import Scene
from solidcloud.server.simulation.simulation import make_pipeline
from solidcloud.server.simulation.world.collision_world import World
from solidcloud.server.simulation.world.frame import Body

from .door_walks import EFFECTS, FRAME, RADIUS
from .door_walls import cylinder

Floats = NDArray[np.float64]

# The user: height, radius of its spheres and their spacing; walls: spacing, height and length [m].
_TALL, _SPHERE, _APART = 1.7, 0.02, 0.05
_SPACING, _HIGH, _LONG = 0.02, 2.2, 2.0
# A user walks at this speed [m/s] for this time [s], and is out when it is clear this far away [m].
_SPEED, _SECONDS, _OUT = 1.4, 3.0, 0.3
# The core begins farther than this from all points of a wall, and of a scan, whose points are up to
# 0.1 m apart: nearer, it may be in a surface. It passes a point if it comes this near [m].
_CORE, _SCAN_CORE, _TOUCHED = 0.03, 0.12, 0.005
# A place is enclosed if each way meets an obstacle within this distance [m].
_NEAR = 0.1
_WAYS = np.array([[np.cos(angle), np.sin(angle), 0.0] for angle in np.arange(8) * np.pi / 4])
SHAPES = ("sheet", "jamb", "corner")
# Parts of scans: half their extent [m].
SCANS, _HALF = ("indoor_atrium.laz", "octomap_hall.xyz"), 3.0


class OverlapResult(NamedTuple):
    """Outcome of eight walks from one place [m].

    start: (3,).  enclosed: whether each of the eight ways meets an obstacle at once (_is_enclosed).
    free: how many ended clear.  passed: how many passed the wall, or a point of a scan by its core.
    nearer: largest loss, in a frame that ended in contact, of the distance of the core from the
    nearest point.
    """

    start: list[float]
    enclosed: bool
    free: int
    passed: int
    nearer: float


def wall_of(shape: str, noise: float, rng: np.random.Generator) -> Floats:
    """Return the points (n, 3) of one or two upright sheets: y = 0, and x = 0 for a corner."""
    begin = {"sheet": -_LONG, "jamb": -_LONG, "corner": 0.0}[shape]
    end = 0.0 if shape == "jamb" else _LONG
    along, up = np.meshgrid(np.arange(begin, end + 1e-9, _SPACING), np.arange(0.0, _HIGH, _SPACING))
    sheet = np.c_[along.ravel(), np.zeros(along.size), up.ravel()]
    points = np.r_[sheet, sheet[:, [1, 0, 2]]] if shape == "corner" else sheet
    return points + rng.normal(0.0, noise, points.shape)


def part_of_scan(path: Path, rng: np.random.Generator) -> Floats:
    """Return the points (n, 3) of a scan around one of them, chosen at random [m]."""
    if path.suffix == ".laz":
        import laspy

        points = np.asarray(laspy.read(path).xyz)
    else:
        points = np.loadtxt(path)[:, :3]
    middle = points[rng.integers(len(points))]
    return points[(np.abs(points - middle) < _HALF).all(axis=1)] - middle


def _place(shape: str, rng: np.random.Generator) -> Floats:
    """Return a place (2,) of a user's axis, in contact and with its core apart from the wall."""
    far, near = RADIUS + _SPHERE, rng.uniform(_CORE, RADIUS + _SPHERE)
    side = rng.choice([-1.0, 1.0])
    if shape == "sheet":
        return np.array([rng.uniform(-1.0, 1.0), side * near])
    if shape == "jamb":
        angle = rng.uniform(-0.5, 0.5) * np.pi
        beside = np.array([rng.uniform(-0.6, 0.0), side * near])
        return beside if rng.random() < 0.5 else near * np.array([np.cos(angle), np.sin(angle)])
    if rng.random() < 0.3:  # at the corner's outer side
        return np.array([rng.uniform(0.0, 1.0), -near])[:: int(side)]
    return np.array([near, rng.uniform(_CORE, far)])[:: int(side)]


def _passes(shape: str, path: Floats) -> bool:
    """Return whether the path (n, 2) of an axis crosses a sheet of the wall."""
    begin = {"sheet": -_LONG, "jamb": -_LONG, "corner": 0.0}[shape]
    end = 0.0 if shape == "jamb" else _LONG
    found = False
    for across in (1, 0) if shape == "corner" else (1,):
        one, two = path[:-1], path[1:]
        crosses = (one[:, across] < 0.0) != (two[:, across] < 0.0)
        share = one[crosses, across] / (one[crosses, across] - two[crosses, across])
        at = one[crosses, 1 - across] + share * (two[crosses, 1 - across] - one[crosses, 1 - across])
        found |= bool(((at > begin) & (at < end)).any())
    return found


def _distances(points: Floats, place: Floats) -> Floats:
    """Return the distances (n,) of points (n, 3) from the core of a user at a place (3,) [m]."""
    half = 0.5 * _TALL - RADIUS
    gap = points - place - np.array([0.0, 0.0, 0.5 * _TALL])
    gap[:, 2] -= np.clip(gap[:, 2], -half, half)
    return np.sqrt((gap**2).sum(axis=1))


def _is_enclosed(points: Floats, place: Floats) -> bool:
    """Return whether each of the eight ways from a place comes nearer to a point that it touches.

    Ways are straight, of _NEAR, and tried at every centimetre. A user may take none of them to its
    end, because no pair in contact may come nearer and no new one is allowed. The radius of the
    points is left out, so that fewer places count.
    """
    begin = _distances(points, place)
    for way in _WAYS:
        for length in np.arange(0.01, _NEAR + 0.001, 0.01):
            now = _distances(points, place + length * way)
            if ((now < RADIUS + _SPHERE) & (now < begin - 0.001)).any():
                break
        else:
            return False
    return True


def overlap_walks(
    folder: Path, shape: str, scan: Floats, count: int, rng: np.random.Generator
) -> Iterator[OverlapResult]:
    """Place `count` users at random in contact with a wall, and walk in eight directions from each.

    shape: one of SHAPES, or the name of a scan, which users may begin anywhere in.
    scan: (n, 3); a floor is added to a wall.
    """
    number = sum(1 for _ in folder.iterdir())
    file, archive = folder / f"{number}.xyz", folder / f"archive{number}"
    ground = np.stack(np.meshgrid(*[np.arange(-_LONG, _LONG, _SPACING)] * 2), axis=-1).reshape(-1, 2)
    floor = np.c_[ground, np.zeros(len(ground))]
    np.savetxt(file, np.r_[floor, scan] if shape in SHAPES else scan, fmt="%.4f")
    radius = _SPACING / 2 if shape in SHAPES else None
    build_archive([file], archive, BuildConfig(voxel=2.0, resolution=1e-4, radius=radius, jobs=1))
    avatar = make_avatar(cylinder(RADIUS, _TALL, _SPHERE, _APART), _SPHERE)
    options = SceneFile(format=1, archives=[ArchiveItem(path=str(archive))], effects=EFFECTS)
    with Scene.open(archive) as scene:
        world = World(scene, options)
        pipeline, done = make_pipeline(options, world), 0
        while done < count:
            pose, angle = np.eye(4), rng.uniform(0.0, 2.0 * np.pi)
            pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
            if shape in SHAPES:
                pose[:2, 3], pose[2, 3] = _place(shape, rng), rng.uniform(0.015, 0.045)
            else:
                pose[:3, 3] = scan[rng.integers(len(scan))] + rng.uniform(-0.35, 0.35, 3)
                pose[2, 3] -= rng.uniform(0.0, _TALL)
            if _distances(scan, pose[:3, 3]).min() < (_CORE if shape in SHAPES else _SCAN_CORE) or not int(
                world.collide(avatar, pose)
            ):
                continue
            done += 1
            free = passed = 0
            nearer = 0.0
            for way in _WAYS:
                body = Body("check/body", avatar, pose.copy())
                step = _SPEED * FRAME * way
                path, verdict, touched = [body.pose[:3, 3].copy()], 1, False
                apart = float(_distances(scan, pose[:3, 3]).min())
                for _ in range(round(_SECONDS / FRAME)):
                    target = body.pose.copy()
                    target[:3, 3] += step
                    verdict = int(pipeline.run(body, target, FRAME).verdict)
                    path.append(body.pose[:3, 3].copy())
                    if verdict:
                        now = float(_distances(scan, body.pose[:3, 3]).min())
                        nearer, apart = max(nearer, apart - now), now
                        touched |= now < _TOUCHED
                    if not verdict and np.linalg.norm(path[-1] - path[0]) > _OUT:
                        break
                free += not verdict
                passed += touched or (shape in SHAPES and _passes(shape, np.array(path)[:, :2]))
            start = pose[:3, 3]
            enclosed = not free and _is_enclosed(scan, start)
            yield OverlapResult(start.round(3).tolist(), enclosed, free, passed, nearer)
