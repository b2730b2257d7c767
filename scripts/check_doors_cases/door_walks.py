"""Walks at a door, simulated frame by frame, and what an ideal disc does in their place."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.pipeline import build_archive
from solidcloud.schemas.scene.effect_table import Ground, Slide, Step, Stop, Sweep
from solidcloud.schemas.scene.scene_file import ArchiveItem, SceneFile
from solidcloud.server.avatars.avatar_model import AvatarModel, make_avatar
from solidcloud.server.scene import Scene
from solidcloud.server.simulation.simulation import Pipeline, make_pipeline
from solidcloud.server.simulation.world.collision_world import World
from solidcloud.server.simulation.world.frame import Body

from .door_walls import SPACING, DoorWall, cylinder
from .ideal_disc import disc_paths

Floats = NDArray[np.float64]

EFFECTS = [Stop(), Sweep(), Slide(), Step(), Ground()]
# The body: radius, height, radius of its spheres and their spacing [m]. With at most 8,192 spheres, a
# frame takes the server's fast path.
RADIUS, TALL, SPHERE, APART = 0.25, 0.8, 0.01, 0.014
# Distance from the first touch at which a walk begins, and height of the feet [m].
_RUN_UP, _FEET = 0.15, 0.035
# A walk ends when the body is through: its axis is this far behind the wall [m].
_BEHIND = 0.3
# Length of a walk, if it is never stopped [m].
_LONGEST = 2.4
# A body that moved less than _STILL [m] in _STILL_FRAMES frames is stuck.
_STILL, _STILL_FRAMES = 1e-3, 20
FRAME = 1 / 30
# Largest angle of a way from the wall's normal [rad].
MAX_ANGLE = 0.7
# A walk begins at least this far from the wall [m].
_CLEAR = 0.02
# A walk must pass if the ideal disc passes with its way turned by these angles [rad], and with each
# radius. Near head on, a body stays as by friction.
_TURNS = (-0.15, 0.0, 0.15)
# The walk along a wall: its angle to the wall [rad], its frames, and those before it is measured.
_INTO, _ALONG_FRAMES, _SETTLED = 0.35, 45, 5


class DoorWalk(NamedTuple):
    """A straight walk at the right jamb, at x > 0.

    overlap: depth by which the body overlaps the jamb, across its way [m].
    angle: of the way from the wall's normal, positive to the right [rad].  speed: [m/s].
    """

    overlap: float
    angle: float
    speed: float

    def way(self) -> Floats:
        """Return the direction (2,)."""
        return np.array([np.sin(self.angle), np.cos(self.angle)])

    def start(self, wall: DoorWall) -> Floats:
        """Return where the body's axis begins (2,) [m]."""
        way = self.way()
        right = np.array([way[1], -way[0]])
        return np.array([wall.width / 2, 0.0]) - (RADIUS - self.overlap) * right - (RADIUS + _RUN_UP) * way


class WalkResult(NamedTuple):
    """Outcome of a walk. passed: whether the body is behind the wall.  end: (2,) its axis [m].

    touched: number of poses in contact.
    """

    passed: bool
    end: tuple[float, float]
    frames: int
    touched: int


class DoorScene(NamedTuple):
    """A wall's scene with its effects."""

    wall: DoorWall
    scene: Scene
    world: World
    pipeline: Pipeline
    avatar: AvatarModel

    def walk(self, walk: DoorWalk) -> WalkResult:
        """Simulate a walk until the body is behind the wall, or stuck."""
        pose = np.eye(4)
        pose[:2, 3], pose[2, 3] = walk.start(self.wall), _FEET
        body = Body("check/body", self.avatar, pose)
        way = np.append(walk.way() * walk.speed * FRAME, 0.0)
        places = [pose[:2, 3].copy()]
        touched = 0
        for _ in range(round(_LONGEST / walk.speed / FRAME)):
            target = body.pose.copy()
            target[:3, 3] += way
            moved = self.pipeline.run(body, target, FRAME)
            touched += int(moved.verdict) != 0
            places.append(body.pose[:2, 3].copy())
            if places[-1][1] > self.wall.depth + _BEHIND:
                break
            if len(places) > _STILL_FRAMES and np.abs(places[-1] - places[-_STILL_FRAMES]).max() < _STILL:
                break
        x, y = places[-1].tolist()
        return WalkResult(y > self.wall.depth + _BEHIND, (x, y), len(places) - 1, touched)

    def push(self, start: Floats, way: Floats, frames: int) -> tuple[float, float]:
        """Push a body along a direction (2,) at 1 m/s. Return where its axis ends [m].

        start: (2,), where its axis begins.
        """
        pose = np.eye(4)
        pose[:2, 3], pose[2, 3] = start, _FEET
        body = Body("check/body", self.avatar, pose)
        step = np.append(way / np.linalg.norm(way) * FRAME, 0.0)
        for _ in range(frames):
            target = body.pose.copy()
            target[:3, 3] += step
            self.pipeline.run(body, target, FRAME)
        x, y = body.pose[:2, 3].tolist()
        return x, y


@contextmanager
def open_door(wall: DoorWall, folder: Path, rng: np.random.Generator) -> Iterator[DoorScene]:
    """Build the archive of a wall in a new folder inside `folder`, and open it with the effects."""
    number = sum(1 for _ in folder.iterdir())
    scan, archive = folder / f"{number}.xyz", folder / f"archive{number}"
    np.savetxt(scan, wall.points(rng), fmt="%.5f")
    build_archive([scan], archive, BuildConfig(voxel=2.0, resolution=1e-4, radius=SPACING / 2, jobs=1))
    file = SceneFile(format=1, archives=[ArchiveItem(path=str(archive))], effects=EFFECTS)
    with Scene.open(archive) as scene:
        world = World(scene, file)
        avatar = make_avatar(cylinder(RADIUS, TALL, SPHERE, APART), SPHERE)
        yield DoorScene(wall, scene, world, make_pipeline(file, world), avatar)


def begins_clear(wall: DoorWall, walk: DoorWalk) -> bool:
    """Return whether the body does not touch the wall where a walk begins."""
    return wall.separation(walk.start(wall)) > RADIUS + _CLEAR


def wall_jitter(folder: Path, noise: float, seed: int) -> dict[str, float]:
    """Walk along a flat wall and into it, by 20 degrees. Return the figures.

    jitter: root of the mean squared change of the distance from the wall, frame by frame [m].
    spread: standard deviation of this distance [m].  gone: share of the commanded way along the
    wall that the body went.
    """
    wall = DoorWall(0.0, noise=noise)  # without a door
    with open_door(wall, folder, np.random.default_rng(seed)) as door:
        pose = np.eye(4)
        pose[:3, 3] = -0.7, -RADIUS - 0.02, _FEET
        body = Body("check/body", door.avatar, pose)
        way = np.array([np.cos(_INTO), np.sin(_INTO), 0.0]) * FRAME
        places = []
        for _ in range(_ALONG_FRAMES):
            target = body.pose.copy()
            target[:3, 3] += way
            door.pipeline.run(body, target, FRAME)
            places.append(body.pose[:2, 3].copy())
    x, y = np.array(places[_SETTLED:]).T
    return {
        "noise": noise,
        "jitter": float(np.sqrt((np.diff(y) ** 2).mean())),
        "spread": float(y.std()),
        "gone": float((x[-1] - x[0]) / (way[0] * (len(x) - 1))),
    }


def ideal_passes(wall: DoorWall, walks: Sequence[DoorWalk]) -> NDArray[np.bool_]:
    """Return whether an ideal disc of the body's size passes (k,), however its way is turned.

    It is as wide as the body, the scan's spheres, the distance that `stop` keeps, and noise.
    """
    radius = np.full(len(walks), RADIUS + SPACING / 2 + Stop().skin + 2 * wall.noise)
    passes = np.ones(len(walks), bool)
    for turn in _TURNS:
        turned = [walk._replace(angle=walk.angle + turn) for walk in walks]
        starts = np.array([walk.start(wall) for walk in walks])
        ways = np.array([walk.way() for walk in turned])
        ends = disc_paths(wall.segments(), radius, starts, ways, _LONGEST)
        passes &= ends[:, 1] > wall.depth + _BEHIND
    return passes
