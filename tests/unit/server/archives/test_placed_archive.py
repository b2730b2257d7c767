"""Several archives as one scene: halves of a scan answer as the whole, one that lies elsewhere as the pose moved."""

from collections.abc import Iterator
from typing import Any

import naive
import numpy as np
import pytest
from solidcloud.schemas.wire.arrays import array_fields
from solidcloud.server.archives.rigid_transform import inverse_pose, transform_points, transform_poses
from solidcloud.server.scene import Scene
from split_scans import BODY, INTERPRETED, RADIUS, STEP, Built, exact_pose, near, several

# What answers say of the cost, and of bounds, which are each archive's own.
COSTS = ("node_visits", "point_tests", "voxels_missing", "outside", "steps")


CLUSTER_COLUMNS = (
    "cluster_count", "cluster_deepest", "cluster_avatar", "cluster_cloud", "cluster_scan", "cluster_low",
    "cluster_high",
)  # fmt: skip


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Built:
    return Built(tmp_path_factory.mktemp("several"))


@pytest.fixture
def both(built: Built) -> Iterator[Scene]:
    """Both halves where they were scanned."""
    with several((built.first, None), (built.second, np.eye(4))) as scene:
        yield scene


@pytest.fixture
def whole(built: Built) -> Iterator[Scene]:
    """The archive of both."""
    with Scene.open(built.whole, "hall") as scene:
        scene.add_avatar("al", BODY, RADIUS)
        yield scene


def assert_same(found: Any, expected: Any, but: tuple[str, ...] = COSTS) -> None:
    """Every column of the same bytes."""
    for name in array_fields(type(expected)):
        if name not in but:
            assert getattr(found, name).tobytes() == getattr(expected, name).tobytes(), name


@pytest.mark.parametrize("model", [None, "fixed:0.015", "mean:0.5"])
def test_halves_answer_as_the_whole(
    both: Scene, whole: Scene, built: Built, rng: np.random.Generator, model: str | None
) -> None:
    poses = near(rng, np.vstack(built.points))
    places, ways = poses[:, :3, 3].copy(), poses[:, :3, 0].copy()
    verdicts = whole.collide("al", poses, 0.01, radius_model=model).verdict
    assert 0 < verdicts.sum() < len(verdicts)
    found = both.collide("al", poses, 0.01, radius_model=model)
    assert found.verdict.tolist() == verdicts.tolist()
    assert len(found.exact) == 0
    assert_same(
        both.distance("al", poses, 0.25, radius_model=model),
        whole.distance("al", poses, 0.25, radius_model=model),
    )
    assert_same(
        both.raycast(places, ways, 2.5, radius_model=model),
        whole.raycast(places, ways, 2.5, radius_model=model),
    )
    assert_same(both.within(places, 0.25), whole.within(places, 0.25))
    clusters = ("cluster", "cluster_starts", "scan_index", *CLUSTER_COLUMNS)
    one = whole.contacts("al", poses, 3, 0.05, radius_model=model)
    assert_same(both.contacts("al", poses, 3, 0.05, radius_model=model), one, COSTS + clusters)
    assert one.pairs_found.max() > 3
    for part in both.archives:
        part.residency.check()


def test_clusters_are_those_of_each_archive_deepest_first(
    both: Scene, built: Built, rng: np.random.Generator
) -> None:
    poses = near(rng, np.vstack(built.points), 20)
    found = both.contacts("al", poses, 1000, 0.05, 0.01)
    alone = []
    for path in (built.first, built.second):
        with several((path, None)) as half:
            alone.append(half.contacts("al", poses, 1000, 0.05, 0.01))
    assert found.pairs_found.tolist() == (alone[0].pairs_found + alone[1].pairs_found).tolist()
    for i in range(len(poses)):
        own = slice(found.cluster_starts[i], found.cluster_starts[i + 1])
        deepest = found.cluster_deepest[own].tolist()
        assert deepest == sorted(deepest)
        expected = [
            (float(a.cluster_deepest[j]), *a.cluster_cloud[j].tolist(), int(a.cluster_count[j]))
            for a in alone
            for j in range(a.cluster_starts[i], a.cluster_starts[i + 1])
        ]
        listed = zip(
            deepest, found.cluster_cloud[own].tolist(), found.cluster_count[own].tolist(), strict=True
        )
        assert sorted((d, *cloud, count) for d, cloud, count in listed) == sorted(expected)
        # Every pair names the cluster that it is in: as many pairs, and the deepest of them.
        pairs = slice(found.pair_starts[i], found.pair_starts[i + 1])
        for number, (depth, count) in enumerate(zip(deepest, found.cluster_count[own].tolist(), strict=True)):
            mine = found.cluster[pairs] == number
            assert mine.sum() == count
            assert found.signed_distance[pairs][mine].min() == depth
            # Sources stand one archive's behind the other's; each half is one scan.
            scan = int(found.cluster_scan[own][number])
            assert set(found.scan_index[pairs][mine].tolist()) == {scan}
            assert found.cluster_cloud[own][number].tolist() in built.points[scan].tolist()


def test_a_sweep_ends_at_the_earliest_contact(
    both: Scene, whole: Scene, built: Built, rng: np.random.Generator
) -> None:
    poses = near(rng, np.vstack(built.points))
    poses[:2, 2, 3] += [5.0, 6.0]  # a motion between these two meets nothing
    ends = np.roll(poses, 1, axis=0)
    found, expected = both.sweep("al", poses, ends), whole.sweep("al", poses, ends)
    assert found.verdict.tolist() == expected.verdict.tolist()
    assert 0 < (found.verdict == 1).sum() < len(poses)
    # Each interval holds the first contact.
    assert (found.lower <= expected.upper).all()
    assert (expected.lower <= np.minimum(found.upper, 1.0)).all()
    assert found.exact.tolist() == expected.exact.tolist()
    touches = found.verdict == 1
    apart = np.linalg.norm(found.witness_avatar - found.witness_cloud, axis=1)[touches]
    assert np.abs(apart - (RADIUS + 0.01)).max() < 0.2 and (apart <= RADIUS + 0.01 + 1e-7).all()


@pytest.mark.interpreted
def test_an_archive_moved_exactly_answers_as_the_pose_moved(built: Built, rng: np.random.Generator) -> None:
    for _ in range(1 if INTERPRETED else 3):
        pose = exact_pose(rng)
        poses = near(rng, built.points[0], 10 if INTERPRETED else 20)
        carried = pose @ poses  # signed permutations and lattice shifts: exact
        assert transform_poses(inverse_pose(pose), carried).tobytes() == poses.tobytes()
        places, ways = poses[:, :3, 3].copy(), poses[:, :3, 0].copy()
        out_places, out_ways = carried[:, :3, 3].copy(), carried[:, :3, 0].copy()
        with several((built.first, pose)) as scene, Scene.open(built.first) as plain:
            plain.add_avatar("al", BODY, RADIUS)
            pairs = [
                (scene.collide("al", carried), plain.collide("al", poses)),
                (scene.distance("al", carried, 0.3), plain.distance("al", poses, 0.3)),
                (scene.contacts("al", carried, 9, 0.03), plain.contacts("al", poses, 9, 0.03)),
                (scene.sweep("al", carried, np.roll(carried, 1, axis=0)),
                 plain.sweep("al", poses, np.roll(poses, 1, axis=0))),
                (scene.within(out_places, 0.3), plain.within(places, 0.3)),
            ]  # fmt: skip
            for found, expected in pairs:
                world = {
                    name: transform_points(pose, getattr(expected, name))
                    for name in ("witness_avatar", "witness_cloud", "avatar_point", "cloud_point")
                    if hasattr(expected, name)
                }
                for name in array_fields(type(expected)):
                    right = world.get(name, getattr(expected, name))
                    if name == "normal":
                        right = expected.normal @ pose[:3, :3].T
                    if name.startswith("cluster_") and name[8:] in ("avatar", "cloud", "low", "high"):
                        continue
                    np.testing.assert_array_equal(getattr(found, name), right, err_msg=name)
            hits = scene.raycast(out_places, out_ways, 2.0), plain.raycast(places, ways, 2.0)
            assert hits[0].verdict.tolist() == hits[1].verdict.tolist()
            np.testing.assert_allclose(hits[0].distance, hits[1].distance, atol=1e-12)
            np.testing.assert_array_equal(hits[0].cloud_point, transform_points(pose, hits[1].cloud_point))


@pytest.mark.interpreted
def test_verdicts_are_those_of_the_naive_judge_of_both(built: Built, rng: np.random.Generator) -> None:
    pose = exact_pose(rng)
    seen = np.vstack([built.points[0], transform_points(pose, built.points[1])])
    poses = near(rng, seen)
    with several((built.first, None), (built.second, pose)) as scene:
        verdict = scene.collide("al", poses).verdict
        origins = [part.info().origin for part in scene.archives]
    own = [poses, np.linalg.inv(pose) @ poses]
    judged = np.zeros(len(poses), bool)
    for points, origin, asked in zip(built.points, origins, own, strict=True):
        judged |= naive.collide(points, origin, STEP, 0.01, BODY, RADIUS, asked)
    assert verdict.tolist() == judged.astype(int).tolist()
    assert 0 < judged.sum() < len(judged)


def test_objects_meet_every_archive_and_one_another_once(
    both: Scene, whole: Scene, built: Built, rng: np.random.Generator
) -> None:
    poses = near(rng, np.vstack(built.points), 30)
    items = [("al", pose, 1 << (i % 3), 0xFFFFFFFF if i % 5 else 3) for i, pose in enumerate(poses)]
    found, expected = both.objects(items, 0.01), whole.objects(items, 0.01)
    assert_same(found, expected)
    assert len(found.pairs) > 0 and (found.pairs_tested, found.pair_tests) == (
        expected.pairs_tested,
        expected.pair_tests,
    )
    assert both.objects([]).verdict.tolist() == []
