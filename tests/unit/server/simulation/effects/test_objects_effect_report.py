"""Test the report of the effect `objects`: contacts against brute force, changed poses, and repeated queries."""

from pathlib import Path

import naive_objects
import numpy as np
import pytest
from movable_objects import AVATARS, CRATE, MOVING, USER, item, where
from moving_bodies import INTERPRETED, at, room, staged


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
            fails = (["sweep"], lambda frame: (_ for _ in ()).throw(OSError("disk")))
            broken.setattr(stage.pipeline, "runs", [*stage.pipeline.runs[:-1], fails])
            stage.go("c/u", at(0.1, -1))
        assert np.array_equal(body.pose, at(0, -1))
        for expected in ({"door": there}, {}):
            moved = stage.go("c/u", at(0, -1))
            assert moved.objects is not None and moved.objects.poses == expected
