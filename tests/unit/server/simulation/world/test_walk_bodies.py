"""Test that a crowd's frames are the same whether the kernel or Python tests the other users."""

from pathlib import Path

import numpy as np
import pytest
from moving_bodies import INTERPRETED, at, ball, box, staged
from solidcloud.schemas.scene.effect_table import AnyEffect, Crowd, Ground, Slide, Step, Stop, Sweep
from solidcloud.schemas.wire.encoding import encode
from solidcloud.server.kernels.walk import walk_state
from solidcloud.server.simulation.world import frame_walk
from solidcloud.server.simulation.world.walk_call import WalkCall

BALL = ball(0.2, 12 if INTERPRETED else 60)
BRICK = box(0.3, 0.3, 0.4, 0.08, 0.04)
FRAMES = 3 if INTERPRETED else 60
# Queries about bodies that take Python a sweep or a test of contact.
OF_BODIES = (walk_state.BODIES_SWEPT, walk_state.BODIES_AT)


def pressed(folder: Path, case: str, margin: float, asked: list[int]) -> list[bytes]:
    """Return the answers and poses of users who press towards the middle from all sides.

    asked: set to the queries that Python answered.
    """
    asked.clear()
    rng, answers, count = np.random.default_rng(7), [], 3 if INTERPRETED else 8
    effects: list[AnyEffect] = [Stop(), Sweep(), Slide(), Crowd(margin=margin)]
    if case == "ground":
        effects += [Step(height=0.1), Ground()]
    with staged(folder, effects) as stage:
        for number in range(count):
            angle = 2.0 * np.pi * number / count
            shape = BRICK if case == "mixed" and number % 2 else BALL
            far = 0.05 if case == "overlapping" else 0.8
            stage.enter(
                f"c/{number}", shape, at(far * np.cos(angle), far * np.sin(angle), 0.1 * (number % 2), angle)
            )
        for number in range(FRAMES):
            for name, body in stage.users.items():
                way = (-0.2 if number < 40 else 0.3) * body.pose[:3, 3] + rng.normal(0.0, 0.03, 3)
                wish = (
                    at(*(body.pose[:3, 3] + way), heading=0.1 * number)
                    if number % 3 == 0
                    else body.pose.copy()
                )
                wish[:3, 3] = body.pose[:3, 3] + way
                answers += [encode(stage.go(name, wish)), body.pose.tobytes()]
    return answers


@pytest.mark.interpreted
@pytest.mark.parametrize("case", ["alike", "mixed", "overlapping", "ground"])
@pytest.mark.parametrize("margin", [0.05])
def test_a_crowd_is_the_same_with_bodies_tested_in_python(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, case: str, margin: float
) -> None:
    asked: list[int] = []
    answer = WalkCall.answer

    def recorded(self: WalkCall) -> None:
        asked.append(int(self._thread.memory.log[walk_state.ASKED]))
        answer(self)

    monkeypatch.setattr(WalkCall, "answer", recorded)
    compiled = pressed(tmp_path, case, margin, asked)
    of_kernel = list(asked)
    monkeypatch.setattr(frame_walk, "_only_obstacle", lambda frame: None)
    assert pressed(tmp_path, case, margin, asked) == compiled
    assert walk_state.BODIES_HIT not in asked
    by_kernel, by_python = (sum(each in OF_BODIES for each in found) for found in (of_kernel, asked))
    if case == "mixed":
        assert by_kernel == by_python
    elif case == "overlapping":
        assert 0 < by_kernel <= by_python
    else:
        assert by_kernel < 0.1 * by_python
        assert INTERPRETED or walk_state.BODIES_HIT in of_kernel
