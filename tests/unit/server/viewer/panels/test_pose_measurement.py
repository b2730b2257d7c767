"""Test exact and tolerant answers for a pose as a message."""

import json
from typing import Any

import numpy as np
from solidcloud.schemas.wire.answers import CollideAnswers, DistanceAnswers
from solidcloud.server.viewer.panels.pose_measurement import MEASURED_REACH, measured_message


def cost(tolerance: float, seconds: float) -> dict[str, Any]:
    """Return what both answers have: a tenth of the visits with a tolerance."""
    return {
        "outside": np.zeros(1, bool),
        "voxels_missing": np.zeros(1, np.uint32),
        "node_visits": np.array([4 if tolerance else 40], np.uint32),
        "point_tests": np.array([2], np.uint32),
        "engine_seconds": seconds,
    }


class Client:
    """Server of a scene without points within reach, whose first answers take longest."""

    def __init__(self) -> None:
        self.asked: list[tuple[str, float]] = []

    def collide(self, name: str, poses: Any, *, tolerance: float) -> CollideAnswers:
        self.asked.append(("collide", tolerance))
        bounds = np.array([0.02]) if tolerance else np.empty(0)
        return CollideAnswers(
            verdict=np.array([1 if tolerance else 0], np.uint8),
            lower=bounds,
            upper=bounds + 0.01,
            exact=np.zeros(len(bounds), bool),
            **cost(tolerance, 1.0 / len(self.asked)),
        )

    def distance(self, name: str, poses: Any, reach: float, *, tolerance: float) -> DistanceAnswers:
        self.asked.append(("distance", tolerance))
        assert poses.shape == (1, 4, 4)
        none = np.full((1, 3), np.nan)
        return DistanceAnswers(
            verdict=np.zeros(1, np.uint8),
            signed_distance=np.array([np.inf]),
            lower=np.array([reach]),
            upper=np.array([np.inf]),
            exact=np.ones(1, bool),
            witness_avatar=none,
            witness_cloud=none,
            normal=none,
            **cost(tolerance, 1.0 / len(self.asked)),
        )


def test_both_questions_are_answered_exactly_and_within_the_tolerance() -> None:
    client = Client()
    message = json.loads(measured_message(client, "al", np.eye(4), 0.03))
    assert (message["type"], message["tolerance"], message["reach"]) == ("measured", 0.03, MEASURED_REACH)
    collide, distance = message["answers"]["collide"], message["answers"]["distance"]
    exact = client.asked.index(("collide", 0.03))  # the last exact answer took the least time
    assert collide["exact"] == {
        "verdict": 0, "sure": True, "lower": None, "upper": None, "visits": 40, "tests": 2, "seconds": 1 / exact,
    }  # fmt: skip
    assert collide["tolerant"]["verdict"] == 1 and not collide["tolerant"]["sure"]
    assert (collide["tolerant"]["lower"], collide["tolerant"]["visits"]) == (0.02, 4)
    # Infinite bounds are null: JSON has no infinity.
    assert (distance["exact"]["lower"], distance["exact"]["upper"]) == (MEASURED_REACH, None)
    assert {tolerance for _, tolerance in client.asked} == {0.0, 0.03}
