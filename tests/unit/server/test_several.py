"""Several archives as one scene: halves of a scan answer as the whole, one that lies elsewhere as the pose moved."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cases
import naive
import numpy as np
import pytest
import scans
from clouds import signed_permutations
from msgspec import structs
from numpy.typing import NDArray
from solidcloud.schemas.archive import Archive
from solidcloud.schemas.arrays import array_fields
from solidcloud.schemas.errors import BadRequestError, BadTransformError, FormatError, UnknownAvatarError
from solidcloud.server.app import Service
from solidcloud.server.config import ServerConfig
from solidcloud.server.posed import archive_pose, inverse_of, moved, under
from solidcloud.server.scene import Scene
from solidcloud.server.several import SeveralScenes

STEP = cases.BINARY_STEP
BODY = np.array([[0.0, 0, 0], [0.125, 0, 0], [0.0, 0.25, 0], [0.0625, 0.0625, 0.125]])
RADIUS = 0.02
OPTIONS: dict[str, Any] = {
    "resolution": STEP, "leaf": 8, "degree": 3, "cell_points": 24, "keep": frozenset({"scan"}),
}  # fmt: skip
# What answers say of the cost, and of bounds, which are each archive's own.
COSTS = ("node_visits", "point_tests", "voxels_missing", "outside", "steps")
CLUSTER_COLUMNS = (
    "cluster_count", "cluster_deepest", "cluster_avatar", "cluster_cloud", "cluster_scan", "cluster_low",
    "cluster_high",
)  # fmt: skip
COUNT = 12 if os.environ.get("NUMBA_DISABLE_JIT") == "1" else 60


def halves() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Two scans on one lattice with points of each beside those of the other, and no point in both."""
    points = np.rint(np.vstack([scans.make_scan("corner", 8, 300), scans.make_scan("noise", 9, 300)]) / STEP)
    points = np.unique(np.maximum(points, 1.0), axis=0) * STEP
    points = points[np.random.default_rng(3).permutation(len(points))]
    # The least coordinates of both are 0, so that both lattices begin there.
    first = np.vstack([[[0.0, 0, 0]], points[::2]])
    second = np.vstack([[[0.0, 1, 1], [1, 0.0, 1], [1, 1, 0.0]], points[1::2]])
    return first, second


class Built:
    """Archives of the halves, and of both; each its own scan."""

    def __init__(self, folder: Path) -> None:
        self.points = halves()
        self.first, self.second = (cases.build(folder, part, **OPTIONS).archive for part in self.points)
        self.whole = cases.build(folder, np.vstack(self.points), **OPTIONS).archive


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Built:
    return Built(tmp_path_factory.mktemp("several"))


@pytest.fixture
def both(built: Built) -> Iterator[SeveralScenes]:
    """Both halves where they were scanned."""
    with several((built.first, None), (built.second, np.eye(4))) as scene:
        yield scene


@pytest.fixture
def whole(built: Built) -> Iterator[Scene]:
    """The archive of both."""
    with Scene.open(built.whole, "hall") as scene:
        scene.add_avatar("al", BODY, RADIUS)
        yield scene


def several(*archives: tuple[Path, Any], **options: Any) -> SeveralScenes:
    """A scene of archives at poses, with an avatar."""
    scene = SeveralScenes([(Scene.open(path, "part", **options), pose) for path, pose in archives], "hall")
    scene.add_avatar("al", BODY, RADIUS)
    return scene


def near(rng: np.random.Generator, points: NDArray[np.float64], count: int = COUNT) -> NDArray[np.float64]:
    """Poses of any turn, translations on a lattice, some of which touch."""
    poses = cases.near_poses(rng, points, BODY, count, 0.09)
    poses[:, :3, 3] = np.rint(poses[:, :3, 3] / STEP) * STEP
    return poses


def exact_pose(rng: np.random.Generator) -> NDArray[np.float64]:
    """A pose that float64 inverts exactly: a turn by right angles, a shift by lattice steps."""
    turns = signed_permutations()
    return cases.pose_of(turns[rng.integers(len(turns))], np.rint(rng.uniform(-9, 9, 3) / STEP) * STEP)


def assert_same(found: Any, expected: Any, but: tuple[str, ...] = COSTS) -> None:
    """Every column of the same bytes."""
    for name in array_fields(type(expected)):
        if name not in but:
            assert getattr(found, name).tobytes() == getattr(expected, name).tobytes(), name


@pytest.mark.parametrize("model", [None, "fixed:0.015", "mean:0.5"])
def test_halves_answer_as_the_whole(
    both: SeveralScenes, whole: Scene, built: Built, rng: np.random.Generator, model: str | None
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
        part[0].residency.check()


def test_clusters_are_those_of_each_archive_deepest_first(
    both: SeveralScenes, built: Built, rng: np.random.Generator
) -> None:
    poses = near(rng, np.vstack(built.points), 20)
    found = both.contacts("al", poses, 1000, 0.05, 0.01)
    alone = [scene.contacts("al", poses, 1000, 0.05, 0.01) for scene, _ in both.archives[:1]]
    both.archives[1][0].add_avatar("al", BODY, RADIUS)
    alone.append(both.archives[1][0].contacts("al", poses, 1000, 0.05, 0.01))
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
    both: SeveralScenes, whole: Scene, built: Built, rng: np.random.Generator
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
    for _ in range(3):
        pose = exact_pose(rng)
        poses = near(rng, built.points[0], 20)
        carried = pose @ poses  # signed permutations and lattice shifts: exact
        assert under(inverse_of(pose), carried).tobytes() == poses.tobytes()
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
                    name: moved(pose, getattr(expected, name))
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
            np.testing.assert_array_equal(hits[0].cloud_point, moved(pose, hits[1].cloud_point))


@pytest.mark.interpreted
def test_verdicts_are_those_of_the_naive_judge_of_both(built: Built, rng: np.random.Generator) -> None:
    pose = exact_pose(rng)
    seen = np.vstack([built.points[0], moved(pose, built.points[1])])
    poses = near(rng, seen)
    with several((built.first, None), (built.second, pose)) as scene:
        verdict = scene.collide("al", poses).verdict
        origins = [part.info().origin for part, _ in scene.archives]
    own = [poses, np.linalg.inv(pose) @ poses]
    judged = np.zeros(len(poses), bool)
    for points, origin, asked in zip(built.points, origins, own, strict=True):
        judged |= naive.collide(points, origin, STEP, 0.01, BODY, RADIUS, asked)
    assert verdict.tolist() == judged.astype(int).tolist()
    assert 0 < judged.sum() < len(judged)


def test_any_rigid_pose_is_within_a_micrometre(built: Built, rng: np.random.Generator) -> None:
    at = [cases.pose_of(cases.random_rotation(rng), rng.uniform(-3, 3, 3)) for _ in range(2)]
    with several((built.first, at[0]), (built.second, at[1])) as scene:
        clouds = [points @ m[:3, :3].T + m[:3, 3] for points, m in zip(built.points, at, strict=True)]
        cloud = np.vstack(clouds)
        poses = cases.near_poses(rng, cloud, BODY, COUNT, 0.1)
        found = scene.distance("al", poses, 0.5)
        for i, pose in enumerate(poses):
            body = BODY @ pose[:3, :3].T + pose[:3, 3]
            apart = np.linalg.norm(body[:, None] - cloud, axis=2)
            assert abs(found.signed_distance[i] - (apart.min() - RADIUS - 0.01)) < 1e-6
            between = np.linalg.norm(found.witness_avatar[i] - found.witness_cloud[i])
            assert abs(between - apart.min()) < 1e-6
            assert np.linalg.norm(cloud - found.witness_cloud[i], axis=1).min() < 1e-6
            out = (found.witness_avatar[i] - found.witness_cloud[i]) / between
            assert np.abs(found.normal[i] - out).max() < 1e-6
        places, ways = poses[:, :3, 3].copy(), poses[:, :3, 0].copy()
        near_point = np.linalg.norm(places[:, None] - cloud, axis=2).min(axis=1)
        within = scene.within(places, 4.0)
        assert np.abs(within.distance - near_point).max() < 1e-6
        hits = scene.raycast(places, 5.0 * ways, 4.0)
        touched = hits.verdict == 1
        assert touched.sum() > 0
        assert (
            np.abs(
                np.linalg.norm(hits.hit - hits.cloud_point, axis=1)[touched & (hits.distance > 0)] - 0.01
            ).max()
            < 1e-6
        )
        assert np.abs(np.linalg.norm(hits.hit - places, axis=1) - hits.distance)[touched].max() < 1e-6
        low, high = np.array(scene.info().bounds)
        assert (cloud >= low - 1e-9).all() and (cloud <= high + 1e-9).all()


def test_a_budget_of_visits_is_for_all_archives_together(
    both: SeveralScenes, whole: Scene, built: Built, rng: np.random.Generator
) -> None:
    poses = near(rng, np.vstack(built.points), 30)
    truth = whole.collide("al", poses).verdict
    clear = np.zeros(len(poses), bool)
    for budget in (0, 20, 100, 400, 1 << 40):
        found = both.collide("al", poses, budget_visits=budget, tolerance=1e-4)
        assert (found.node_visits <= budget + 8).all()
        assert (truth[found.verdict == 0] == 0).all(), "never clear by mistake"
        assert (found.verdict[clear] == 0).all(), "what was clear stays clear"
        clear = found.verdict == 0
        assert (found.lower <= found.upper).all()
        distance = both.distance("al", poses, 0.2, budget_visits=budget)
        true = whole.distance("al", poses, 0.2)
        assert (distance.lower <= np.minimum(true.signed_distance, 0.2) + 1e-12).all()
        assert (distance.upper >= true.signed_distance - 1e-12)[np.isfinite(true.signed_distance)].all()
        same = distance.signed_distance == true.signed_distance
        assert same[distance.exact].all()
    assert found.verdict.tolist() == truth.tolist() and found.exact.all() and distance.exact.all()


def test_time_that_is_up_leaves_nothing_clear(
    both: SeveralScenes, built: Built, rng: np.random.Generator
) -> None:
    poses = near(rng, np.vstack(built.points), 10)
    exact = both.collide("al", poses)
    assert both.collide("al", poses, budget_ms=0.0).verdict.tolist() == [2] * 10
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
        ("collide", {"budget_visits": 60, "tolerance": 1e-4}),
        ("sweep", {"budget_visits": 100_000}),
        ("distance", {"reach": 0.2, "budget_visits": 40, "budget_ms": 60_000.0}),
    ],
)
def test_a_path_answers_as_its_question(
    built: Built, rng: np.random.Generator, op: str, parameters: dict[str, Any]
) -> None:
    pose = exact_pose(rng)
    poses = near(rng, np.vstack([built.points[0], moved(pose, built.points[1])]), 90 if COUNT > 20 else 8)
    with several((built.first, None), (built.second, pose)) as scene:
        # With a deadline a question is looked at in slices, so what a budget of visits leaves may differ: not the bits.
        options = {name: value for name, value in parameters.items() if name != "budget_ms"}
        what = [poses[:-1], poses[1:]] if op == "sweep" else [poses]
        expected = getattr(scene, op)("al", *what, **options)
        for threads in (1, 2):
            parts = list(scene.path("al", poses, op, threads=threads, **parameters))
            assert [part.first for part in parts] == np.cumsum([0, *(len(p) for p in parts)])[:-1].tolist()
            assert {part.total for part in parts} == {len(expected)}
            found = np.concatenate([part.verdict for part in parts])
            if "budget_ms" not in parameters:
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


def test_objects_meet_every_archive_and_one_another_once(
    both: SeveralScenes, whole: Scene, built: Built, rng: np.random.Generator
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


def test_what_cannot_be_read_of_one_archive_is_unknown_unless_another_touches(
    tmp_path: Path, built: Built
) -> None:
    own = cases.build(tmp_path, built.points[1], **OPTIONS).archive
    with Archive(own) as archive:
        for row in range(len(archive.voxels)):
            entry = archive.voxels[row]
            with open(archive.shard_path(int(entry["shard"])), "r+b") as file:
                offset = int(entry["frame_offset"][2]) + int(entry["frame_bytes"][2]) // 2
                byte = os.pread(file.fileno(), 1, offset)[0]
                os.pwrite(file.fileno(), bytes([byte ^ 0x10]), offset)
    at = cases.pose_of(np.eye(3), built.points[0][5] - BODY[0])[None]
    beside = cases.pose_of(np.eye(3), built.points[1][5] + [0.0, 0.0, 40 * STEP])[None]
    with several((built.first, None), (own, None)) as scene:
        assert scene.collide("al", at).verdict.tolist() == [1]
        found = scene.collide("al", beside)
        assert found.verdict.tolist() == [2 if scene._first.collide("al", beside).verdict[0] == 0 else 1]
        assert len(found.faults) > 0 and str(own) in found.faults[0]
        far = cases.pose_of(np.eye(3), np.array([0.0, 0.0, 50.0]))[None]
        assert scene.collide("al", far).verdict.tolist() == [0]
        assert scene.collide("al", far).outside.tolist() == [True]


def test_info_stats_and_reload_speak_of_all_archives(built: Built, rng: np.random.Generator) -> None:
    pose = exact_pose(rng)
    with several((built.first, None), (built.second, pose)) as scene:
        info, each = scene.info(), [part.info() for part, _ in scene.archives]
        assert info.scene == "hall"
        for name in ("points", "voxels", "record_bytes", "resident_bytes"):
            assert getattr(info, name) == sum(getattr(part, name) for part in each)
        assert [s.path for s in info.sources] == [s.path for part in each for s in part.sources]
        np.testing.assert_array_equal(info.sources[1].pose, pose @ np.array(each[1].sources[0].pose))
        clouds = np.vstack([built.points[0], moved(pose, built.points[1])])
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
        assert [(user.client, user.avatar, user.requests) for user in stats.users] == [("me", "al", 2)]
        answer = scene.reload()
        assert (answer.scene, answer.generation_after, answer.points) == ("hall", 0, info.points)
        assert scene.collide("al", poses).verdict.tolist() == scene.collide("al", poses).verdict.tolist()
        assert scene.avatar("al", "").radius == RADIUS
        scene.add_avatar("bo", BODY, 0.1, client="me")
        scene.drop_client("me")
        with pytest.raises(UnknownAvatarError):
            scene.collide("bo", poses, client="me")
        scene.warm()
        service = Service([scene], ServerConfig())
        assert service.scenes(None).ok


def test_scans_are_numbered_by_the_archives_that_are_asked(
    built: Built, both: SeveralScenes, monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator
) -> None:
    """And not by those that a reload puts there meanwhile, of which `info` speaks already."""
    first, second = (scene for scene, _ in both.archives)
    monkeypatch.setattr(first, "_info", structs.replace(first.info(), sources=first.info().sources * 3))
    poses = near(rng, built.points[1], 20)
    found, own = both.contacts("al", poses), first.contacts("al", poses)
    assert found.pairs_found.sum() > own.pairs_found.sum()
    assert set(found.scan_index.tolist()) <= {0, 1} and 1 in found.scan_index
    parts = list(both.path("al", poses, "contacts"))
    assert np.concatenate([part.scan_index for part in parts]).tobytes() == found.scan_index.tobytes()
    assert second.info().sources


def test_a_reload_that_fails_says_which_archives_are_new(
    both: SeveralScenes, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = (scene for scene, _ in both.archives)
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


def test_what_is_refused_says_why(built: Built, both: SeveralScenes) -> None:
    here = np.eye(4)[None]
    with pytest.raises(BadRequestError, match="this archive holds mean"):
        both.collide("al", here, radius_model="local")
    with pytest.raises(BadRequestError, match="1 poses to begin at and 2 to end at"):
        both.sweep("al", here, np.repeat(here, 2, axis=0), budget_visits=5)
    with pytest.raises(BadRequestError, match="2 origins and 1 directions"):
        both.raycast(np.zeros((2, 3)), np.ones((1, 3)), 1.0, budget_visits=5)
    with pytest.raises(BadTransformError, match="pose 1 mirrors"):
        both.collide("al", np.array([np.eye(4), np.diag([-1.0, 1, 1, 1])]))
    with pytest.raises(BadRequestError, match="direction 0 is zero"):
        both.raycast(np.zeros((1, 3)), np.zeros((1, 3)), 1.0)
    with pytest.raises(UnknownAvatarError, match="add it"):
        both.path("nobody", here)
    with Scene.open(built.first) as scene:
        with pytest.raises(BadTransformError, match="pose of archive 0: not rigid"):
            SeveralScenes([(scene, np.diag([2.0, 2, 2, 1]))], "hall")
        with pytest.raises(BadRequestError, match="no archives"):
            SeveralScenes([], "hall")


@pytest.mark.interpreted
def test_the_inverse_of_a_pose_carries_back(rng: np.random.Generator) -> None:
    assert archive_pose(np.eye(4)) is None and archive_pose(None) is None
    for _ in range(20):
        pose = cases.pose_of(cases.random_rotation(rng), rng.uniform(-1e3, 1e3, 3))
        points = rng.uniform(-100, 100, (10, 3))
        assert np.abs(moved(inverse_of(pose), moved(pose, points)) - points).max() < 1e-11
        assert np.abs(under(inverse_of(pose), pose[None])[0] - np.eye(4)).max() < 1e-11
        shift = exact_pose(rng)
        assert under(inverse_of(shift), shift[None])[0].tobytes() == np.eye(4).tobytes()
