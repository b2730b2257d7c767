"""Time of the frames of a walk: the recorded commands once more, with everything in memory."""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from solidcloud.schemas.wire.motion_messages import Wish
from solidcloud.server.scene import Scene
from solidcloud.server.simulation.simulation import Pipeline, make_pipeline, target_pose
from solidcloud.server.simulation.world.collision_world import World
from solidcloud.server.simulation.world.frame import Body

from .persons import Person
from .route_walk import AVATAR, FRAME, Walked

Floats = NDArray[np.float64]


class WalkCost(NamedTuple):
    """Cost of the k frames of a walk.

    seconds: (turns, k), durations [s].  visits: (k,) node visits.  touching: (k,), frames along
    walls.
    """

    seconds: Floats
    visits: Floats
    touching: NDArray[np.bool_]


class FrameTimes:
    """A scene whose voxels are in memory, with a pipeline of its effects. A context manager."""

    def __init__(self, file: Path, person: Person) -> None:
        """Open a scene file."""
        self.scene = Scene.open(file, budget_bytes=1 << 30)
        self.scene.add_avatar(AVATAR, person.points, person.radius)
        world = World(self.scene, self.scene.simulation.file)
        self._world, self._up = world, world.up
        self._pipeline: Pipeline = make_pipeline(self.scene.simulation.file, world)

    def __enter__(self) -> "FrameTimes":
        """Return the object itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the scene."""
        self.scene.close()

    def measure(self, walked: Walked, begin: Floats, turns: int) -> tuple[WalkCost, bool]:
        """Walk once without measurement and then `turns` times.

        begin: (4, 4), the pose of the first command.
        Return the durations and node visits of the frames, and whether all poses of all turns are
        those of the recorded walk, bit for bit.
        """
        self.scene.collide(AVATAR, walked.poses)  # makes everything resident
        took = np.empty((turns + 1, len(walked.poses)))
        visits = np.empty(len(walked.poses))
        same = True
        for durations in took:
            body = Body("walk/person", self.scene.avatar(AVATAR, ""), begin.copy())
            for frame, command in enumerate(walked.commands):
                wish = Wish(
                    seq=frame + 1,
                    time=frame * FRAME,
                    velocity=tuple(command.velocity.tolist()),
                    turn=command.turn,
                )
                # As in the recorded walk: differences of float64 times, which differ in the last digits.
                seconds = FRAME if frame == 0 else frame * FRAME - (frame - 1) * FRAME
                target = target_pose(wish, body.pose, seconds, self._up)
                before = self._world.visits
                since = time.perf_counter()
                self._pipeline.run(body, target, seconds)
                durations[frame] = time.perf_counter() - since
                visits[frame] = self._world.visits - before
                same = same and body.pose.tobytes() == walked.poses[frame].tobytes()
        return WalkCost(took[1:], visits, walked.touching()), same


def times_summary(costs: Sequence[WalkCost]) -> dict[str, object]:
    """Return the figures of the frames of walks with equally many turns [us].

    Of each frame, the median of the turns counts; for `mean_of_least_us` the least, to which other
    work on the machine adds least.
    """
    took = 1e6 * np.concatenate([cost.seconds for cost in costs], axis=1)
    visits = np.concatenate([cost.visits for cost in costs])
    touching = np.concatenate([cost.touching for cost in costs])
    each, least = np.median(took, axis=0), took.min(axis=0)
    parts = {"all": np.ones_like(touching), "free": ~touching, "along walls": touching}
    return {
        name: {
            "frames": int(part.sum()),
            "mean_us": round(float(each[part].mean()), 1),
            "median_us": round(float(np.median(each[part])), 1),
            "p99_us": round(float(np.percentile(each[part], 99)), 1),
            "longest_us": round(float(each[part].max()), 1),
            "mean_of_least_us": round(float(least[part].mean()), 1),
            "p99_of_least_us": round(float(np.percentile(least[part], 99)), 1),
            "mean_visits": round(float(visits[part].mean())),
        }
        for name, part in parts.items()
        if part.any()
    }
