"""A scene: avatars belong to clients, budgets are checked, what is closed stays closed."""

import json
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import archive_cases
import numpy as np
import pytest
import synthetic_scans
from solidcloud.schemas.errors import BadRequestError, FormatError, UnknownAvatarError
from solidcloud.server.scene import Scene

BODY = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.0, 0.2, 0]])
HERE = np.eye(4)[None]


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    """A scene of a few voxels."""
    return Scene.open(
        archive_cases.build(tmp_path, synthetic_scans.make_scan("corner", 4, 300)).archive, "hall"
    )


def test_info_says_what_was_built(scene: Scene) -> None:
    info = scene.info()
    points = synthetic_scans.make_scan("corner", 4, 300)
    assert (info.scene, info.points, info.radius, info.lattice_step) == ("hall", 300, 0.01, 1e-4)
    assert info.origin == points.min(axis=0).tolist()
    assert np.abs(np.array(info.bounds) - [points.min(axis=0), points.max(axis=0)]).max() <= 0.5001e-4
    assert info.sources[0].count == 300 and info.skipped == []
    assert 0 < info.record_bytes < info.resident_bytes


def test_repr_is_one_helpful_line(scene: Scene) -> None:
    voxels = scene.info().voxels
    assert repr(scene) == f"<Scene 'hall': 300 points in {voxels} voxels, no avatars>"
    for name in "edcba":
        scene.add_avatar(name, BODY, 0.01)
    scene.add_avatar("of a client", BODY, 0.01, client="one")
    assert repr(scene).endswith("voxels, avatars a, b, c and 2 more>")
    session = scene.session("a")
    assert repr(session) == "<Session of 'a' in 'hall': closed, no state yet>"
    with session:
        session.wish(HERE)
        assert repr(session).startswith("<Session of 'a' in 'hall': open, command 1: at (0, 0, 0): ")
        assert repr(session).endswith(" s ago>") and repr(session.latest()).endswith(" s ago")
    scene.close()
    assert repr(scene) == "<Scene 'hall': closed>"


def test_answers_of_a_scene_are_one_line_and_become_json(scene: Scene) -> None:
    scene.add_avatar("al", BODY, 0.01)
    for answers in (
        scene.collide("al", HERE),
        scene.distance("al", HERE, 0.5),
        scene.contacts("al", HERE),
        scene.sweep("al", HERE, HERE),
        scene.raycast([[0.0, 0, 9]], [[0.0, 0, -1]], 20.0),
        scene.within([[0.0, 0, 0]], 1.0),
        scene.objects([("al", HERE[0])]),
        next(iter(scene.path("al", HERE))),
        scene.move("al", HERE, HERE),
    ):
        assert "\n" not in repr(answers) and len(repr(answers)) < 160
        assert json.loads(json.dumps(answers.to_dict(), allow_nan=False)) == answers.to_dict()


def test_an_unknown_avatar_is_an_error(scene: Scene) -> None:
    with pytest.raises(UnknownAvatarError, match="'al' is not known: add it"):
        scene.collide("al", HERE)


def test_a_name_stands_for_one_set_of_points(scene: Scene) -> None:
    first = scene.add_avatar("al", BODY, 0.01)
    assert scene.add_avatar("al", BODY.tolist(), 0.01) == first
    for points, radius in (
        (BODY + 1e-9, 0.01),
        (BODY[:2], 0.01),
        (BODY[::-1], 0.01),
        (BODY, 0.02),
        (BODY, None),
    ):
        with pytest.raises(BadRequestError, match="use another name"):
            scene.add_avatar("al", points, radius)
    BODY_COPY = BODY.copy()
    scene.add_avatar("bo", BODY_COPY, 0.01)
    BODY_COPY[0] += 1.0
    with pytest.raises(BadRequestError, match="use another name"):
        scene.add_avatar("bo", BODY_COPY, 0.01)


def test_avatars_of_two_clients_do_not_meet(scene: Scene) -> None:
    scene.add_avatar("al", BODY, 0.01, client="one")
    scene.add_avatar("al", BODY + 3, 0.02, client="two")
    with pytest.raises(UnknownAvatarError):
        scene.collide("al", HERE)
    assert len(scene.collide("al", HERE, client="one")) == 1
    scene.drop_client("one")
    with pytest.raises(UnknownAvatarError):
        scene.collide("al", HERE, client="one")
    assert len(scene.collide("al", HERE, client="two")) == 1
    scene.add_avatar("al", BODY + 9, 0.01, client="one")


def test_one_of_many_that_add_the_same_name_wins(scene: Scene) -> None:
    def add(i: int) -> bool:
        try:
            scene.add_avatar("al", BODY + i % 2, 0.01)
        except BadRequestError:
            return False
        return True

    with ThreadPoolExecutor(8) as pool:
        added = list(pool.map(add, range(40)))
    assert added in ([True, False] * 20, [False, True] * 20)


def test_a_budget_too_small_for_a_voxel_is_refused_and_closes_the_files(tmp_path: Path) -> None:
    archive = archive_cases.build(tmp_path, synthetic_scans.make_scan("corner", 4, 300)).archive
    before = len(os.listdir("/proc/self/fd")) if Path("/proc/self/fd").is_dir() else 0
    with pytest.raises(BadRequestError, match="larger --cache"):
        Scene.open(archive, budget_bytes=100)
    if before:
        assert len(os.listdir("/proc/self/fd")) == before


def test_what_is_no_archive_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="no archive here"):
        Scene.open(tmp_path / "nowhere")


def test_a_scan_so_thin_that_its_radius_is_large_answers_every_way(tmp_path: Path) -> None:
    # Points 20 m apart: a mean radius of 10 m, more than a request may ask for, and yet the figure of the scene.
    case = archive_cases.build(
        tmp_path, np.array([[0.0, 0, 0], [20, 0, 0], [40, 0, 0]]), voxel=32.0, radius=None
    )
    poses = np.array([archive_cases.pose_of(np.eye(3), np.array([0.0, 0, z])) for z in (10.0, 10.5)])
    with Scene.open(case.archive) as scene:
        assert scene.info().radius == 10.0
        scene.add_avatar("al", np.zeros((1, 3)), 0.25)
        expected = scene.collide("al", poses).verdict.tolist()
        assert expected == [1, 0]
        assert scene.collide("al", poses, radius_model="mean").verdict.tolist() == expected
        assert [v for part in scene.path("al", poses) for v in part.verdict.tolist()] == expected
