"""Rooms of scan points, bodies in them, and frames, for tests of the effects that change motion."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import archive_cases
import numpy as np
from numpy.typing import NDArray
from solidcloud.schemas.scene.effect_table import AnyEffect
from solidcloud.schemas.scene.scene_file import ArchiveItem, SceneFile, SceneLimits
from solidcloud.schemas.wire.motion_messages import Moved
from solidcloud.server.avatars.avatar_model import AvatarModel, make_avatar
from solidcloud.server.scene import Scene
from solidcloud.server.simulation.simulation import Pipeline, make_pipeline
from solidcloud.server.simulation.world.collision_world import World
from solidcloud.server.simulation.world.frame import Body

INTERPRETED = os.environ.get("NUMBA_DISABLE_JIT") == "1"
# Radius of the scan's spheres [m] and their spacing. The spacing is smaller than the spheres, so
# that walls have no holes. Interpreted, there are fewer.
RADIUS, APART = (0.03, 0.04) if not INTERPRETED else (0.12, 0.2)

Points = NDArray[np.float64]


def plane(low: tuple[float, float, float], high: tuple[float, float, float], apart: float = APART) -> Points:
    """Return points (n, 3) of an upright or level rectangle, with both corners."""
    sides = [
        np.linspace(a, b, round(abs(b - a) / apart) + 1) if a != b else np.array([a])
        for a, b in zip(low, high, strict=True)
    ]
    return np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 3)


def room(size: float, *, half: bool = False) -> Points:
    """Return the six sides of a cube around the origin. half: with a thin wall across, at x = 0."""
    e = size / 2
    sides = [
        plane(tuple(low), tuple(high))
        for axis in range(3)
        for end in (-e, e)
        for low, high in [
            ([end if k == axis else -e for k in range(3)], [end if k == axis else e for k in range(3)])
        ]
    ]
    if half:
        sides.append(plane((0.0, -e, -e), (0.0, e, e)))
    return np.unique(np.round(np.concatenate(sides), 6), axis=0)


def body_box(half: float = 0.15, radius: float = 0.08) -> AvatarModel:
    """Return spheres at the corners and in the middle of a cube."""
    corners = [[x, y, z] for x in (-half, half) for y in (-half, half) for z in (-half, half)]
    return make_avatar([[0.0, 0.0, 0.0], *corners], radius)


def person(radius: float = 0.05) -> AvatarModel:
    """Return a body 0.4 m wide and 1 m high, with its feet at the origin."""
    heights = np.linspace(radius, 1.0 - radius, 6)
    side = np.linspace(-0.2 + radius, 0.2 - radius, 3)
    return make_avatar([[x, y, z] for z in heights for x in side for y in side], radius)


def at(x: float, y: float, z: float, angle: float = 0.0) -> Points:
    """Return a pose (4, 4) rotated about z."""
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return archive_cases.pose_of(turn, np.array([x, y, z]))


class Play(NamedTuple):
    """A scene whose frames are simulated."""

    scene: Scene
    world: World
    pipeline: Pipeline

    def body(self, avatar: AvatarModel, pose: Points) -> Body:
        """Return a body at a pose."""
        return Body("client/avatar", avatar, pose.copy(), user=("client", "avatar"))

    def go(self, body: Body, way: Any, turn: Points | None = None, seconds: float = 1 / 30) -> Moved:
        """Simulate a frame of a body. way: translation (3,).  turn: target orientation (3, 3)."""
        wish = body.pose.copy()
        wish[:3, 3] += np.asarray(way, np.float64)
        if turn is not None:
            wish[:3, :3] = turn
        return self.pipeline.run(body, wish, seconds)

    def touches(self, body: Body) -> bool:
        """Return whether a body touches the scan."""
        with self.world:
            return int(self.world.collide(body.avatar, body.pose)) != 0


@contextmanager
def play(
    archive: Path, *effects: AnyEffect, limits: SceneLimits | None = None, **options: Any
) -> Iterator[Play]:
    """Open an archive with effects."""
    how = {name: options.pop(name) for name in ("up", "radius_model") if name in options}
    file = SceneFile(
        format=1,
        archives=[ArchiveItem(path=str(archive))],
        effects=list(effects),
        limits=limits or SceneLimits(),
        **how,
    )
    with Scene.open(archive, **options) as scene:
        world = World(scene, file)
        yield Play(scene, world, make_pipeline(file, world))
        scene.residency.check()


def build(folder: Path, points: Points, **options: Any) -> archive_cases.Case:
    """Build an archive of points, with spheres of radius `RADIUS`."""
    return archive_cases.build(
        folder, points, **({"voxel": 2.0, "resolution": 1e-4, "radius": RADIUS} | options)
    )
