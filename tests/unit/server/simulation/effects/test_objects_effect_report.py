"""Test the report of the effect `objects`: contacts against brute force, changed poses, and repeated queries."""

from pathlib import Path
from typing import Any

import naive_objects
import numpy as np
import pytest
from movable_objects import AVATARS, CRATE, MOVING, USER, item, where
from moving_bodies import INTERPRETED, at, room, staged
from solidcloud.schemas.scene.effect_table import Crowd, Objects
from solidcloud.schemas.wire.answers import Verdict


@pytest.mark.interpreted
def test_what_is_reported_to_touch_does_by_brute_force(tmp_path: Path) -> None:
    rng = np.random.default_rng(8)
    names = ["a", "b", "c"] if INTERPRETED else ["a", "b", "c", "d", "e"]
    objects = tuple(item(name, at(number), pushed=False) for number, name in enumerate(names))
    found = set()
    with staged(tmp_path, MOVING, avatars=AVATARS, objects=objects) as stage:
        body = stage.enter("c/u", USER, at(0, 0, 5))
        with stage.world as seen:
            arrays, units = seen[0].data.arrays, seen[0].data.radius_units
        lattice = np.rint((room() - arrays.origin) / arrays.step).astype(np.int64)
        for _ in range(2 if INTERPRETED else 12):
            told = rng.choice(names, 2, replace=False).tolist()
            places = {name: rng.uniform(-0.6, 0.6, 3) for name in told}
            stage.bodies.place_objects(
                {name: at(1.2 + x, y, z, heading=5 * x).tolist() for name, (x, y, z) in places.items()}
            )
            report = stage.go("c/u", body.pose.copy()).objects
            assert report is not None
            poses = np.array([where(stage, name) for name in names])
            ones = [1] * len(names)
            pairs = naive_objects.touching_pairs(
                [CRATE.points] * len(names), [CRATE.radius] * len(names), poses, ones, ones, arrays.origin
            )
            scene = naive_objects.touching_scene(
                lattice, arrays.step, np.full(len(lattice), units), [CRATE.points] * len(names),
                [CRATE.radius] * len(names), poses, arrays.origin,
            )  # fmt: skip
            judged = [("", name) for name, touches in zip(names, scene, strict=True) if touches]
            judged += [(names[i], names[j]) for i, j in pairs]
            assert report.touching == judged
            found |= {bool(one) for one, _ in judged}
    assert INTERPRETED or found == {False, True}


@pytest.mark.interpreted
def test_what_has_not_moved_is_not_asked_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    objects = tuple(item(name, at(number), pushed=False) for number, name in enumerate("abc"))
    with staged(tmp_path, [Objects()], avatars=AVATARS, objects=objects) as stage:
        body = stage.enter("c/u", USER, at(0, 0, 5))
        asked = []
        collide = stage.world.collide

        def counted(avatar: Any, *rest: Any) -> Verdict:
            asked.append(avatar)
            return collide(avatar, *rest)

        monkeypatch.setattr(stage.world, "collide", counted)
        for told, count in (({}, 3), ({}, 0), ({"b": at(1, 1).tolist()}, 1), ({"b": at(1, 1).tolist()}, 0)):
            stage.bodies.place_objects(told)
            stage.go("c/u", body.pose.copy())
            assert len([avatar for avatar in asked if avatar is not USER]) == count
            asked.clear()


@pytest.mark.interpreted
def test_what_moved_is_said_once_a_frame_is_done_and_not_lost_with_one_that_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    objects = (item("door", at(0, 1), avatar="leaf", pushed=False),)
    with staged(tmp_path, MOVING, avatars=AVATARS, objects=objects) as stage:
        body = stage.enter("c/u", USER, at(0, -1))
        stage.go("c/u", at(0, -1))
        there = at(0, 1.5).tolist()
        stage.bodies.place_objects({"door": there})
        with monkeypatch.context() as broken, pytest.raises(OSError, match="disk"):
            broken.setattr(stage.world.walker, "run", lambda *_: (_ for _ in ()).throw(OSError("disk")))
            stage.go("c/u", at(0.1, -1))
        assert np.array_equal(body.pose, at(0, -1))
        for expected in ({"door": there}, {}):
            moved = stage.go("c/u", at(0, -1))
            assert moved.objects is not None and moved.objects.poses == expected


def test_where_a_sweep_proved_the_scene_clear_only_objects_are_asked_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with staged(tmp_path, MOVING, avatars=AVATARS, objects=(item("crate", at(0, 1.5)),)) as stage:
        body = stage.enter("c/u", USER, at(0))
        stage.go("c/u", at(0))
        asked = []
        collide = stage.world.collide
        monkeypatch.setattr(stage.world, "collide", lambda *what: asked.append(what) or collide(*what))
        for _ in range(3):
            stage.go("c/u", at(3))
        assert 1.6 < body.pose[0, 3] < 1.8 and not asked
        assert collide(USER, body.pose) == Verdict.CLEAR


def test_what_touches_the_scene_is_asked_anew_of_other_archives(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with staged(tmp_path, [Objects()], avatars=AVATARS, objects=(item("a", at(0), pushed=False),)) as stage:
        stage.enter("c/u", USER, at(0, 0, 5))
        stage.go("c/u", at(0, 0, 5))
        monkeypatch.setattr(stage.world, "generations", lambda: (7,))
        monkeypatch.setattr(stage.world, "collide", lambda *_: Verdict.CONTACT)
        report = stage.go("c/u", at(0, 0, 5)).objects
        assert report is not None and report.touching == [("", "a")]


@pytest.mark.interpreted
def test_the_same_wishes_give_the_same_poses_bit_for_bit(tmp_path: Path) -> None:
    found = []
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        rng = np.random.default_rng(4)
        objects = (item("crate", at(0.6)), item("door", at(0.4, 0.6), avatar="leaf", pushed=False))
        poses = []
        with staged(tmp_path / folder, [*MOVING, Crowd()], avatars=AVATARS, objects=objects) as stage:
            for number in range(2):
                stage.enter(f"c/{number}", USER, at(-0.5, number))
            for _ in range(2 if INTERPRETED else 15):
                stage.bodies.place_objects({"door": at(0.4, 0.6, heading=rng.uniform(0, 1)).tolist()})
                for name in stage.users:
                    stage.go(name, at(*rng.uniform(-1, 1, 3) * [1, 1, 0.1]))
                poses.append(stage.bodies.poses.tobytes())
        found.append(b"".join(poses))
    assert found[0] == found[1]
