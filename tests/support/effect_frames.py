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
from solidcloud.server.queries.query_inputs import EXACT, QueryBudget
from solidcloud.server.scene import Scene
from solidcloud.server.simulation.world.collision_world import World
from solidcloud.server.simulation.world.frame import Body, Frame


def world_of(*scenes: Scene, poses: Any = ()) -> World:
    """Return the world of opened archives. poses: of each, archive to world; default: the identity."""

    archives = [
        placed(scene, pose) for scene, pose in zip(scenes, poses or [None] * len(scenes), strict=True)
    ]
    file = SceneFile(format=1, archives=[ArchiveItem(path=scene.name) for scene in scenes])
    return World(SimpleNamespace(archives=archives), file)


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
        found = runner(frame)
    assert frame.pose is pose, "it says something, it moves nothing"
    return found


def body_of(avatar: AvatarModel) -> Body:
    """Return a user without history."""
    return Body("client/body", avatar, np.eye(4))
