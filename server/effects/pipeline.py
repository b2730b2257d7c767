"""The effects that a scene declares, composed: nothing else is imported, called or answered (NUMERICS.md case 31).

A frame's budget is of `limits` in the scene file. Before each effect that may be skipped, what was spent of the frame
and what the effect usually takes are added up; where that is too much the effect is skipped, and the answer says so.
Those that come later in ORDER, and take less, may still find room. Effects that keep from contact are never skipped.
"""

import importlib
import time
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from ...schemas.answers import Verdict
from ...schemas.effect_order import NEVER_SKIPPED, ORDER
from ...schemas.errors import BadRequestError
from ...schemas.moves import FRAME_SECONDS, Moved, Touched
from ...schemas.scene import SceneFile, effect_name
from ..effort import EXACT, Effort
from ..stop import NEVER, StoppedError
from ..vectors import size
from ..world import World
from .frame import Body, Frame, Hit, Pose, Runner, Vec

# What an effect usually takes follows what it took by this share.
_FOLLOWS = 0.1
# What a skipped effect is taken to need fades by this share a frame, so that it is tried again. What once took long, a
# compiler's time or a disk's in it, would else be skipped for ever; what always does gets one frame in some dozens.
_FADES = 0.02
# Things touched that an answer names at most.
_MOST_TOUCHED = 16


class Usual:
    """What an effect usually takes: seconds and node visits. The first frame says nothing: it compiles."""

    __slots__ = ("frames", "seconds", "tried", "visits")

    def __init__(self) -> None:
        self.frames, self.seconds, self.visits = 0, 0.0, 0.0
        self.tried = False  # whether the next time it runs is the first after it was skipped

    def took(self, seconds: float, visits: int) -> None:
        """It took so much now."""
        self.frames += 1
        if self.frames == 1:
            return
        # What faded says nothing any more: a trial counts whole, or the next would follow at once.
        share = 1.0 if self.tried else max(_FOLLOWS, 1.0 / (self.frames - 1))
        self.tried = False
        self.seconds += share * (seconds - self.seconds)
        self.visits += share * (visits - self.visits)

    def skipped(self) -> None:
        """There was no room for it."""
        self.tried = True
        self.seconds *= 1.0 - _FADES
        self.visits *= 1.0 - _FADES


class Pipeline:
    """The effects of one scene in their order. Thread-safe, but for one body at a time.

    runners: the effects.  usual: what each takes, by name, where there is a budget.  bodies: see bodies.py; None
    where no effect asks for it.
    """

    def __init__(self, file: SceneFile, world: World, runners: list[Runner]) -> None:
        """Use `make_pipeline`."""
        self.file, self.world, self.runners = file, world, runners
        self.usual = {runner.name: Usual() for runner in runners}
        # Where users and objects are: one for all effects that ask, kept up to date by the simulation. None: none asks.
        self.bodies: Any = None
        for runner in runners:
            if hasattr(runner, "bodies"):
                self.bodies = self.bodies or runner.bodies
                runner.bodies = self.bodies
        self._beginners: list[Any] = [runner for runner in runners if hasattr(runner, "begin")]
        self._stops = any(runner.name == "stop" for runner in runners)
        limits = file.limits
        self._seconds = None if limits.frame_ms is None else limits.frame_ms / 1e3
        self._visits = limits.frame_visits
        self._free = self._seconds is None and self._visits is None  # nothing to be measured for

    def run(
        self,
        body: Body,
        wish: Pose,
        seconds: float = FRAME_SECONDS,
        effort: Effort = EXACT,
        *,
        skip: Collection[str] | None = None,
    ) -> Moved:
        """One frame of a body: where it gets to that wishes to be at a pose (4, 4), rigid.

        seconds: that the frame lasts.  skip: the effects to leave out, as a frame before had to; None: those that the
        frame's budget has no room for. The body is as it was where this raises: BadRequestError for a wish that is
        farther than limits.longest_move, what questions about its poses raise, and StoppedError.
        """
        begin = time.perf_counter()
        body.pose = np.ascontiguousarray(body.pose, np.float64)
        wish = np.array(wish, np.float64)
        far = size(wish[:3, 3] - body.pose[:3, 3])
        if not far <= self.file.limits.longest_move:
            raise BadRequestError(
                f"the wish is {far:g} m away: expected within {self.file.limits.longest_move:g} m, the scene's longest "
                "move: wish for something nearer, or begin there"
            )
        frame = Frame(body, wish, seconds, self.world, effort, body.pose)
        frame.fall_speed, frame.on_ground = body.fall_speed, body.on_ground
        self.world.begin(effort.stop)
        with self._undone_if_stopped(body, effort), self.world as seen:
            frame.generations = tuple([each.opened.number for each in seen])
            for runner in self._beginners:
                runner.begin(frame)
            if not self._stops:
                frame.pose = frame.wish
            since = self.world.visits
            for runner in self.runners:
                if effort.stop:
                    raise StoppedError
                if self._free and not skip:
                    runner.run(frame)
                    frame.simulated.append(runner.name)
                else:
                    self._run_one(runner, frame, begin, since, skip)
            if not self._stops:
                frame.verdict = self.world.collide(body.avatar, frame.pose, effort)
            # What came into it, an object say, blocks nobody: then the verdict alone says so.
            if any(each.overlaps(body.avatar, frame.pose) for each in frame.obstacles):
                frame.verdict = Verdict.CONTACT
            if effort.stop:  # what the effects made of unfinished answers counts for nothing
                raise StoppedError
            self.world.saw(body.user, body.avatar, frame.pose)
        body.pose, body.clear, body.generations = frame.pose, frame.clear, frame.generations
        body.fall_speed, body.on_ground = frame.fall_speed, frame.on_ground
        body.kept.update(frame.kept)
        return _moved(frame, self.world.unknown)

    @contextmanager
    def _undone_if_stopped(self, body: Body, effort: Effort) -> Iterator[None]:
        """Have objects that a frame pushed stand where they stood before, where it is stopped: a clock decides when it
        is, and no pose is to depend on one."""
        if effort.stop is NEVER or self.bodies is None or not self.bodies.remembers(body):
            yield
            return
        standing = self.bodies.standing()
        try:
            yield
        except StoppedError:
            self.bodies.put_back(standing)
            raise

    def _run_one(
        self, runner: Runner, frame: Frame, begin: float, since: int, skip: Collection[str] | None
    ) -> None:
        """One effect of a frame, or none of it."""
        name, usual = runner.name, self.usual[runner.name]
        visits, now = self.world.visits, time.perf_counter()
        if name not in NEVER_SKIPPED:
            skips = self._no_room(usual, now - begin, visits - since) if skip is None else name in skip
            if skips:
                frame.skipped.append(name)
                usual.skipped()
                return
        runner.run(frame)
        frame.simulated.append(name)
        usual.took(time.perf_counter() - now, self.world.visits - visits)

    def _no_room(self, usual: Usual, seconds: float, visits: int) -> bool:
        """Whether a frame that has spent so much has no room for what usually takes so much more."""
        if self._seconds is not None and seconds + usual.seconds > self._seconds:
            return True
        return self._visits is not None and visits + usual.visits > self._visits


def _vector(place: Vec) -> tuple[float, float, float]:
    x, y, z = place.tolist()
    return x, y, z


def _touched(hits: list[Hit], there: Vec) -> list[Touched]:
    """What stopped a frame's motions, each place once. there: for what has no place of its own."""
    found: dict[Any, Touched] = {}
    for hit in hits:
        place = _vector(there if hit.cloud is None else hit.cloud)
        normal = None if hit.normal is None else _vector(hit.normal)
        found[hit.what, place] = Touched(place, normal, hit.what, hit.verdict == Verdict.UNKNOWN)
    return list(found.values())[:_MOST_TOUCHED]


def _moved(frame: Frame, unknown: bool) -> Moved:
    """Return what came of a frame. unknown: as `Moved` has it."""
    x, y, z = frame.left.tolist()
    return Moved(
        pose=frame.pose[None].copy(),
        verdict=int(frame.verdict),
        left=(x * x + y * y + z * z) ** 0.5,
        touched=_touched(frame.hits, frame.pose[:3, 3]) if frame.hits else [],
        simulated=frame.simulated,
        skipped=frame.skipped,
        **frame.reports,
        unknown=unknown,
    )


def make_pipeline(file: SceneFile, world: World) -> Pipeline:
    """The pipeline of a scene: each effect it declares is imported, and made of what the file says of it."""
    declared = {effect_name(effect): effect for effect in file.effects}
    runners: list[Runner] = [
        importlib.import_module(f".{name}", __package__).make(declared[name], world)
        for name in ORDER
        if name in declared
    ]
    return Pipeline(file, world, runners)
