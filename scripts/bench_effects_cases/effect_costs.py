"""Cost of effects: the 40-second walk, frame by frame in this process, under every set of effects."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from solidcloud.schemas.scene.effect_table import (
    AnyEffect,
    Contacts,
    Crowd,
    Ground,
    Objects,
    Proximity,
    Slide,
    Step,
    Stop,
    Sweep,
    Through,
    ThroughBox,
    Uncertainty,
    effect_name,
)
from solidcloud.schemas.scene.scene_file import ArchiveItem, SceneFile
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.avatars.avatar_model import AvatarModel
from solidcloud.server.scene import Scene
from solidcloud.server.simulation.simulation import Pipeline, make_pipeline
from solidcloud.server.simulation.world.collision_world import World
from solidcloud.server.simulation.world.frame import Body

Floats = NDArray[np.float64]

STOP, SWEEP, SLIDE, STEP, GROUND = Stop(), Sweep(), Slide(), Step(), Ground()
WALKING: tuple[AnyEffect, ...] = (STOP, SWEEP, SLIDE, STEP, GROUND)
EVERYTHING: tuple[AnyEffect, ...] = (*WALKING, Crowd(), Proximity(), Contacts(), Uncertainty())
# The smallest scene in which each effect is active.
ALONE: dict[str, tuple[AnyEffect, ...]] = {
    "stop": (STOP,),
    "sweep": (STOP, SWEEP),
    "slide": (STOP, SWEEP, SLIDE),
    "ground": (STOP, SWEEP, SLIDE, GROUND),
    "step": WALKING,
    "objects": (STOP, SWEEP, Objects()),
    "crowd": (STOP, SWEEP, Crowd()),
    "proximity": (Proximity(),),
    "contacts": (Contacts(),),
    "uncertainty": (Uncertainty(),),
}
# For `through`, whose cost arises when a scene is opened: a box in the main door's arch that holds
# some points.
ARCH = Through(boxes=[ThroughBox(name="arch", low=(-1.0, -0.2, 3.0), high=(1.0, 1.4, 4.5))])
FRAME = 1 / 30
# Maximum distance of a motion command's target from the body [m]. Without it, a viewer that waits
# before a stair without `step` would have ever longer motions swept.
AHEAD = 0.25


def file_of(effects: Sequence[AnyEffect]) -> SceneFile:
    """Return a scene file that declares these effects."""
    return SceneFile(format=1, archives=[ArchiveItem(path=".")], effects=list(effects))


def towards(pose: Floats, wish: Floats) -> Floats:
    """Return the target pose (4, 4) of a motion command, no farther than AHEAD from a pose (4, 4)."""
    way = wish[:3, 3] - pose[:3, 3]
    far = float(np.linalg.norm(way))
    if far <= AHEAD:
        return wish
    nearer = wish.copy()
    nearer[:3, 3] = pose[:3, 3] + way * (AHEAD / far)
    return nearer


@dataclass
class Walk:
    """Results of one walk.

    frames: (k,) duration of each frame [s].
    effects: name -> (k,) duration of each frame in the effect [s], as the pipeline divides it.
    places: (k, 3) positions of the body.
    visits: node visits of all frames.
    """

    frames: Floats
    effects: dict[str, Floats] = field(default_factory=dict)
    places: Floats = field(default_factory=lambda: np.empty((0, 3)))
    visits: int = 0


class Stage:
    """One resident archive, and pipelines of effects over it, each created once. A context manager."""

    def __init__(self, archive: Path, avatar: AvatarModel, poses: Floats) -> None:
        """Open the archive. poses: (k, 4, 4), the target of each frame's motion command."""
        self.scene = Scene.open(archive, budget_bytes=1 << 30)
        self.avatar, self.poses = avatar, poses
        self._made: dict[str, tuple[World, Pipeline]] = {}
        self.scene.add_avatar("all", avatar.points, avatar.radius)
        self.scene.collide("all", poses)  # makes everything resident

    def __enter__(self) -> "Stage":
        """Return the stage."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the archive."""
        self.scene.close()

    def pipeline(self, effects: Sequence[AnyEffect]) -> tuple[World, Pipeline]:
        """Return the effects' pipeline over the archive."""
        key = " ".join(effect_name(effect) for effect in effects)
        if key not in self._made:
            file = file_of(effects)
            world = World(self.scene, file)
            self._made[key] = world, make_pipeline(file, world)
        return self._made[key]

    def walk(self, effects: Sequence[AnyEffect]) -> Walk:
        """Run the whole walk of one user."""
        world, pipeline = self.pipeline(effects)
        body = Body("bench/one", self.avatar, self.poses[0].copy())
        took = np.empty(len(self.poses))
        places = np.empty((len(self.poses), 3))
        spent = np.empty((len(self.poses) + 1, len(pipeline.stats())))
        spent[0] = [each.seconds for each in pipeline.stats()]
        before = world.visits
        for number, pose in enumerate(self.poses):
            wish = towards(body.pose, pose)
            begin = time.perf_counter()
            moved = pipeline.run(body, wish, FRAME)
            took[number] = time.perf_counter() - begin
            places[number] = moved.pose[0, :3, 3]
            spent[number + 1] = [each.seconds for each in pipeline.stats()]
        names = [each.effect for each in pipeline.stats()]
        each_frame = dict(zip(names, np.diff(spent, axis=0).T, strict=True))
        return Walk(took, each_frame, places, world.visits - before)

    def crowd(self, effects: Sequence[AnyEffect], users: int) -> Floats:
        """Run the walk of several users, each some way behind the previous one.

        Each begins at the next clear pose: the walk touches walls on purpose. Returns the duration
        of each frame of all users (k,) [s].
        """
        pipeline = self.pipeline(effects)[1]
        apart = len(self.poses) // users
        clear = np.flatnonzero(self.scene.collide("all", self.poses).verdict == Verdict.CLEAR)
        starts = clear[np.searchsorted(clear, np.arange(users) * apart)].tolist()
        bodies = [
            Body(f"bench/{user}", self.avatar, self.poses[start].copy()) for user, start in enumerate(starts)
        ]
        if pipeline.bodies is not None:
            for body in bodies:
                pipeline.bodies.put_user(body)
        took = np.empty(apart)
        for number in range(apart):
            wishes = [
                towards(body.pose, self.poses[min(start + number, len(self.poses) - 1)])
                for start, body in zip(starts, bodies, strict=True)
            ]
            begin = time.perf_counter()
            for body, wish in zip(bodies, wishes, strict=True):
                pipeline.run(body, wish, FRAME)
            took[number] = time.perf_counter() - begin
        return took
