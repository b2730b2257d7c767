"""Several archives served as one scene: paths, deadlines, what cannot be read, reloads, what is refused."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import archive_cases
import numpy as np
import pytest
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.errors import BadRequestError, BadTransformError, FormatError, UnknownAvatarError
from solidcloud.schemas.wire.key_expressions import public_id
from solidcloud.server.archives.rigid_transform import (
    transform_points,
)
from solidcloud.server.scene import Scene
from solidcloud.server.zenoh_server.request_dispatcher import RequestDispatcher
from solidcloud.server.zenoh_server.server_config import ServerConfig
from split_scans import BODY, COUNT, OPTIONS, RADIUS, STEP, Built, exact_pose, near, several


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Built:
    return Built(tmp_path_factory.mktemp("several"))


@pytest.fixture
def both(built: Built) -> Iterator[Scene]:
    """Both halves where they were scanned."""
    with several((built.first, None), (built.second, np.eye(4))) as scene:
        yield scene


def test_time_that_is_up_says_nothing_wrong(both: Scene, built: Built, rng: np.random.Generator) -> None:
    poses = near(rng, np.vstack(built.points), 10)
    exact = both.collide("al", poses)
    late = both.collide("al", poses, budget_ms=0.0).verdict
    known = late != 2  # by the level of detail
    assert (late[known] == exact.verdict[known]).all()
    found = both.collide("al", poses, budget_ms=60_000.0)
    assert found.verdict.tolist() == exact.verdict.tolist()
    assert set(both.sweep("al", poses, np.roll(poses, 1, axis=0), budget_ms=0.0).verdict.tolist()) <= {1, 2}


@pytest.mark.parametrize(
    ("op", "parameters"),
    [
        ("collide", {"margin": 0.01}),
        ("distance", {"reach": 0.2}),
        ("contacts", {"limit": 1, "margin": 0.05}),
        ("sweep", {}),
        ("collide", {"tolerance": 1e-4}),
        ("distance", {"reach": 0.2, "budget_ms": 60_000.0}),
    ],
)
def test_a_path_answers_as_its_question(
    built: Built, rng: np.random.Generator, op: str, parameters: dict[str, Any]
) -> None:
    pose = exact_pose(rng)
    poses = near(
        rng, np.vstack([built.points[0], transform_points(pose, built.points[1])]), 90 if COUNT > 20 else 8
    )
    with several((built.first, None), (built.second, pose)) as scene:
        what = [poses[:-1], poses[1:]] if op == "sweep" else [poses]
        expected = getattr(scene, op)("al", *what, **parameters)
        for threads in (1, 2):
            parts = list(scene.path("al", poses, op, threads=threads, **parameters))
            assert [part.first for part in parts] == np.cumsum([0, *(len(p) for p in parts)])[:-1].tolist()
            assert {part.total for part in parts} == {len(expected)}
            found = np.concatenate([part.verdict for part in parts])
            assert found.tolist() == expected.verdict.tolist()
            if op == "contacts":
                counts = np.concatenate([np.diff(part.pair_starts) for part in parts])
                assert counts.tolist() == np.diff(expected.pair_starts).tolist()
                assert counts.max() == 1 < expected.pairs_found.max()
            if op == "sweep":
                assert np.concatenate([part.upper for part in parts]).tobytes() == expected.upper.tobytes()
        taken = scene.path("al", poses, op, threads=2, **parameters)
        next(taken)
        taken.close()
        assert scene.collide("al", poses[:1]).verdict[0] in (0, 1)
    with pytest.raises(BadRequestError, match="closed"):
        scene.path("al", poses, op, **parameters)


def test_what_cannot_be_read_of_one_archive_is_unknown_unless_another_touches(
    tmp_path: Path, built: Built
) -> None:
    own = archive_cases.build(tmp_path, built.points[1], **OPTIONS).archive
    with Archive(own) as archive:
        for row in range(len(archive.voxels)):
            entry = archive.voxels[row]
            with open(archive.shard_path(int(entry["shard"])), "r+b") as file:
                offset = int(entry["frame_offset"][2]) + int(entry["frame_bytes"][2]) // 2
                byte = os.pread(file.fileno(), 1, offset)[0]
                os.pwrite(file.fileno(), bytes([byte ^ 0x10]), offset)
    at = archive_cases.pose_of(np.eye(3), built.points[0][5] - BODY[0])[None]
    beside = archive_cases.pose_of(np.eye(3), built.points[1][5] + [0.0, 0.0, 40 * STEP])[None]
    with several((built.first, None), (own, None)) as scene:
        assert scene.collide("al", at).verdict.tolist() == [1]
        found = scene.collide("al", beside)
        with several((built.first, None)) as first:
            alone = first.collide("al", beside).verdict[0]
        assert found.verdict.tolist() == [2 if alone == 0 else 1]
        assert len(found.faults) > 0 and str(own) in found.faults[0]
        far = archive_cases.pose_of(np.eye(3), np.array([0.0, 0.0, 50.0]))[None]
        assert scene.collide("al", far).verdict.tolist() == [0]
        assert scene.collide("al", far).outside.tolist() == [True]


def test_info_stats_and_reload_speak_of_all_archives(built: Built, rng: np.random.Generator) -> None:
    pose = exact_pose(rng)
    with several((built.first, None), (built.second, pose)) as scene:
        info, each = scene.info(), [part.info() for part in scene.archives]
        assert info.scene == "hall"
        for name in ("points", "voxels", "record_bytes", "resident_bytes"):
            assert getattr(info, name) == sum(getattr(part, name) for part in each)
        assert [s.path for s in info.sources] == [s.path for part in each for s in part.sources]
        np.testing.assert_array_equal(info.sources[1].pose, pose @ np.array(each[1].sources[0].pose))
        clouds = np.vstack([built.points[0], transform_points(pose, built.points[1])])
        np.testing.assert_array_equal(info.bounds, [clouds.min(axis=0), clouds.max(axis=0)])
        poses = near(rng, clouds, 10)
        scene.add_avatar("al", BODY, RADIUS, client="me")
        scene.collide("al", poses, client="me")
        scene.collide("al", poses, client="me")
        stats = scene.stats(keys=True)
        assert (stats.scene, stats.requests, stats.answers) == ("hall", 2, 20)
        assert stats.voxels == info.voxels and stats.misses == stats.resident == len(stats.keys) > 2
        assert stats.load_seconds.count == stats.resident and stats.load_seconds.p50 > 0
        assert sum(stats.load_seconds.buckets) == stats.resident
        assert [(user.client, user.avatar, user.requests) for user in stats.users] == [
            (public_id("me"), "al", 2)
        ]
        answer = scene.reload()
        assert (answer.scene, answer.generation_after, answer.points) == ("hall", 0, info.points)
        assert scene.collide("al", poses).verdict.tolist() == scene.collide("al", poses).verdict.tolist()
        assert scene.avatar("al", "").radius == RADIUS
        scene.add_avatar("bo", BODY, 0.1, client="me")
        scene.drop_client("me")
        with pytest.raises(UnknownAvatarError):
            scene.collide("bo", poses, client="me")
        service = RequestDispatcher([scene], ServerConfig())
        assert service.scenes(None).ok


def test_a_reload_that_fails_says_which_archives_are_new(
    both: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = both.archives
    before = [scene._opened for scene in (first, second)]

    def gone(_: Any) -> Any:
        raise FormatError("hall: no archive here")

    monkeypatch.setattr(second, "_open_store", gone)
    said = "^archive 1: hall: no archive here: of 2 archives the first 1 are reloaded$"
    with pytest.raises(FormatError, match=said):
        both.reload()
    assert [scene._opened is was for scene, was in zip((first, second), before, strict=True)] == [False, True]
    monkeypatch.setattr(first, "_open_store", gone)
    with pytest.raises(FormatError, match=r"^archive 0: hall: no archive here$"):
        both.reload()
    assert len(both.collide("al", np.eye(4)[None])) == 1


def test_what_is_refused_says_why(built: Built, both: Scene) -> None:
    here = np.eye(4)[None]
    with pytest.raises(BadRequestError, match="this archive stores mean"):
        both.collide("al", here, radius_model="local")
    with pytest.raises(BadRequestError, match="1 poses to begin at and 2 to end at"):
        both.sweep("al", here, np.repeat(here, 2, axis=0))
    with pytest.raises(BadRequestError, match="2 origins and 1 directions"):
        both.raycast(np.zeros((2, 3)), np.ones((1, 3)), 1.0)
    with pytest.raises(BadTransformError, match="pose 1 mirrors"):
        both.collide("al", np.array([np.eye(4), np.diag([-1.0, 1, 1, 1])]))
    with pytest.raises(BadRequestError, match="direction 0 is zero"):
        both.raycast(np.zeros((1, 3)), np.zeros((1, 3)), 1.0)
    with pytest.raises(UnknownAvatarError, match="add it"):
        both.path("nobody", here)
    with pytest.raises(BadTransformError, match="pose of the archive: not rigid"):
        several((built.first, np.diag([2.0, 2, 2, 1])))
    with pytest.raises(BadRequestError, match="without archives"):
        Scene([], "hall")
