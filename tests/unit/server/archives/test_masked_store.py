"""Points in boxes left out: answers are, bit for bit, those of an archive of the points that are left."""

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import archive_cases
import naive
import naive_distance
import numpy as np
import pytest
from masked_scans import BODY, DOOR, ROOM, STEP, build, in_boxes, open_without, two_scans
from numpy.typing import NDArray
from solidcloud.schemas.errors import BadRequestError, BadTransformError
from solidcloud.schemas.scene.effect_table import ThroughBox
from solidcloud.schemas.wire.arrays import array_fields
from solidcloud.server.archives.masked_store import MaskedStore
from solidcloud.server.scene import Scene


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The archive of all points."""
    return build(tmp_path_factory.mktemp("left_out") / "whole", two_scans())


@pytest.fixture(scope="module")
def rest(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The archive of the points that are in neither box."""
    parts = [part[~in_boxes(part, (DOOR, ROOM))] for part in two_scans()]
    return build(tmp_path_factory.mktemp("left_out") / "rest", parts)


# Bounds that enclose points that were left out are visited too.
COSTS = ("node_visits", "point_tests")


def assert_same_answers(found: Any, expected: Any) -> None:
    """Every column of the same bytes, but what the answer cost."""
    assert type(found) is type(expected)
    for name in array_fields(type(expected)):
        if name not in COSTS:
            assert getattr(found, name).tobytes() == getattr(expected, name).tobytes(), name
    assert found.faults == expected.faults


def poses_near(rng: np.random.Generator, count: int = 24) -> NDArray[np.float64]:
    """Poses around what is left out: most put a point of the body into a box."""
    inside = rng.uniform(DOOR.low, DOOR.high, (count, 3))
    poses = [archive_cases.pose_of(archive_cases.random_rotation(rng), at) for at in inside]
    return np.concatenate([poses, archive_cases.near_poses(rng, np.vstack(two_scans()), BODY, count, 0.04)])


def ask_all(scene: Scene, poses: NDArray[np.float64], model: str | None) -> Iterator[Any]:
    """The answers to every question."""
    scene.add_avatar("al", BODY, 0.02)
    ends = np.roll(poses, 1, axis=0)
    places, ways = poses[:, :3, 3].copy(), poses[:, :3, 0].copy()
    yield scene.collide("al", poses, 0.01, radius_model=model)
    yield scene.distance("al", poses, 0.3, radius_model=model)
    yield scene.contacts("al", poses, 20, 0.05, radius_model=model)
    yield scene.sweep("al", poses, ends, radius_model=model)
    yield scene.raycast(places, ways, 3.0, radius_model=model)
    yield scene.within(places, 0.5)
    scene.residency.check()


@pytest.mark.parametrize("model", [None, "local+border:0.3"])
def test_every_question_is_answered_as_by_an_archive_of_the_rest(
    whole: Path, rest: Path, model: str | None, rng: np.random.Generator
) -> None:
    poses = poses_near(rng)
    with open_without(whole, DOOR, ROOM) as scene, Scene.open(rest) as expected, Scene.open(whole) as before:
        answers = [list(ask_all(each, poses, model)) for each in (scene, expected, before)]
    # The bounds, by which a pose is outside, stay the archive's; both are the same here.
    for found, right in zip(answers[0], answers[1], strict=True):
        assert_same_answers(found, right)
    assert answers[0][2].pairs_found.sum() < answers[2][2].pairs_found.sum()


@pytest.mark.interpreted
def test_verdicts_and_distances_are_those_of_the_naive_judges(whole: Path, rng: np.random.Generator) -> None:
    points = np.vstack(two_scans())
    left = points[~in_boxes(points, (DOOR, ROOM))]
    poses = poses_near(rng)
    with open_without(whole, DOOR, ROOM) as scene:
        scene.add_avatar("al", BODY, 0.02)
        verdict = scene.collide("al", poses).verdict
        judged = naive.collide(left, scene.info().origin, STEP, 0.01, BODY, 0.02, poses)
        distance = scene.distance("al", poses, 0.1).signed_distance
        nearest = naive_distance.distance(left, scene.info().origin, STEP, 0.01, BODY, 0.02, poses, 0.1)
    assert verdict.tolist() == judged.astype(int).tolist()
    assert distance.tolist() == [np.inf if pair is None else pair.signed for pair in nearest]
    assert 0 < judged.sum() < len(judged)


def test_a_voxel_in_a_box_is_never_loaded_and_clear(whole: Path) -> None:
    with open_without(whole, ROOM) as scene, Scene.open(whole) as before:
        assert scene.info().voxels == before.info().voxels - 1
        assert scene.info().points == before.info().points
        pose = archive_cases.pose_of(np.eye(3), np.array([1.25, 1.25, 0.75]))[None]
        for each, verdict in ((scene, 0), (before, 1)):
            each.add_avatar("ball", [[0.0, 0, 0]], 0.2)
            assert each.collide("ball", pose).verdict.tolist() == [verdict]
        assert scene.collide("ball", pose).misses == 0
        scene.residency.check()


@pytest.mark.parametrize("leaf", [8, 32])
def test_a_voxel_that_is_loaded_and_left_empty_is_clear(leaf: int, tmp_path: Path) -> None:
    """Its tree has one node, or inner nodes too; a tolerance takes nodes for contact."""
    points = np.concatenate([np.full((1, 3), 3.25), np.random.default_rng(7).uniform(0.1, 0.2, (30, 3))])
    archive = archive_cases.build(tmp_path, points, voxel=0.5, radius=0.01, leaf=leaf, degree=2).archive
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, :3, 3] = [[0.15, 0.15, 0.15], [3.25, 3.25, 3.25]]
    with open_without(archive, ThroughBox("corner", (0.1, 0.1, 0.1), (0.2, 0.2, 0.2))) as scene:
        scene.add_avatar("ball", [[0.0, 0, 0], [0.02, 0.0, 0.0]], 0.02)
        for tolerance in (0.0, 0.5):
            answers = scene.collide("ball", poses, tolerance=tolerance)
            assert answers.verdict.tolist() == [0, 1] and answers.faults == ()
        assert scene.stats().resident == 2
        assert scene.distance("ball", poses, 1.0, tolerance=0.1).verdict.tolist() == [0, 1]
        assert scene.within(poses[:, :3, 3], 1.0).verdict.tolist() == [0, 1]
        ways = np.array([[0.0, 0.0, 1.0]] * 2)
        assert scene.raycast(poses[:, :3, 3] - [0.0, 0.0, 0.3], ways, 1.0).verdict.tolist() == [0, 1]
        assert scene.sweep("ball", poses[:1], poses[1:]).verdict.tolist() == [1]


def test_a_tile_shows_no_point_and_no_sphere_in_a_box(whole: Path) -> None:
    voxel = (0, 1, 1)
    with open_without(whole, DOOR) as scene, Scene.open(whole) as before:
        for detail, level in ((0, None), (0, 20)):
            shown, stored = (each.tile(0, voxel, detail, level) for each in (scene, before))
            places = stored.points * stored.step + stored.pose[0, :3, 3]
            radii = stored.spheres * stored.step if level else np.zeros(len(places))
            hidden = ((places - radii[:, None] > DOOR.low) & (places + radii[:, None] < DOOR.high)).all(
                axis=1
            )
            assert 0 < hidden.sum() < len(places)
            assert set(map(tuple, shown.points.tolist())).isdisjoint(
                map(tuple, stored.points[hidden].tolist())
            )
            assert 0 < len(shown.points) < len(stored.points)


def test_a_reload_keeps_the_boxes(whole: Path, rng: np.random.Generator) -> None:
    poses = poses_near(rng, 8)
    with open_without(whole, DOOR, ROOM) as scene:
        first = list(ask_all(scene, poses, None))
        assert scene.reload().generation_after == 0
        for again, before in zip(ask_all(scene, poses, None), first, strict=True):
            assert_same_answers(again, before)


def test_boxes_are_in_the_world_where_an_archive_lies_at_a_pose(
    whole: Path, rng: np.random.Generator
) -> None:
    pose = archive_cases.pose_of(archive_cases.random_rotation(rng), rng.uniform(-5, 5, 3))
    points = np.vstack(two_scans())
    # A box with two scan points on its border, to the last bit.
    world = np.array(
        [
            [((m[0] * x + m[1] * y) + m[2] * z) + m[3] for m in pose[:3].tolist()]
            for x, y, z in points.tolist()
        ]
    )
    corners = np.sort(world[[10, 11]], axis=0)
    box = ThroughBox("tilted", tuple(corners[0].tolist()), tuple(corners[1].tolist()))
    hidden = in_boxes(world, (box,))
    assert 2 <= hidden.sum() < len(points)
    with closing(MaskedStore(whole, [(box.low, box.high)], pose)) as store:
        assert np.array_equal(store.hides(points), hidden)
    with open_without(whole, box, pose=pose) as scene:
        found = scene.within(points, STEP / 4).distance
    left = set(map(tuple, points[~hidden].tolist()))
    assert (found == 0).tolist() == [tuple(point) in left for point in points.tolist()]


def test_boxes_that_hold_everything_are_refused(whole: Path) -> None:
    with pytest.raises(BadRequestError, match="contain all of its points: leave the archive out"):
        open_without(whole, ThroughBox("all", (0.0, 0.0, 0.0), (2.5, 2.5, 2.5)))


@pytest.mark.parametrize(
    ("pose", "said"),
    [
        (np.diag([2.0, 2, 2, 1]), "not rigid"),
        (np.diag([-1.0, 1, 1, 1]), "not rigid"),
        (np.eye(4) * np.nan, "finite"),
        (np.eye(3), r"shape \(3, 3\)"),
        (archive_cases.pose_of(np.eye(3), np.array([2e9, 0, 0])), "within 1e9 m"),
    ],
)
def test_a_pose_that_is_not_rigid_is_refused(whole: Path, pose: NDArray[np.float64], said: str) -> None:
    error = BadTransformError if said == "not rigid" else BadRequestError
    with pytest.raises(error, match=said):
        open_without(whole, DOOR, pose=pose)
