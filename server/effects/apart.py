"""How far an avatar is from the scene: asked once a frame for all effects that say something, and remembered.

What is known at one pose bounds the next: spheres that were a distance apart and went so far are at least the
difference apart. Where that is beyond what an effect asks for, nothing is searched at all. What is remembered is true,
and stays so whatever becomes of the frame that found it; no answer depends on it, only what it costs, and so, where a
budget is too small for a search, whether it is known.
"""

import math
from typing import Any, NamedTuple

from ...schemas.answers import DistanceAnswers
from ...schemas.errors import SolidcloudError
from ..avatar import AvatarModel
from .frame import Frame

KEPT = "apart"
# Where nothing was in reach so far, a search looks farther by so much, or twice as far where that is less [m]: what it
# costs more it spares in the frames after, as many as the avatar needs for that way.
AHEAD = 1.0
# Distances are rounded, reaches to exact units of 15 nm: nearer than this, only the search itself can tell [m].
ROUNDED = 1e-7
# What placing a point may be off by, at 1e9 m from the origin, too [m].
PLACED = 1e-5

Rows = list[list[float]]


class Known(NamedTuple):
    """What was found at one pose, exactly. rows: the pose.  looked: as far as this [m].  answers: of `distance`.

    generations: of the world's archives; of others it tells nothing.
    """

    world: Any
    generations: tuple[int, ...]
    avatar: AvatarModel
    rows: Rows
    looked: float
    answers: DistanceAnswers


def went(before: Rows, now: Rows, avatar: AvatarModel) -> float:
    """How far any point of the avatar's spheres is from where it was, at most [m]. avatar: not empty."""
    x, y, z = avatar.arrays.center[0].tolist()
    shift = turn = 0.0
    for (a, b, c, t), (d, e, f, u) in zip(before[:3], now[:3], strict=True):
        a, b, c = d - a, e - b, f - c
        turn += a * a + b * b + c * c
        shift += (a * x + b * y + c * z + (u - t)) ** 2
    return (math.sqrt(shift) + math.sqrt(turn) * avatar.bounding_radius) * (1.0 + 1e-9) + PLACED


def nearest(frame: Frame, reach: float) -> DistanceAnswers | None:
    """What `distance` answers at the frame's pose, looking as far as reach or farther; None: surely nothing is within.

    Where it is not exact, something in reach is missing, or the frame's budget is spent.
    """
    body, world = frame.body, frame.world
    avatar, rows = body.avatar, frame.pose.tolist()
    generations = world.generations()
    known: Known | None = body.kept.get(KEPT)
    if (
        known is not None
        and known.world is world
        and known.generations == generations
        and known.avatar is avatar
    ):
        at_least = float(known.answers.lower[0])
        if known.rows == rows:
            if known.looked == reach or (known.looked > reach and abs(at_least - reach) > ROUNDED):
                return known.answers
        elif at_least - went(known.rows, rows, avatar) > reach + ROUNDED:
            return None
        if at_least >= reach > ROUNDED:  # of no reach twice as far is no farther
            looked = reach + min(reach, AHEAD)
            ahead = _ahead(frame, reach, looked)
            if ahead is not None:
                body.kept[KEPT] = Known(world, generations, avatar, rows, looked, ahead)
                return ahead
    answers: DistanceAnswers = world.distance(avatar, frame.pose, reach, effort=frame.effort)
    if answers.exact[0] and len(avatar.points):
        body.kept[KEPT] = Known(world, generations, avatar, rows, reach, answers)
    else:
        body.kept.pop(KEPT, None)
    return answers


def _ahead(frame: Frame, reach: float, looked: float) -> DistanceAnswers | None:
    """The answer of a search as far as `looked`, where it tells what one as far as `reach` would; None: it does not."""
    try:
        answers: DistanceAnswers = frame.world.distance(
            frame.body.avatar, frame.pose, looked, effort=frame.effort
        )
    except SolidcloudError:  # too far to look; `reach` may not be
        return None
    # What is missing beyond reach must not make the answer any less sure.
    return answers if answers.exact[0] and abs(answers.lower[0] - reach) > ROUNDED else None


def surely_farther(answers: DistanceAnswers | None, metres: float) -> bool:
    """Whether the spheres are farther apart than this, by what `nearest` answers of it."""
    return answers is None or bool(answers.exact[0] and answers.signed_distance[0] > metres + ROUNDED)


def farther(frame: Frame, metres: float) -> bool:
    """Whether the avatar is surely farther from the scene than this: its spheres, from all spheres of the scan."""
    return surely_farther(nearest(frame, metres), metres)
