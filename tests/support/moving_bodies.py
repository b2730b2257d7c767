"""A scene with a floor and walls, and frames of its users, for tests of `crowd` and `objects`."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import archive_cases
import naive
import numpy as np
from numpy.typing import NDArray
from solidcloud.schemas.scene.effect_table import AnyEffect
from solidcloud.schemas.scene.scene_file import ArchiveItem, AvatarItem, ObjectItem, SceneFile
from solidcloud.schemas.wire.motion_messages import Moved
from solidcloud.server.avatars.avatar_model import AvatarModel, make_avatar
from solidcloud.server.scene import Scene
from solidcloud.server.simulation.simulation import Pipeline, make_pipeline
from solidcloud.server.simulation.world.bodies import Bodies
from solidcloud.server.simulation.world.collision_world import World
from solidcloud.server.simulation.world.frame import Body

INTERPRETED = os.environ.get("NUMBA_DISABLE_JIT") == "1"
FLAT, HIGH = (0.1, 0.1) if not INTERPRETED else (0.2, 0.2)  # spacing of floor and walls [m]


WALL = 0.12 if INTERPRETED else 0.06  # radius of their points: no gaps [m]


def room(side: float = 4.0, height: float = 1.0) -> NDArray[np.float64]:
    """Return points (n, 3) of a floor around the origin, at z = -0.5, and a wall at x = side 2 [m]."""
    across = np.arange(-side / 2, side / 2 + FLAT / 2, FLAT)
    x, y = (axis.ravel() for axis in np.meshgrid(across, across))
    up, along = (axis.ravel() for axis in np.meshgrid(np.arange(0.0, height, HIGH), across))
    floor = np.stack([x, y, np.full_like(x, -0.5)], axis=1)
    wall = np.stack([np.full_like(up, side / 2), along, up], axis=1)
    return np.concatenate([floor, wall])


def ball(radius: float = 0.2, count: int = 60) -> AvatarModel:
    """Return spheres of 4 cm on a sphere with outer radius `radius` [m]."""
    at = np.arange(count) + 0.5
    polar, around = np.arccos(1 - 2 * at / count), np.pi * (1 + 5**0.5) * at
    points = np.stack([np.cos(around) * np.sin(polar), np.sin(around) * np.sin(polar), np.cos(polar)], axis=1)
    return make_avatar(points * (radius - 0.04), 0.04)


def box(x: float, y: float, z: float, spacing: float, radius: float) -> AvatarModel:
    """Return the surface of a box around its origin, with these side lengths including its spheres [m]."""
    sides = [
        np.linspace(-s / 2 + radius, s / 2 - radius, max(1, round((s - 2 * radius) / spacing) + 1))
        for s in (x, y, z)
    ]
    points = np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 3)
    outside = np.zeros(len(points), bool)
    for r, side in enumerate(sides):
        outside |= (points[:, r] == side[0]) | (points[:, r] == side[-1])
    return make_avatar(points[outside], radius)


def at(x: float, y: float = 0.0, z: float = 0.0, heading: float = 0.0) -> NDArray[np.float64]:
    """Return the pose (4, 4) at this position, rotated about z [rad]."""
    c, s = np.cos(heading), np.sin(heading)
    return archive_cases.pose_of(np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]), np.array([x, y, z], float))


class Stage:
    """Users in a scene, one frame at a time, as in a simulation."""

    def __init__(self, pipeline: Pipeline, world: World) -> None:
        self.pipeline, self.world = pipeline, world
        self.users: dict[str, Body] = {}

    @property
    def bodies(self) -> Bodies:
        found = self.pipeline.bodies
        assert isinstance(found, Bodies)
        return found

    def enter(self, name: str, model: AvatarModel, pose: NDArray[np.float64]) -> Body:
        """Add a user."""
        body = self.users[name] = Body(name, model, pose.copy(), time=0.0)
        self.bodies.put_user(body)
        return body

    def go(self, name: str, wish: NDArray[np.float64], seconds: float = 1 / 30) -> Moved:
        """Simulate one frame of one user."""
        body = self.users[name]
        moved = self.pipeline.run(body, wish, seconds)
        self.bodies.put_user(body)
        return moved

    def step(self, name: str, way: Any) -> Moved:
        """Simulate one frame of a user with this translation [m]."""
        wish = self.users[name].pose.copy()
        wish[:3, 3] += way
        return self.go(name, wish)


@contextmanager
def staged(
    folder: Path, effects: list[AnyEffect], points: NDArray[np.float64] | None = None,
    avatars: dict[str, AvatarModel] | None = None, objects: tuple[ObjectItem, ...] = (),
) -> Iterator[Stage]:  # fmt: skip
    """Open a scene with these effects; without points, it is the room."""
    case = archive_cases.build(folder, room() if points is None else points, voxel=1.0, radius=WALL)
    items = [AvatarItem(name=name, file=f"{name}.ply") for name in avatars or {}]
    file = SceneFile(
        format=1, archives=[ArchiveItem(path=str(case.archive))], effects=effects, avatars=items, objects=list(objects)
    )  # fmt: skip
    with Scene.open(case.archive) as scene:
        for name, model in (avatars or {}).items():
            scene.add_avatar(name, model.points, model.radius, client="*")
        world = World(scene, file)
        yield Stage(make_pipeline(file, world), world)


def touch(
    one: AvatarModel, pose: NDArray[np.float64], other: AvatarModel, there: NDArray[np.float64],
    origin: NDArray[np.float64], margin: float = 0.0,
) -> bool:  # fmt: skip
    """Return whether two bodies touch, by definition: every pair of points."""
    reach = sum(int(np.rint(length * naive.UNITS)) for length in (one.radius, other.radius, margin))
    placed = [naive.placed_units(m.points, p, origin) for m, p in ((one, pose), (other, there))]
    return naive.touches(placed[0], placed[1], reach)
