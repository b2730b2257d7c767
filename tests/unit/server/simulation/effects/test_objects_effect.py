"""`objects`: doors that are told where to be, crates that are pushed; what they touch, by brute force."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from movable_objects import AVATARS, CRATE, LEAF, MOVING, USER, free_of, item, where
from moving_bodies import INTERPRETED, at, staged, touch
from solidcloud.schemas.errors import BadRequestError, BadTransformError, ExpiredError
from solidcloud.schemas.scene.effect_table import AnyEffect, Crowd, Ground, Objects, Slide, Stop, Sweep
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.schemas.wire.key_expressions import User
from solidcloud.schemas.wire.motion_messages import Wish
from solidcloud.server.runtime.stop_flag import NO_STOP
from solidcloud.server.runtime.stop_flag import StopFlag as Ending
from solidcloud.server.scene_interface import FrameCommand
from solidcloud.server.simulation.simulation import Simulation
from solidcloud.server.simulation.world.bodies import Bodies


@pytest.mark.interpreted
def test_a_pushed_crate_stops_at_the_wall_and_the_user_behind_it(tmp_path: Path) -> None:
    with staged(tmp_path, MOVING, avatars=AVATARS, objects=(item("crate", at(1.0)),)) as stage:
        body = stage.enter("c/u", USER, at(0))
        stops = 0
        for _ in range(8 if INTERPRETED else 40):
            before, wish = body.pose[0, 3], body.pose[0, 3] + (0.4 if INTERPRETED else 0.05)
            begun = where(stage, "crate")[0, 3]
            moved = stage.go("c/u", at(wish))
            gone = where(stage, "crate")[0, 3] - begun
            assert 0 <= gone <= wish - before, "no farther than was wished"
            assert moved.objects is not None and ("crate" in moved.objects.poses or not gone)
            if gone:
                assert moved.objects.poses["crate"] == where(stage, "crate").tolist()
            assert free_of(stage, "crate")
            stops += bool(moved.touched)
            assert {each.what for each in moved.touched} <= {"crate"}
        assert where(stage, "crate")[0, 3] > 1.65 and body.pose[0, 3] > 1.2 and stops
        assert np.array_equal(where(stage, "crate")[1:], at(0)[1:]), "pushed straight on"
        stood = where(stage, "crate")
        for _ in range(3):
            moved = stage.go("c/u", body.pose.copy())
            assert np.array_equal(where(stage, "crate"), stood), "nobody pushes: it stands"
        assert moved.objects is not None and moved.objects.poses == {}


@pytest.mark.interpreted
def test_a_stopped_frame_leaves_what_it_pushed_where_it_stood(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The frames after it are those of a log's replay, where it is stopped before it begins."""
    after: list[list[Any]] = []
    put, user = Bodies.put, User("c", "u")
    for first in (True, False):
        (tmp_path / str(first)).mkdir()
        objects = (item("crate", at(1.0)), item("other", at(1.65)))
        with staged(tmp_path / str(first), MOVING, avatars=AVATARS, objects=objects) as stage:
            scene = SimpleNamespace(name="room", avatar=lambda *_: USER)
            simulation = Simulation(scene, stage.world.file, stage.pipeline)
            stop, pushed = Ending(), []

            def go(number: int, x: float, stop: Ending = NO_STOP, simulation: Simulation = simulation) -> Any:
                wish = Wish(seq=number, time=number / 30, pose=at(x)[None])
                return simulation.step([FrameCommand(user, wish)], stop=stop)[0].state

            go(0, 0.1)
            stood = where(stage, "crate")

            def ended(bodies: Bodies, *what: Any, stop: Ending = stop, pushed: list[int] = pushed) -> None:
                put(bodies, *what)
                pushed.append(1)
                stop.set("ended")

            if first:
                stop.set("ended")
            monkeypatch.setattr(Bodies, "put", ended)
            assert isinstance(go(1, 0.9, stop), ExpiredError)
            monkeypatch.setattr(Bodies, "put", put)
            assert bool(pushed) is not first
            assert np.array_equal(where(stage, "crate"), stood)
            moved = [go(1 + i, 0.1 + 0.1 * i) for i in range(1, 12)]
            assert where(stage, "crate")[0, 3] > stood[0, 3]
            after.append(
                [(each.pose.tolist(), each.verdict, each.objects and each.objects.touching) for each in moved]
                + [where(stage, name).tolist() for name in ("crate", "other")]
            )
    assert after[0] == after[1]


@pytest.mark.interpreted
def test_a_crate_is_not_pushed_through_another_nor_into_a_user_nor_pulled_nor_pressed_down(
    tmp_path: Path,
) -> None:
    objects = (item("crate", at(0.6)), item("other", at(1.2)))
    with staged(tmp_path, [*MOVING, Crowd()], avatars=AVATARS, objects=objects) as stage:
        body = stage.enter("c/u", USER, at(0))
        stage.enter("c/still", USER, at(0.6, 1.0))
        for way in ((3, 0, 0), (3, 0, 0), (0.05, 0, 0)):
            stage.step("c/u", way)
            assert free_of(stage, "crate") and free_of(stage, "other")
        assert np.array_equal(where(stage, "other"), at(1.2)), "what is pushed pushes nothing"
        assert 0.65 < where(stage, "crate")[0, 3] < 0.8
        stood = where(stage, "crate")
        stage.step("c/u", (-1, 0, 0))
        assert np.array_equal(where(stage, "crate"), stood)
        body.pose[:] = at(stood[0, 3], 0, 0.6)
        stage.step("c/u", (0, 0, -1))
        assert np.array_equal(where(stage, "crate"), stood) and body.pose[2, 3] > 0.3
        body.pose[:] = at(stood[0, 3], -1)
        stage.step("c/u", (0, 5, 0))
        assert 0.1 < where(stage, "crate")[1, 3] < 1.0, "the user who stands there is not pushed"
        assert free_of(stage, "crate") and np.array_equal(stage.users["c/still"].pose, at(0.6, 1.0))


@pytest.mark.interpreted
def test_without_sweep_a_crate_gives_way_to_a_whole_step_or_blocks_it(tmp_path: Path) -> None:
    with staged(tmp_path, [Stop(), Objects()], avatars=AVATARS, objects=(item("crate", at(0.6)),)) as stage:
        body = stage.enter("c/u", USER, at(0))
        stage.go("c/u", at(0.3))
        assert np.array_equal(body.pose, at(0.3)) and abs(where(stage, "crate")[0, 3] - 0.9) < 1e-12
        stage.go("c/u", at(1.0))
        assert np.array_equal(body.pose, at(1.0)) and abs(where(stage, "crate")[0, 3] - 1.6) < 1e-12
        moved = stage.go("c/u", at(1.5))
        assert np.array_equal(body.pose, at(1.0)) and [each.what for each in moved.touched] == ["crate"]
        assert 1.65 < where(stage, "crate")[0, 3] < 1.8 and free_of(stage, "crate")


@pytest.mark.interpreted
def test_who_stands_on_a_crate_is_on_the_ground_and_who_walks_along_a_leaf_slides(tmp_path: Path) -> None:
    walking: list[AnyEffect] = [Stop(), Sweep(), Slide(), Ground(), Objects()]
    door = item("door", at(-0.4), avatar="leaf", pushed=False)
    lift = item("lift", at(-1.2), pushed=False)
    with staged(tmp_path, walking, avatars=AVATARS, objects=(door, lift)) as stage:
        body = stage.enter("c/u", USER, at(-1.2, 0, 0.5))
        for _ in range(15):
            moved = stage.go("c/u", body.pose.copy())
        assert moved.ground is not None and moved.ground.on_ground
        assert 0.38 < body.pose[2, 3] < 0.45, "its clearance above the lift"
        stood = body.pose.copy()
        stage.go("c/u", body.pose.copy())
        assert np.array_equal(body.pose, stood), "at rest it stays, bit for bit"
        for rise in np.linspace(0.02, 0.2, 10):
            stage.bodies.place_objects({"lift": at(-1.2, 0, rise).tolist()})
            stage.go("c/u", body.pose.copy())
            assert not touch(USER, body.pose, CRATE, where(stage, "lift"), stage.bodies.origin)
        assert 0.58 < body.pose[2, 3] < 0.65 and np.array_equal(body.pose[:2], stood[:2]), "it is lifted"
    with staged(tmp_path, [Stop(), Sweep(), Slide(), Objects()], avatars=AVATARS, objects=(door,)) as stage:
        body = stage.enter("c/u", USER, at(-0.2, -0.3))
        for _ in range(10):
            moved = stage.step("c/u", (0.05, 0.05, 0))
            assert body.pose[1, 3] < -0.2
        assert body.pose[0, 3] > 0.1, "along it"


@pytest.mark.interpreted
def test_a_door_blocks_until_it_is_opened(tmp_path: Path) -> None:
    """The leaf lies along x, its hinge at the origin; the user goes along y."""
    door = item("door", at(0), avatar="leaf", pushed=False)
    with staged(tmp_path, MOVING, avatars=AVATARS, objects=(door,)) as stage:
        body = stage.enter("c/u", USER, at(0.5, -1))
        for wish in (at(0.5, 1), at(0.5, 49), at(0.5, 0.5)):
            moved = stage.go("c/u", wish)
            assert body.pose[1, 3] < -0.2 and [each.what for each in moved.touched] == ["door"]
        stage.bodies.place_objects({"door": at(0, heading=np.pi / 2).tolist()})
        moved = stage.go("c/u", at(0.5, 1))
        assert np.array_equal(body.pose, at(0.5, 1)) and not moved.touched
        assert moved.objects is not None
        assert moved.objects.poses == {"door": at(0, heading=np.pi / 2).tolist()}


@pytest.mark.interpreted
@pytest.mark.parametrize("angle", [0.3, -0.3])
def test_a_door_that_closes_on_a_user_lets_go_of_it_on_the_side_it_was_on(
    tmp_path: Path, angle: float
) -> None:
    """It swings into who stands in its way; who then wishes through it stays, who goes back gets free."""
    door = item("door", at(0, heading=angle), avatar="leaf", pushed=False)
    side = -np.sign(angle)
    with staged(tmp_path, [*MOVING, Crowd()], avatars=AVATARS, objects=(door,)) as stage:
        body = stage.enter("c/u", USER, at(0.5, 0.08 * side))
        stage.go("c/u", body.pose.copy())
        for swing in np.linspace(angle, -angle / 6, 4)[1:]:
            stage.bodies.place_objects({"door": at(0, heading=float(swing)).tolist()})
            moved = stage.go("c/u", body.pose.copy())
            assert np.array_equal(body.pose, at(0.5, 0.08 * side)), "a door moves nobody"
            inside = touch(USER, body.pose, LEAF, where(stage, "door"), stage.bodies.origin)
            assert moved.verdict == (Verdict.CONTACT if inside else Verdict.CLEAR)
        assert inside
        for wish in (at(0.5, -1 * side), at(0.8, -0.5 * side)):
            moved = stage.go("c/u", wish)
            assert (body.pose[1, 3] - 0.08 * side) * side >= 0, "not through it"
            assert "door" in [each.what for each in moved.touched]
        moved = stage.go("c/u", at(0.5, 0.6 * side))
        assert np.array_equal(body.pose, at(0.5, 0.6 * side)) and not moved.touched
        assert moved.verdict == Verdict.CLEAR
        stage.go("c/u", at(0.5, -1 * side))
        assert body.pose[1, 3] * side > 0.1, "free, it is stopped as ever"


def test_wishes_for_objects_that_cannot_be_granted_are_refused_and_nothing_moves(tmp_path: Path) -> None:
    objects = (item("door", at(0), avatar="leaf", pushed=False), item("crate", at(1.0)))
    with staged(tmp_path, MOVING, avatars=AVATARS, objects=objects) as stage:
        good = {"door": at(0, 0, 0.1).tolist()}
        skewed, mirrored = at(0), at(0)
        skewed[0, 1], mirrored[0, 0] = 1e-3, -1.0
        refused: list[tuple[str, Any, type[Exception], str]] = [
            (
                "gate",
                at(0).tolist(),
                BadRequestError,
                "'gate' is not in this scene: expected a kinematic object: door",
            ),
            ("crate", at(0).tolist(), BadRequestError, "is pushed by users and cannot be placed"),
            ("door", skewed.tolist(), BadTransformError, "not rigid"),
            ("door", mirrored.tolist(), BadTransformError, "not rigid"),
            ("door", (at(0) * 2).tolist(), BadTransformError, "not rigid"),
            ("door", at(float("nan")).tolist(), BadRequestError, "finite"),
            ("door", at(2e9).tolist(), BadRequestError, "within 1e9 m"),
            ("door", at(0)[:3].tolist(), BadRequestError, "expected one pose"),
        ]
        for name, pose, error, text in refused:
            with pytest.raises(error, match=text):
                stage.bodies.place_objects({**good, name: pose})
            assert np.array_equal(where(stage, "door"), at(0)), name
