"""Exact and tolerant answers for one pose, side by side: what a tolerance saves, and what it leaves open."""

import math
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ....schemas.wire.answers import CollideAnswers, DistanceAnswers
from ..page.page_messages import text_message

# Repetitions of each question: the least time is that of the engine with the voxels in memory, the
# others include what else the machine did meanwhile.
_REPETITIONS = 5
# Farthest distance that is measured [m].
MEASURED_REACH = 1.0


class Asked(Protocol):
    """Client of a scene, as far as a measurement needs it."""

    def collide(self, name: str, poses: Any, /, *, tolerance: float) -> CollideAnswers: ...
    def distance(self, name: str, poses: Any, reach: float, /, *, tolerance: float) -> DistanceAnswers: ...


def measured_message(client: Asked, name: str, pose: NDArray[np.float64], tolerance: float) -> str:
    """Return the answers for a pose (4, 4) of an avatar as a message for the page.

    tolerance: of the second answer to each question [m]; the first one is exact.
    """
    answers = {
        question: {
            "exact": least([ask(client, question, name, pose, 0.0) for _ in range(_REPETITIONS)]),
            "tolerant": least([ask(client, question, name, pose, tolerance) for _ in range(_REPETITIONS)]),
        }
        for question in ("collide", "distance")
    }
    return text_message("measured", tolerance=tolerance, reach=MEASURED_REACH, answers=answers)


def ask(
    client: Asked, question: str, name: str, pose: NDArray[np.float64], tolerance: float
) -> dict[str, Any]:
    """Return one answer for the page.

    lower, upper: bounds of the signed distance [m], null: none were asked for, or infinite.
    sure: the answer is known to be the exact one.  visits: pairs of bounding spheres.  tests: pairs
    of points.  seconds: in the engine.
    """
    answers: CollideAnswers | DistanceAnswers
    if question == "collide":
        answers = client.collide(name, pose[None], tolerance=tolerance)
    else:
        answers = client.distance(name, pose[None], MEASURED_REACH, tolerance=tolerance)
    bounded = len(answers.lower) > 0
    return {
        "verdict": int(answers.verdict[0]),
        "sure": bool(answers.exact[0]) if bounded else int(answers.verdict[0]) != 2,
        "lower": finite(answers.lower[0]) if bounded else None,
        "upper": finite(answers.upper[0]) if bounded else None,
        "visits": int(answers.node_visits[0]),
        "tests": int(answers.point_tests[0]),
        "seconds": answers.engine_seconds,
    }


def least(answers: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the answer that took the least time."""
    return min(answers, key=lambda each: each["seconds"])


def finite(value: float) -> float | None:
    """Return a number for JSON; None for one that is infinite."""
    return float(value) if math.isfinite(value) else None
