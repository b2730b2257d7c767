"""Section `session`: `collide` with a memory of the last pose, beside the same call without one, frame by frame."""

from collections.abc import Callable

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


def remembering(scene: Scene) -> Callable[[Floats], CollideAnswers] | None:
    """What answers the frames (k, 4, 4) of a walk in their order, each with a memory of the one before.

    Each call begins a new session, so that nothing is kept between repetitions. None: this engine has no memory yet.
    """
    return None


def run(bench: Bench, clock: Clock) -> Part:
    """Time both at each rate."""
    part = Part("session")
    for name, scene in bench.facade.scenes.items():
        ask = remembering(scene)
        if ask is None:
            part.missing.append(f"{name}: this engine keeps no memory of the last pose yet")
        for rate in RATES:
            case = f"walk at {rate:g} frames/s, {name}"
            poses = walk_at(bench.truth, rate)
            contenders = [Contender(STATELESS, timer(lambda p, scene=scene: scene.collide("avatar", p)))]
            if ask is not None:
                contenders.append(Contender(REMEMBERING, timer(ask)))
                differs = np.flatnonzero(ask(poses).verdict != scene.collide("avatar", poses).verdict)
                if len(differs):
                    part.wrong.append(
                        f"{case}: {len(differs)} verdicts differ, the first at frame {differs[0]}"
                    )
            times = time_in_turn(contenders, poses, bench.loops, clock, bench.rng, 0.4)
            for side, spent in times.items():
                part.add(case, side, "collide, a frame", spent, "µs", len(poses))
            kept = part.value(case, REMEMBERING, "collide, a frame")
            share = ratio(kept, part.value(case, STATELESS, "collide, a frame"))
            part.goal("session", f"with memory / stateless, {case}", share, SHARE, "x")
            part.goal("session stretch", f"with memory, {case} (the stretch)", kept, STRETCH, "µs")
    return part
