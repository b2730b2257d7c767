"""Effect pipeline: runs one frame through the effects that a scene declares, within its budget.

Effects that the scene does not declare are not imported, called or reported (NUMERICS.md case 31).
The scene file's `limits` set a frame's budget. An effect that may be skipped runs only if the time
spent in the frame so far and the effect's estimated time fit in the budget. Otherwise it is skipped
and listed in the answer. Later effects in ORDER that take less time may still fit. Effects that
prevent contact are never skipped.
"""

import importlib
import time
from collections.abc import Collection
from typing import Any

import numpy as np

from ....schemas.errors import BadRequestError
from ....schemas.scene.effect_table import NEVER_SKIPPED, ORDER, effect_name
from ....schemas.scene.scene_file import SceneFile
from ....schemas.wire.answers import Verdict
from ....schemas.wire.motion_messages import FRAME_SECONDS, Moved, Touched
from ...queries.context.query_budget import EXACT, QueryBudget
from ...runtime.stop_flag import NO_STOP, StoppedError
from ..world.collision_world import World
from ..world.frame import MAX_TOUCHED, Body, Frame, Hit, Pose, Runner, Vec
from ..world.vectors import norm
from .effect_times import EffectTimes

# Weight of the last run in the exponential moving average of an effect's cost.
_SMOOTHING = 0.1
# The estimate of a skipped effect decays by this share a frame, so that the effect is tried again.
# Otherwise it would be skipped forever after one slow run, for example because of compilation or a
# disk. An effect that is always slow runs once in some dozens of frames.
_DECAY = 0.02


class CostEstimate:
    """Estimated cost of an effect: seconds and node visits. The first run compiles and is ignored."""

    __slots__ = ("frames", "seconds", "tried", "visits")

    def __init__(self) -> None:
        self.frames, self.seconds, self.visits = 0, 0.0, 0.0
        self.tried = False  # whether its next run is the first after it was skipped

    def record(self, seconds: float, visits: int) -> None:
        """Record the cost of a run."""
        self.frames += 1
        if self.frames == 1:
            return
        # A decayed estimate is too low, so the cost of a trial replaces it. With an average, the
        # next trial would follow at once.
        share = 1.0 if self.tried else max(_SMOOTHING, 1.0 / (self.frames - 1))
        self.tried = False
        self.seconds += share * (seconds - self.seconds)
        self.visits += share * (visits - self.visits)

    def skipped(self) -> None:
        """Record that the budget had no room for the effect."""
        self.tried = True
        self.seconds *= 1.0 - _DECAY
        self.visits *= 1.0 - _DECAY


class Pipeline:
    """Effects of one scene in their order. Thread-safe, except for two frames of one body.

    runners: the effects.  costs: cost estimate of each, by name, updated only with a budget.
    times: what each effect has cost.
    bodies: `Bodies` that all effects which need them share, and that the simulation updates; None
    if no effect needs them.
    """

    def __init__(self, file: SceneFile, world: World, runners: list[Runner]) -> None:
        """Create a pipeline; callers use `make_pipeline`."""
        self.file, self.world, self._runners = file, world, runners
        self.costs = {runner.name: CostEstimate() for runner in runners}
        self.times = EffectTimes(self.costs)
        self.bodies: Any = None
        for runner in runners:
            if hasattr(runner, "bodies"):
                self.bodies = self.bodies or runner.bodies
                runner.bodies = self.bodies
        self._command_filters: list[Any] = [runner for runner in runners if hasattr(runner, "begin")]
        self._stops = any(runner.name == "stop" for runner in runners)
        limits = file.limits
        self._seconds = None if limits.frame_ms is None else limits.frame_ms / 1e3
        self._visits = limits.frame_visits
        self._free = self._seconds is None and self._visits is None  # no budget, no measurement
        self._groups = _groups_of(runners, together=self._free)

    @property
    def runners(self) -> list[Runner]:
        """Return the effects; set it to replace them."""
        return self._runners

    @runners.setter
    def runners(self, runners: list[Runner]) -> None:
        self._runners, self._groups = runners, _groups_of(runners, together=self._free)

    def run(
        self,
        body: Body,
        target: Pose,
        seconds: float = FRAME_SECONDS,
        budget: QueryBudget = EXACT,
        *,
        skip: Collection[str] | None = None,
    ) -> Moved:
        """Run one frame of a body: move it towards a commanded pose (4, 4), rigid.

        seconds: duration of the frame.  skip: names of the effects to skip, for replays; None:
        those that do not fit the frame's budget.
        Raise BadRequestError for a pose farther than limits.longest_move, the errors of queries, or
        StoppedError. The body is then unchanged.
        """
        begin = time.perf_counter()
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
            self._simulate(frame, begin, skip)
        except StoppedError:
            if pushed is not None:
                self.bodies.restore(pushed)
            raise
        body.pose, body.clear, body.generations = frame.pose, frame.clear, frame.generations
        body.fall_speed, body.on_ground = frame.fall_speed, frame.on_ground
        body.effect_state.update(frame.effect_state)
        return _moved(frame, self.world.unknown)

    def _simulate(self, frame: Frame, begin: float, skip: Collection[str] | None) -> None:
        """Run the effects of a frame that began at the time `begin` [s]. Raise StoppedError."""
        body, budget, world = frame.body, frame.budget, self.world
        with world as seen:
            frame.generations = tuple([each.opened.number for each in seen])
            for runner in self._command_filters:
                runner.begin(frame)
            if not self._stops:
                frame.pose = frame.target
            since = world.visits
            ran: list[tuple[str, float]] = []
            now = time.perf_counter()
            for group in self._groups if not skip else _groups_of(self._runners, together=False):
                if budget.stop:
                    raise StoppedError
                runner = group[0]
                if len(group) > 1:
                    world.walker.run(frame, sum([each.part for each in group]))  # type: ignore[attr-defined]
                    frame.simulated.extend([each.name for each in group])
                elif self._free and not skip:
                    runner.run(frame)
                    frame.simulated.append(runner.name)
                else:
                    self._run_one(runner, frame, begin, since, skip)
                before, now = now, time.perf_counter()
                if len(group) > 1:
                    ran.extend(_shared_time(group, now - before, frame.visits))
                elif frame.simulated and frame.simulated[-1] == runner.name:
                    ran.append((runner.name, now - before))
            self.times.add(ran, frame.skipped)
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

    def _run_one(
        self, runner: Runner, frame: Frame, begin: float, since: int, skip: Collection[str] | None
    ) -> None:
        """Run or skip one effect of a frame."""
        name, cost = runner.name, self.costs[runner.name]
        visits, now = self.world.visits, time.perf_counter()
        if name not in NEVER_SKIPPED:
            skips = self._exceeds_budget(cost, now - begin, visits - since) if skip is None else name in skip
            if skips:
                frame.skipped.append(name)
                cost.skipped()
                return
        runner.run(frame)
        frame.simulated.append(name)
        cost.record(time.perf_counter() - now, self.world.visits - visits)

    def _exceeds_budget(self, cost: CostEstimate, seconds: float, visits: int) -> bool:
        """Return whether an effect's estimated cost exceeds the rest of the frame's budget."""
        if self._seconds is not None and seconds + cost.seconds > self._seconds:
            return True
        return self._visits is not None and visits + cost.visits > self._visits


def _groups_of(runners: list[Runner], *, together: bool) -> list[list[Runner]]:
    """Return the effects in groups that one call runs. together: whether effects may share a call."""
    groups: list[list[Runner]] = []
    for runner in runners:
        if together and hasattr(runner, "part") and groups and hasattr(groups[-1][-1], "part"):
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
        skipped=frame.skipped,
        **frame.reports,
        unknown=unknown,
        unloaded=min(left, max(hit.rest for hit in frame.hits)) if frame.hits else 0.0,
    )


def make_pipeline(file: SceneFile, world: World) -> Pipeline:
    """Create the pipeline of a scene: import each declared effect and create its runner."""
    declared = {effect_name(effect): effect for effect in file.effects}
    runners: list[Runner] = [
        importlib.import_module(f".{name}_effect", __package__).make(declared[name], world)
        for name in ORDER
        if name in declared
    ]
    return Pipeline(file, world, runners)
