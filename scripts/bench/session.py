"""Section `session`: `collide` with a memory of the last pose, beside the same call without one, frame by frame."""

from collections.abc import Callable
from functools import partial

import numpy as np
from solidcloud.schemas.answers import CollideAnswers
from solidcloud.server.scene import Scene

from .context import Bench
from .machine import Clock
from .poses import Floats, walk_at
from .results import Part, ratio
from .sides import Contender, time_in_turn, timer

RATES = (30.0, 90.0)
SHARE, STRETCH = 0.3, 2.0
STATELESS, REMEMBERING = "stateless", "with memory"
ONE_CALL, EACH_CALL = "collide, all frames in one call, a frame", "collide, one call a frame"

Ask = Callable[[Floats], CollideAnswers]


def remembering(scene: Scene) -> Callable[[], Ask] | None:
    """What begins a session of the avatar: it answers frames (k, 4, 4) in their order, each with what is remembered.

    None: this engine has no memory yet. Whatever it is called, this is the one place that knows.
    """
    walker = getattr(scene, "walker", None)
    if walker is None:
        return None
    return lambda: walker("avatar").collide


def run(bench: Bench, clock: Clock) -> Part:
    """Time both at each rate, all frames in one call; beside it one call a frame."""
    part = Part("session")
    for name, scene in bench.facade.scenes.items():
        begin = remembering(scene)
        if begin is None:
            part.missing.append(f"{name}: this engine keeps no memory of the last pose yet")
        for rate in RATES:
            _one(bench, clock, part, f"walk at {rate:g} frames/s, {name}", rate, scene, begin)
    return part


def _one(
    bench: Bench,
    clock: Clock,
    part: Part,
    case: str,
    rate: float,
    scene: Scene,
    begin: Callable[[], Ask] | None,
) -> None:
    poses = walk_at(bench.truth, rate)
    # Each repetition begins a session of its own, so that nothing is kept but what the walk itself leaves.
    sides: dict[str, Callable[[], Ask]] = {STATELESS: lambda: partial(scene.collide, "avatar")}
    if begin is not None:
        sides[REMEMBERING] = begin
        differs = np.flatnonzero(begin()(poses).verdict != scene.collide("avatar", poses).verdict)
        if len(differs):
            part.wrong.append(f"{case}: {len(differs)} verdicts differ, the first at frame {differs[0]}")
    whole = [Contender(side, timer(partial(_in_one_call, start))) for side, start in sides.items()]
    for side, spent in time_in_turn(whole, poses, bench.loops, clock, bench.rng, 0.15).items():
        part.add(case, side, ONE_CALL, spent, "µs", len(poses))
    each = [Contender(side, timer(partial(_frame_by_frame, start))) for side, start in sides.items()]
    for side, spent in time_in_turn(each, poses, min(bench.loops, 5), clock, bench.rng, 0.15).items():
        part.add(case, side, EACH_CALL, spent, "µs", len(poses))
    kept = part.value(case, REMEMBERING, ONE_CALL)
    share = ratio(kept, part.value(case, STATELESS, ONE_CALL))
    part.goal("session", f"with memory / stateless, {case}", share, SHARE, "x")
    part.goal("session stretch", f"with memory, {case} (the stretch)", kept, STRETCH, "µs")


def _in_one_call(begin: Callable[[], Ask], poses: Floats) -> None:
    begin()(poses)


def _frame_by_frame(begin: Callable[[], Ask], poses: Floats) -> None:
    ask = begin()
    for i in range(len(poses)):
        ask(poses[i : i + 1])
