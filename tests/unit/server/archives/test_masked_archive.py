"""Points in boxes left out: what is served is, bit for bit, an archive of the points that are left."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import archive_cases
import naive
import naive_distance
import numpy as np
import pytest
from masked_scans import BODY, DOOR, ROOM, STEP, build, in_boxes, open_without, two_scans
from msgspec.structs import asdict
from numpy.typing import NDArray
from solidcloud.builder.voxel.record_points import voxel_points
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.scene.effect_table import ThroughBox
from solidcloud.schemas.wire.arrays import array_fields
from solidcloud.server.archives.masked_archive import MaskedArchive
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


def assert_same_answers(found: Any, expected: Any, but: tuple[str, ...] = ()) -> None:
    """Every column of the same bytes, costs included."""
    assert type(found) is type(expected)
    for name in array_fields(type(expected)):
        if name not in but:
            assert getattr(found, name).tobytes() == getattr(expected, name).tobytes(), name
    assert asdict(found)["faults"] == asdict(expected)["faults"]


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
    yield scene.collide("al", poses, 0.01, tolerance=1e-3, radius_model=model)
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


def test_a_voxel_left_empty_is_gone_and_clear(whole: Path) -> None:
    with open_without(whole, ROOM) as scene, Scene.open(whole) as before:
        assert scene.info().voxels == before.info().voxels - 1
        assert scene.info().points == before.info().points
        pose = archive_cases.pose_of(np.eye(3), np.array([1.25, 1.25, 0.75]))[None]
        for each, verdict in ((scene, 0), (before, 1)):
            each.add_avatar("ball", [[0.0, 0, 0]], 0.2)
            assert each.collide("ball", pose).verdict.tolist() == [verdict]
        assert scene.collide("ball", pose).misses == 0
        scene.residency.check()


@pytest.mark.interpreted
def test_scan_intensity_and_class_of_the_points_that_stay_are_what_they_were(whole: Path) -> None:
    def stored(archive: Archive) -> list[tuple[Any, ...]]:
        found = []
        for row in range(len(archive.voxels)):
            voxel, links = archive.read_voxel(row)
            base = archive.coordinates[row] * archive.header.lattice.voxel_steps
            world = archive.header.lattice.to_world(voxel_points(voxel, links) + base)
            columns = (voxel.scan_index, voxel.intensity, voxel.radius_class)
            found += zip(map(tuple, world.tolist()), *(c.tolist() for c in columns), strict=True)
        return sorted(found)

    with MaskedArchive(whole, [(DOOR.low, DOOR.high)]) as archive, Archive(whole) as before:
        found, everything = stored(archive), stored(before)
    held = in_boxes(np.array([point[0] for point in everything]), (DOOR,))
    assert found == [point for point, left_out in zip(everything, held, strict=True) if not left_out]
    numbered = {(tuple(xyz), number) for number, part in enumerate(two_scans()) for xyz in part.tolist()}
    assert {point[:2] for point in everything} == numbered


def test_a_reload_keeps_the_boxes(whole: Path, rng: np.random.Generator) -> None:
    poses = poses_near(rng, 8)
    with open_without(whole, DOOR, ROOM) as scene:
        first = list(ask_all(scene, poses, None))
        assert scene.reload().generation_after == 0
        for again, before in zip(ask_all(scene, poses, None), first, strict=True):
            assert_same_answers(again, before)


@pytest.mark.interpreted
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
    expected = points[~in_boxes(world, (box,))]
    assert len(points) - 2 >= len(expected) > 0
    with MaskedArchive(whole, [(box.low, box.high)], pose) as archive:
        found = []
        for row in range(len(archive.voxels)):
            base = archive.coordinates[row] * archive.header.lattice.voxel_steps
            found.append(archive.header.lattice.to_world(voxel_points(*archive.read_voxel(row)) + base))
    assert sorted(np.concatenate(found).tolist()) == sorted(expected.tolist())
