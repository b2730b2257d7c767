"""Test that a crowd's frames are the same whether the kernel or Python finds that no user is near."""

from pathlib import Path

import numpy as np
import pytest
from moving_bodies import INTERPRETED, at, ball, box, staged
from solidcloud.schemas.scene.effect_table import AnyEffect, Crowd, Ground, Slide, Step, Stop, Sweep
from solidcloud.schemas.wire.encoding import encode

BALL = ball(0.2, 12 if INTERPRETED else 30)
BRICK = box(0.3, 0.3, 0.4, 0.08, 0.04)
USERS, FRAMES = (3, 3) if INTERPRETED else (5, 14)


def pressed(folder: Path, case: str, *, native: bool) -> list[bytes]:
    """Return the answers and poses of users who press towards the middle from all sides, and part."""
    rng, answers = np.random.default_rng(7), []
    effects: list[AnyEffect] = [Stop(), Sweep(), Slide(), Crowd(margin=0.05)]
    if case == "ground":
        effects += [Step(height=0.1), Ground()]
    with staged(folder, effects) as stage:
        stage.world.walker.native = native
        for number in range(USERS):
            angle = 2.0 * np.pi * number / USERS
            shape = BRICK if case == "mixed" and number % 2 else BALL
            far = 0.05 if case == "overlapping" else 0.6
            stage.enter(
                f"c/{number}", shape, at(far * np.cos(angle), far * np.sin(angle), 0.1 * (number % 2), angle)
            )
        for number in range(FRAMES):
            for name, body in stage.users.items():
                way = (-0.2 if number < 10 else 0.3) * body.pose[:3, 3] + rng.normal(0.0, 0.03, 3)
                wish = at(0, heading=0.1 * number) if number % 3 == 0 else body.pose.copy()
                wish[:3, 3] = body.pose[:3, 3] + way
                answers += [encode(stage.go(name, wish)), body.pose.tobytes()]
    return answers


@pytest.mark.interpreted
@pytest.mark.parametrize("case", ["alike", "mixed", "overlapping", "ground"])
def test_a_crowd_is_the_same_with_bodies_tested_in_python(tmp_path: Path, case: str) -> None:
    assert pressed(tmp_path, case, native=True) == pressed(tmp_path, case, native=False)
