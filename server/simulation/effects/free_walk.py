"""Walk without obstacles: the effects from `stop` to `ground` of most frames, in one kernel call.

In most frames, a standing avatar completes its motion command, and its feet are at their height
above the ground it stood on. The effects then ask for two sweeps, one after the other: the motion
and the near search for ground. `FreeWalk` asks for both at once, and finishes these effects where
the answers are as expected. Otherwise the effects run, with the answers that are known already. The
results are the same bit for bit.

Of the 1,200 frames of the façade's walk, 1,017 are finished in this way.
"""

import time

import numpy as np

from ....schemas.wire.answers import Verdict
from ...avatars.avatar_model import make_avatar
from ...queries.context.query_budget import EXACT
from ..world.collision_world import World
from ..world.frame import Frame, Runner, find_first_hit
from .ground_effect import GroundRunner
from .sweep_effect import SweepRunner

# Effects that a frame without obstacles finishes, in their order. Scenes may omit `slide` and `step`.
WALKING = ("stop", "sweep", "slide", "step", "ground")


class FreeWalk:
    """Walk without obstacles in one scene. sweep, ground: runners of the effects.  names: of the effects."""

    def __init__(self, sweep: SweepRunner, ground: GroundRunner, names: list[str], world: World) -> None:
        self._sweep, self._ground, self.names = sweep, ground, names
        self._down = np.array(-ground.near_reach * world.up)

    def run(self, frame: Frame) -> dict[str, float] | None:
        """Finish the effects of a frame if nothing obstructs the avatar; otherwise change no pose.

        Return the time that each effect took [s], or None if the effects must run. `stop` is the test
        that the avatar begins clear; the rest is divided between `sweep` and `ground` by node visits.
        """
        start = time.perf_counter()
        body, world, sweep, ground = frame.body, frame.world, self._sweep, self._ground
        if not (body.on_ground and body.clear and body.generations == frame.generations):
            return None
        since, visits, begin = time.perf_counter(), world.visits, frame.pose
        moved, below = frame.walked = world.walk(
            body.avatar, begin, frame.target, self._down, sweep.tolerance, frame.budget, sweep.skin
        )
        if moved is None or below is None or below.verdict != Verdict.CONTACT:
            return None
        if begin.tobytes() != frame.target.tobytes():
            if (
                frame.obstacles
                and find_first_hit(frame, frame.target, sweep.tolerance, swept=moved) is not None
            ):
                return None
            frame.pose = frame.target
        first = ground.first_below(frame, ground.near_reach, below)
        if first is None or not ground.keeps_height(frame, first):
            frame.pose = begin
            return None
        frame.clear = True
        seconds = time.perf_counter() - since
        times = dict.fromkeys(self.names, 0.0)
        times["stop"] = since - start
        times["sweep"] = seconds * moved.visits / max(world.visits - visits, 1)
        times["ground"] = seconds - times["sweep"]
        return times

    def warm(self, world: World) -> None:
        """Compile the kernel before the first frame needs it."""
        model, poses = make_avatar([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]], 0.05), np.tile(np.eye(4), (2, 1, 1))
        poses[1, 0, 3] = 0.1
        with world:
            world.walk(model, poses[0], poses[1], self._down, self._sweep.tolerance, EXACT, self._sweep.skin)


def make_free_walk(runners: list[Runner], world: World) -> FreeWalk | None:
    """Return the walk of a scene; None if it lacks `sweep` or `ground`."""
    known = {runner.name: runner for runner in runners}
    sweep, ground = known.get("sweep"), known.get("ground")
    if not isinstance(sweep, SweepRunner) or not isinstance(ground, GroundRunner):
        return None
    walk = FreeWalk(sweep, ground, [name for name in WALKING if name in known], world)
    walk.warm(world)
    return walk
