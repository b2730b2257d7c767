"""Effect pipeline: runs one frame through the effects that a scene declares, in their order.

Files of effects that the scene does not declare are not imported (NUMERICS.md case 31).
"""

import importlib
import threading
import time
from collections.abc import Iterable
from typing import Any

import numpy as np

from ....schemas.errors import BadRequestError
from ....schemas.scene.effect_table import ORDER, effect_name
from ....schemas.scene.scene_file import SceneFile
from ....schemas.wire.answers import Verdict
from ....schemas.wire.motion_messages import FRAME_SECONDS, Moved, Touched
from ....schemas.wire.stats import EffectStats
from ...queries.request import EXACT, QueryBudget
from ...runtime.stop_flag import NO_STOP, StoppedError
from ..world.collision_world import World
from ..world.frame import MAX_TOUCHED, Body, Frame, Hit, Pose, Runner, Vec
from ..world.vectors import norm

# The file of each effect.
_FILES = {
    "objects": "body_effects", "crowd": "body_effects", "stop": "stop_effect", "sweep": "motion_effects",
    "slide": "motion_effects", "step": "motion_effects", "ground": "motion_effects",
    "proximity": "report_effects", "contacts": "report_effects", "uncertainty": "uncertainty_effect",
}  # fmt: skip


class EffectTimes:
    """Frames and seconds by effect. Thread-safe."""

    def __init__(self, names: Iterable[str]) -> None:
        """Begin at 0. names: of the effects, in the order in which they run."""
        self._counts = {name: [0, 0.0] for name in names}
        self._lock = threading.Lock()

    def add(self, ran: list[tuple[str, float]]) -> None:
        """Count a frame. ran: its effects with their times [s]."""
        with self._lock:
            for name, seconds in ran:
                count = self._counts[name]
                count[0] += 1
                count[1] += seconds

    def stats(self) -> list[EffectStats]:
        """Return the counts of each effect, in the order in which they run."""
        with self._lock:
            return [EffectStats(name, *count) for name, count in self._counts.items()]  # type: ignore[arg-type]


class Pipeline:
    """Effects of one scene in their order. Thread-safe, except for two frames of one body.

    groups: the effects in order, in groups that one call runs.  times: what each effect has cost.
    bodies: `Bodies` that all effects which need them share, and that the simulation updates; None
    if no effect needs them.
    """

    def __init__(self, file: SceneFile, world: World, runners: list[Runner]) -> None:
        """Create a pipeline; callers use `make_pipeline`."""
        self.file, self.world, self.groups = file, world, _groups_of(runners)
        self.times = EffectTimes(runner.name for runner in runners)
        self.bodies: Any = None
        for runner in runners:
            if hasattr(runner, "bodies"):
                self.bodies = self.bodies or runner.bodies
                runner.bodies = self.bodies
        self._command_filters: list[Any] = [runner for runner in runners if hasattr(runner, "begin")]
        self._stops = any(runner.name == "stop" for runner in runners)

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
        StoppedError. The body is then unchanged.
        """
        body.pose = np.ascontiguousarray(body.pose, np.float64)
        target = np.array(target, np.float64, order="C")
        far = norm(target[:3, 3] - body.pose[:3, 3])
        if not far <= self.file.limits.longest_move:
            raise BadRequestError(
                f"the commanded pose is {far:g} m away: expected within {self.file.limits.longest_move:g} m, the "
                "scene's longest_move: send a nearer pose, or enter the scene there"
            )
        frame = Frame(body, target, seconds, self.world, budget, body.pose)
        frame.fall_speed, frame.on_ground = body.fall_speed, body.on_ground
        self.world.begin(budget.stop)
        pushed = self._poses_to_restore(body, budget)
        try:
            self._simulate(frame)
        except StoppedError:
            if pushed is not None:
                self.bodies.restore(pushed)
            raise
        body.pose, body.clear, body.generations = frame.pose, frame.clear, frame.generations
        body.fall_speed, body.on_ground = frame.fall_speed, frame.on_ground
        body.effect_state.update(frame.effect_state)
        return _moved(frame, self.world.unknown)

    def _simulate(self, frame: Frame) -> None:
        """Run the effects of a frame. Raise StoppedError."""
        body, budget, world = frame.body, frame.budget, self.world
        with world as seen:
            frame.generations = tuple([each.opened.number for each in seen])
            for runner in self._command_filters:
                runner.begin(frame)
            if not self._stops:
                frame.pose = frame.target
            ran: list[tuple[str, float]] = []
            now = time.perf_counter()
            for group in self.groups:
                if budget.stop:
                    raise StoppedError
                if len(group) > 1:
                    world.walker.run(frame, sum([each.part for each in group]))  # type: ignore[attr-defined]
                else:
                    group[0].run(frame)
                frame.simulated.extend([each.name for each in group])
                before, now = now, time.perf_counter()
                if len(group) > 1:
                    ran.extend(_shared_time(group, now - before, frame.visits))
                else:
                    ran.append((group[0].name, now - before))
            self.times.add(ran)
            if not self._stops:
                frame.verdict = world.collide(body.avatar, frame.pose, budget)
            # Bodies that overlap the avatar since the frame's start, such as a placed object, do
            # not block it, but the verdict reports them.
            if not frame.apart and any([each.overlaps(body.avatar, frame.pose) for each in frame.obstacles]):
                frame.verdict = Verdict.CONTACT
            if budget.stop:  # results of effects from incomplete answers are discarded
                raise StoppedError
            world.saw(body.user, body.avatar, frame.pose)

    def _poses_to_restore(self, body: Body, budget: QueryBudget) -> Any:
        """Return the poses of pushed objects that a stopped frame must restore; None if there are none.

        When a frame is stopped depends on a clock, and no pose may depend on a clock.
        """
        if budget.stop is NO_STOP or self.bodies is None or not self.bodies.is_present(body):
            return None
        return self.bodies.snapshot()


def _groups_of(runners: list[Runner]) -> list[list[Runner]]:
    """Return the effects in groups that one call runs."""
    groups: list[list[Runner]] = []
    for runner in runners:
        if hasattr(runner, "part") and groups and hasattr(groups[-1][-1], "part"):
            groups[-1].append(runner)
        else:
            groups.append([runner])
    return groups


def _shared_time(group: list[Runner], seconds: float, visits: list[int]) -> list[tuple[str, float]]:
    """Return the time of each effect of a call [s], divided by node visits. visits: of each part."""
    counts = [visits[runner.part.bit_length() - 1] for runner in group]  # type: ignore[attr-defined]
    total = sum(counts)
    if not total:
        return [(runner.name, seconds / len(group)) for runner in group]
    return [(runner.name, seconds * count / total) for runner, count in zip(group, counts, strict=True)]


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
    """Create the pipeline of a scene: import each declared effect and create its runner."""
    declared = {effect_name(effect): effect for effect in file.effects}
    runners: list[Runner] = [
        importlib.import_module(f".{_FILES[name]}", __package__).make(declared[name], world)
        for name in ORDER
        if name in declared
    ]
    return Pipeline(file, world, runners)
