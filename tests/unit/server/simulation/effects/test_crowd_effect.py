"""`crowd`: users do not walk through one another. The judge asks every pair of points of every two of them."""

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from moving_bodies import INTERPRETED, Stage, at, ball, box, staged, touch
from numpy.typing import NDArray
from solidcloud.schemas.errors import BadRequestError
from solidcloud.schemas.scene.effect_table import AnyEffect, Crowd, Ground, Slide, Step, Stop, Sweep
from solidcloud.server.avatars.avatar_model import AvatarModel, make_avatar
from solidcloud.server.simulation.effects import body_effects as crowd

SMALL = ball(0.2, 12 if INTERPRETED else 60)
CONTINUOUS: list[AnyEffect] = [Stop(), Sweep()]


def overlapping(stage: Stage, margin: float = 0.0) -> list[tuple[str, str]]:
    """Who touches whom."""
    origin = stage.bodies.origin
    return [
        (one, other)
        for one, other in combinations(stage.users, 2)
        if touch(
            stage.users[one].avatar, stage.users[one].pose, stage.users[other].avatar, stage.users[other].pose,
            origin, margin,
        )
    ]  # fmt: skip


def around(count: int, distance: float) -> NDArray[np.float64]:
    """Places (count, 3) on a circle."""
    angle = 2 * np.pi * np.arange(count) / count
    return np.stack([distance * np.cos(angle), distance * np.sin(angle), np.zeros(count)], axis=1)


@pytest.mark.interpreted
@pytest.mark.parametrize("margin", [0.05])
def test_users_pushed_into_one_spot_do_not_overlap(tmp_path: Path, margin: float) -> None:
    count, frames = (4, 6) if INTERPRETED else (6, 20)
    met = 0
    with staged(tmp_path, [*CONTINUOUS, Crowd(margin=margin)]) as stage:
        for number, place in enumerate(around(count, 1.2)):
            stage.enter(f"c/{number}", SMALL, at(*place))
        for frame in range(frames):
            for name, body in stage.users.items():
                way = -body.pose[:3, 3] * (1.0 if frame % 7 == 0 else 0.2)
                moved = stage.step(name, way)
                assert moved.crowd is not None
                met += moved.crowd.met
                assert (moved.crowd.met > 0) == any(each.what for each in moved.touched)
            assert overlapping(stage, margin) == [], f"frame {frame}"
        nearest = min(np.linalg.norm(body.pose[:3, 3]) for body in stage.users.values())
        assert met and nearest < 0.5, "they came together"


@pytest.mark.interpreted
@pytest.mark.parametrize("effects", [CONTINUOUS, [Stop()]], ids=["continuous", "discrete"])
def test_users_who_begin_in_one_spot_get_apart(tmp_path: Path, effects: list[AnyEffect]) -> None:
    """Each wishes to go its own way out; who would come nearer to another's middle waits."""
    count = 3 if INTERPRETED else 4
    ways = around(count, 0.06)
    with staged(tmp_path, [*effects, Crowd()]) as stage:
        for number in range(count):
            stage.enter(f"c/{number}", SMALL, at(0))
        assert len(overlapping(stage)) == count * (count - 1) // 2
        frames = 0
        while overlapping(stage):
            for way, name in zip(ways, list(stage.users), strict=True):
                before = {pair: _apart(stage, *pair) for pair in overlapping(stage)}
                stage.step(name, way)
                for pair in overlapping(stage):
                    assert pair in before, f"frame {frames}: {pair} overlap, and did not"
                    assert _apart(stage, *pair) >= before[pair] - 1e-9, f"frame {frames}: {pair} went deeper"
            frames += 1
            assert frames < 300, overlapping(stage)


def _apart(stage: Stage, one: str, other: str) -> float:
    """How far two users' middles are from each other [m]."""
    return float(np.linalg.norm(stage.users[one].pose[:3, 3] - stage.users[other].pose[:3, 3]))


@pytest.mark.interpreted
def test_who_overlaps_may_turn_stand_and_go_up_but_not_deeper(tmp_path: Path) -> None:
    with staged(tmp_path, [*CONTINUOUS, Crowd()]) as stage:
        stage.enter("c/still", SMALL, at(0.2))
        for name, wish, goes in (
            ("out", at(-0.3), True), ("across", at(0, 0.3), True), ("turn", at(0, heading=2.0), True),
            ("up", at(0, 0, 0.1), True), ("stay", at(0), True), ("deeper", at(0.1), False),
            ("through", at(3.0), False),
        ):  # fmt: skip
            body = stage.enter("c/walker", SMALL, at(0))
            moved = stage.go("c/walker", wish)
            assert np.array_equal(body.pose, wish if goes else at(0)), name
            assert moved.crowd is not None and moved.crowd.met == (not goes), name


@pytest.mark.interpreted
def test_a_thin_body_is_met_at_fifty_metres_a_frame(tmp_path: Path) -> None:
    leaf = box(0.02, 0.8, 0.8, 0.1 if INTERPRETED else 0.02, 0.01)
    if INTERPRETED:
        leaf = make_avatar(leaf.points, 0.03)
    with staged(tmp_path, [*CONTINUOUS, Crowd()]) as stage:
        stage.enter("c/leaf", leaf, at(0.5))
        for start, wish in (
            (at(-25, 0, 1), at(25, 0, 1)),
            (at(0), at(1.0)),
            (at(25, 0, 2), at(-25, 0.1, 2)),
        ):
            body = stage.enter("c/walker", SMALL, start)
            stage.users["c/leaf"].pose = at(0.5, 0, start[2, 3])
            stage.bodies.put_user(stage.users["c/leaf"])
            stage.go("c/walker", wish)
            assert abs(body.pose[0, 3] - 0.5) < 0.26, "it stands before the leaf"
            assert (body.pose[0, 3] > 0.5) == (start[0, 3] > 0.5), "on its own side"
            assert not overlapping(stage)


@pytest.mark.parametrize(
    "effects",
    [CONTINUOUS, [*CONTINUOUS, Slide()], [Stop()]],
    ids=["continuous", "sliding", "discrete"],
)
def test_random_frames_never_end_in_a_new_overlap(tmp_path: Path, effects: list[AnyEffect]) -> None:
    rng = np.random.default_rng(11)
    stops = 0
    with staged(tmp_path, [*effects, Crowd()]) as stage:
        models = [SMALL, box(0.5, 0.2, 0.6, 0.06, 0.03), make_avatar(np.zeros((0, 3)), 0.1)]
        for number, place in enumerate(around(6, 1.0)):
            stage.enter(f"c/{number}", models[number % 3], at(*place))
        for _ in range(15):
            for name, body in stage.users.items():
                wish = at(*rng.normal(size=3) * [0.5, 0.5, 0.1], heading=rng.uniform(0, 6))
                moved = stage.go(name, wish)
                stops += bool(moved.touched)
                assert not np.array_equal(body.pose, wish) or not moved.touched
            assert overlapping(stage) == []
    assert stops > 10


def test_a_margin_beyond_reason_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadRequestError, match="margin 9 m of crowd"):
        crowd.make(Crowd(margin=9.0), None)
    large = make_avatar(np.zeros((1, 3)), 5.0)
    with staged(tmp_path, [Crowd(), Stop()]) as stage, pytest.raises(BadRequestError, match="at most 4 m"):
        stage.enter("c/large", large, at(0))


def test_a_user_pressed_between_two_others_keeps_standing(tmp_path: Path) -> None:
    person, height = ball_stack(), 0.0
    with staged(tmp_path, [*CONTINUOUS, Slide(), Step(), Ground(), Crowd()]) as stage:
        for name, x in (("left", -0.6), ("middle", 0.0), ("right", 0.6)):
            stage.enter(name, person, at(x, 0.0, 0.0))
        for frame in range(60):
            ways = {"left": (0.04, 0.0, 0.0), "middle": (0.0, 0.0, 0.0), "right": (-0.04, 0.0, 0.0)}
            for name, way in ways.items():
                stage.step(name, way if frame > 20 else (0.0, 0.0, 0.0))
            if frame > 20:
                middle = stage.users["middle"]
                assert middle.on_ground and middle.fall_speed == 0.0, f"frame {frame}"
                assert abs(middle.pose[2, 3] - height) < 0.005
            else:
                height = stage.users["middle"].pose[2, 3]
            assert overlapping(stage) == []
        apart = stage.users["right"].pose[0, 3] - stage.users["left"].pose[0, 3]
        assert apart < 0.9, "the middle is pressed from both sides"


def ball_stack() -> AvatarModel:
    """Return an upright body of two balls of 60 spheres, whose bumps face the neighbours' bumps."""
    low, high = SMALL.points, np.add(SMALL.points, [0.0, 0.0, 0.3])
    return make_avatar(np.concatenate([low, high]), SMALL.radius)
