"""Effect pipeline: runs one frame through the effects that a scene declares, in their order.

Files of effects that the scene does not declare are not imported (NUMERICS.md case 31).
"""

import importlib
import threading
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from ....schemas.errors import BadRequestError
from ....schemas.scene.effect_table import ORDER, effect_name
from ....schemas.scene.scene_file import SceneFile
from ....schemas.wire.answers import Verdict
from ....schemas.wire.motion_messages import FRAME_SECONDS, Moved, Touched
from ....schemas.wire.stats import EffectStats
from ...queries.query_inputs import EXACT, QueryBudget
from ...runtime.stop_flag import StoppedError
from ..world.collision_world import World
from ..world.frame import MAX_TOUCHED, Body, Frame, Hit, Pose, Run, Vec
from ..world.vectors import norm

# The file of each effect.
_FILES = {
    "objects": "body_effects", "crowd": "body_effects", "stop": "stop_effect", "sweep": "motion_effects",
    "slide": "motion_effects", "step": "motion_effects", "ground": "motion_effects",
    "proximity": "report_effects", "contacts": "report_effects", "uncertainty": "uncertainty_effect",
}  # fmt: skip
# Effects that one call runs, in the order of `Frame.visits`.
_WALKING = ("sweep", "slide", "step", "ground")


class Pipeline:
    """Effects of one scene in their order. Thread-safe, except for two frames of one body.

    world: of the scene.  runs: the effects in order, the names of those that one call runs and the call.
    """

    def __init__(self, world: World, runs: Sequence[tuple[Sequence[str], Run]]) -> None:
        """Create a pipeline; callers use `make_pipeline`."""
        self.world, self.runs = world, runs
        self._counts = {name: [0, 0.0] for names, _ in runs for name in names}
        self._counting = threading.Lock()
        self._stops = "stop" in self._counts

    @property
    def bodies(self) -> Any:
        """Return the `Bodies` of the scene, which the simulation updates; None if no effect needs them."""
        return self.world.bodies

    def stats(self) -> list[EffectStats]:
        """Return the frames and seconds of each effect so far, in the order in which they run."""
        with self._counting:
            return [EffectStats(name, *count) for name, count in self._counts.items()]  # type: ignore[arg-type]

    def run(
        self,
        body: Body,
        target: Pose,
        seconds: float = FRAME_SECONDS,
        budget: QueryBudget = EXACT,
    ) -> Moved:
        """Run one frame of a body: move it towards a commanded pose (4, 4), rigid.

        seconds: duration of the frame.
        Raise BadRequestError for a pose farther than limits.longest_move, the errors of queries, or
        StoppedError. The body is then unchanged; objects that it pushed are not.
        """
        body.pose = np.ascontiguousarray(body.pose, np.float64)
        target = np.array(target, np.float64, order="C")
        far, longest = norm(target[:3, 3] - body.pose[:3, 3]), self.world.file.limits.longest_move
        if not far <= longest:
            raise BadRequestError(
                f"the commanded pose is {far:g} m away: expected within {longest:g} m, the scene's longest_move: "
                "send a nearer pose, or enter the scene there"
            )
        frame = Frame(body, target, seconds, self.world, budget, body.pose)
        frame.fall_speed, frame.on_ground = body.fall_speed, body.on_ground
        self.world.begin(budget.stop)
        self._simulate(frame)
        body.pose, body.clear, body.generations = frame.pose, frame.clear, frame.generations
        body.fall_speed, body.on_ground = frame.fall_speed, frame.on_ground
        body.effect_state.update(frame.effect_state)
        return _moved(frame, self.world.unknown)

    def _simulate(self, frame: Frame) -> None:
        """Run the effects of a frame. Raise StoppedError."""
        body, budget, world = frame.body, frame.budget, self.world
        with world as seen:
            frame.generations = tuple([each.opened.number for each in seen])
            if not self._stops:
                frame.pose = frame.target
            took: list[tuple[str, float]] = []
            now = time.perf_counter()
            for names, run in self.runs:
                if budget.stop:
                    raise StoppedError
                report = run(frame)
                if report is not None:
                    frame.reports[names[0]] = report
                frame.simulated += names
                before, now = now, time.perf_counter()
                took += _shared_time(names, now - before, frame.visits)
            with self._counting:
                for name, seconds in took:
                    count = self._counts[name]
                    count[0] += 1
                    count[1] += seconds
            if not self._stops:
                frame.verdict = world.collide(body.avatar, frame.pose, budget)
            # Bodies that overlap the avatar since the frame's start, such as a placed object, do
            # not block it, but the verdict reports them.
            if not frame.apart and any([each.overlaps(body.avatar, frame.pose) for each in frame.obstacles]):
                frame.verdict = Verdict.CONTACT
            if budget.stop:  # results of effects from incomplete answers are discarded
                raise StoppedError
            world.saw(body.user, body.avatar, frame.pose)


def _shared_time(names: Sequence[str], seconds: float, visits: Sequence[int]) -> list[tuple[str, float]]:
    """Return the time of each effect of a call [s], divided by node visits. visits: by _WALKING."""
    if len(names) == 1:
        return [(names[0], seconds)]
    counts = [visits[_WALKING.index(name)] for name in names]
    total = sum(counts)
    shares = [count / total for count in counts] if total else [1.0 / len(names)] * len(names)
    return [(name, seconds * share) for name, share in zip(names, shares, strict=True)]


def _vector(place: Vec) -> tuple[float, float, float]:
    x, y, z = place.tolist()
    return x, y, z


def _touched(hits: list[Hit], there: Vec) -> list[Touched]:
    """Return the obstacles that stopped a frame's motions, each position once.

    there: (3,), position of hits without one, world [m].
    """
    found: dict[Any, Touched] = {}
    for hit in hits:
        place = _vector(there if hit.cloud is None else hit.cloud)
        normal = None if hit.normal is None else _vector(hit.normal)
        unknown = hit.verdict == Verdict.UNKNOWN
        found[hit.what, place] = Touched(place, normal, hit.what, unknown, hit.unloaded)
    return list(found.values())[:MAX_TOUCHED]


def _moved(frame: Frame, unknown: bool) -> Moved:
    """Return the answer for a frame. unknown: as in `Moved`."""
    x, y, z = frame.remaining.tolist()
    left = (x * x + y * y + z * z) ** 0.5
    return Moved(
        pose=frame.pose[None].copy(),
        verdict=int(frame.verdict),
        left=left,
        touched=_touched(frame.hits, frame.pose[:3, 3]) if frame.hits else [],
        simulated=frame.simulated,
        **frame.reports,
        unknown=unknown,
        unloaded=min(left, max(hit.rest for hit in frame.hits)) if frame.hits else 0.0,
    )


def make_pipeline(file: SceneFile, world: World) -> Pipeline:
    """Create the pipeline of a scene: import the file of each declared effect and create the effect."""
    declared = {effect_name(effect): effect for effect in file.effects}
    walking = [name for name in _WALKING if name in declared]
    runs: list[tuple[Sequence[str], Run]] = []
    for name in ORDER:
        if name in declared and name not in walking[1:]:
            make = importlib.import_module(f".{_FILES[name]}", __package__).make
            runs.append((walking if name in walking else [name], make(declared[name], world)))
    return Pipeline(world, runs)
