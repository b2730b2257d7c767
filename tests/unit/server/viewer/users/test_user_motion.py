"""Test motion commands: relative to the view, and off a wall where the user is stuck."""

import math

import numpy as np
import pytest
from solidcloud.schemas.wire.motion_messages import State, Touched
from solidcloud.server.viewer.page.page_messages import Intent
from solidcloud.server.viewer.page.view_frame import ViewFrame
from solidcloud.server.viewer.users.user_motion import RUN_SPEED, WALK_SPEED, Easing, turn, velocity

FRAME = ViewFrame([[0, 0, 0], [1, 1, 1]])
Y_UP = ViewFrame([[0, 0, 0], [1, 1, 1]], (0, 1, 0))


@pytest.mark.parametrize(
    ("intent", "way"),
    [
        (Intent(forward=1), (1, 0, 0)),
        (Intent(forward=1, yaw=math.pi / 2), (0, 1, 0)),
        (Intent(right=1, yaw=math.pi / 2), (1, 0, 0)),
        (Intent(forward=-0.5), (-0.5, 0, 0)),
        (Intent(forward=1, right=1), (math.sqrt(0.5), -math.sqrt(0.5), 0)),
        (Intent(up=1), (0, 0, 1)),
        (Intent(), (0, 0, 0)),
    ],
)
def test_velocity_is_relative_to_the_view(intent: Intent, way: tuple[float, ...]) -> None:
    assert np.allclose(velocity(intent, FRAME), np.multiply(way, WALK_SPEED))


def test_run_is_faster_and_up_is_the_scenes() -> None:
    assert np.linalg.norm(velocity(Intent(forward=1, run=True), FRAME)) == pytest.approx(RUN_SPEED)
    assert np.allclose(velocity(Intent(up=1), Y_UP), (0, WALK_SPEED, 0))


def test_user_turns_the_short_way_to_where_it_goes_or_looks() -> None:
    assert turn(Intent(forward=1, yaw=3.0), -3.0) < 0
    assert turn(Intent(forward=1, yaw=-3.0), 3.0) > 0
    assert turn(Intent(forward=-1), math.pi) == 0
    assert turn(Intent(right=1), -math.pi / 2) == 0
    assert turn(Intent(yaw=1.0), 0.0) == 0
    assert turn(Intent(yaw=1.0, face=True), 0.0) > 0


WANTED = np.array([-1.0, 1.0, 0.0])
X = (1.0, 0.0, 0.0)


def state(x: float, *normals: tuple[float, float, float] | None) -> State:
    """Return a state at a place, stopped by surfaces."""
    pose = np.eye(4)
    pose[0, 3] = x
    touched = [Touched((0.0, 0.0, 0.0), normal) for normal in normals]
    return State(pose=pose[None], touched=touched, seq=1, time=0.0, frame=1)


def commands(states: list[State], wanted: np.ndarray = WANTED) -> list[tuple[np.ndarray, bool]]:
    easing = Easing()
    return [easing.ease(wanted, each) for each in states]


def test_stuck_user_goes_along_the_wall_and_off_it_for_a_while() -> None:
    found = commands([state(0.0, X)] * 4 + [state(0.01 * k) for k in range(20)])
    assert [is_off for _, is_off in found] == [False] * 3 + [True] * 20 + [False]
    for speed, is_off in found:
        assert (speed[0] > 0) == is_off
        assert speed[1] == 1.0


@pytest.mark.parametrize(
    "states",
    [
        [state(0.0)] * 20,  # nothing is touched
        [state(0.0, None)] * 20,  # without a normal
        [state(0.05 * k, X) for k in range(20)],  # slides
        [state(0.0, (math.sqrt(0.5), -math.sqrt(0.5), 0.0))] * 20,  # head on
    ],
)
def test_other_users_go_where_they_want(states: list[State]) -> None:
    for speed, is_off in commands(states):
        assert not is_off
        assert np.array_equal(speed, WANTED)
