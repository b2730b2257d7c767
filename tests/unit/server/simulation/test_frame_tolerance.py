"""Test the tolerance of a scene's frames: contact may be early, and what exact frames allow is allowed."""

from pathlib import Path

import effect_rooms
import numpy as np
import pytest
from facade_scene import scene_text
from solidcloud.schemas.scene.effect_table import MAX_TOLERANCE
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.scene import Scene

pytestmark = pytest.mark.interpreted

WALKING = ("stop", "sweep", "slide", "step", "ground")


def test_an_avatar_nearer_to_the_floor_than_the_tolerance_walks_and_rests(tmp_path: Path) -> None:
    case = effect_rooms.build(tmp_path, effect_rooms.plane((-2.0, -2.0, 0.0), (2.0, 2.0, 0.0)))
    person, paths = effect_rooms.person(), []
    for tolerance in (0.0, MAX_TOLERANCE):
        path = tmp_path / f"{tolerance}.toml"
        path.write_text(scene_text(case.archive, WALKING, tolerance=tolerance))
        with Scene.open(path, "floor") as scene:
            scene.add_avatar("person", person.points, person.radius)
            places = []
            with scene.session("person") as session:
                for frame in range(60):
                    x = min(frame, 30) / 30
                    session.wish(pose=effect_rooms.at(x, 0.0, effect_rooms.RADIUS + 0.03), time=frame / 30)
                    places.append(session.latest().pose[0])
            assert (scene.collide("person", np.array(places)).verdict == Verdict.CLEAR).all()
            paths.append(np.array(places)[:, :3, 3])
    assert paths[0][-1, 0] == paths[1][-1, 0] == 1.0, "it arrived"
    assert np.ptp(paths[1][30:, 2]) == 0.0, "it rests"
    assert np.allclose(*paths, atol=0.01)
