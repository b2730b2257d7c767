"""Frames of a single effect: a world of archives, a body, and the effect's report at a pose."""

import os
from copy import copy
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.scene.scene_file import ArchiveItem, SceneFile
from solidcloud.server.archives.rigid_transform import archive_pose, inverse_pose
from solidcloud.server.avatars.avatar_model import AvatarModel
from solidcloud.server.queries.request import EXACT, QueryBudget
from solidcloud.server.scene import Scene
from solidcloud.server.simulation.world.collision_world import World
from solidcloud.server.simulation.world.frame import Body, Frame


class Counting:
    """World that counts its queries by name. reaches: of `distance`."""

    def __init__(self, world: World) -> None:
        self._world = world
        self.asked = {"distance": 0, "contacts": 0}
        self.reaches: list[float] = []

    def __enter__(self) -> Any:
        return self._world.__enter__()

    def __exit__(self, *what: object) -> None:
        self._world.__exit__(*what)

    def generations(self) -> tuple[int, ...]:
        """Return the world's generations."""
        return self._world.generations()

    def count(self, visits: int, missing: int = 0) -> None:
        """Return the world's count."""
        self._world.count(visits, missing)

    def distance(self, avatar: AvatarModel, pose: Any, reach: float, **how: Any) -> Any:
        """Count and delegate to the world."""
        self.asked["distance"] += 1
        self.reaches.append(reach)
        return self._world.distance(avatar, pose, reach, **how)

    def contacts(self, *what: Any, **how: Any) -> Any:
        """Count and delegate to the world."""
        self.asked["contacts"] += 1
        return self._world.contacts(*what, **how)


def world_of(*scenes: Scene, poses: Any = ()) -> Counting:
    """Return the world of opened archives. poses: of each, archive to world; default: the identity."""

    archives = [
        placed(scene, pose) for scene, pose in zip(scenes, poses or [None] * len(scenes), strict=True)
    ]
    file = SceneFile(format=1, archives=[ArchiveItem(path=scene.name) for scene in scenes])
    return Counting(World(SimpleNamespace(archives=archives), file))


def placed(scene: Scene, pose: Any = None) -> Any:
    """Return the first archive of a scene, placed at a pose; None: the identity."""
    archive, pose = scene.archives[0], archive_pose(pose)
    there: Any = copy(archive)
    there.take, there.info, there.pose = archive.take, archive.info, pose
    there.inverse = None if pose is None else inverse_pose(pose)
    return there


def flip_a_byte(archive: Path, voxel: tuple[int, int, int]) -> None:
    """Damage the points of one voxel's record."""
    with Archive(archive) as opened:
        row = int(np.flatnonzero((opened.coordinates == voxel).all(axis=1))[0])
        entry = opened.voxels[row]
        path = opened.shard_path(int(entry["shard"]))
    with open(path, "r+b") as file:
        offset = int(entry["frame_offset"][2]) + int(entry["frame_bytes"][2]) // 2
        byte = os.pread(file.fileno(), 1, offset)[0]
        os.pwrite(file.fileno(), bytes([byte ^ 1]), offset)


def report(
    runner: Any, world: Any, body: Body, pose: NDArray[np.float64], budget: QueryBudget = EXACT
) -> Any:
    """Return an effect's report of a body at a pose, with the world held as the pipeline holds it."""
    frame = Frame(body, pose, 1 / 30, world, budget, pose)
    with world:
        runner.run(frame)
    assert list(frame.reports) == [runner.name]
    assert frame.pose is pose, "it says something, it moves nothing"
    return frame.reports[runner.name]


def body_of(avatar: AvatarModel) -> Body:
    """Return a user without history."""
    return Body("client/body", avatar, np.eye(4))
