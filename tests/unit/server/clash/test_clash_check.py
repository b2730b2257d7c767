"""Test the check of a path on a small archive against brute force, and its end before time."""

from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import archive_cases
import numpy as np
import pytest
from msgspec import structs
from naive_sweep import pose_at
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.clash import clash_check
from solidcloud.server.clash.clash_check import Watcher, check_path
from solidcloud.server.clash.clash_snapshot import draw
from solidcloud.server.clash.clash_surroundings import surroundings
from solidcloud.server.clash.clash_viewpoint import find_viewpoint
from solidcloud.server.scene import Scene

RADIUS = 0.05
BODY = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.3], [0.1, 0.0, 0.1]])


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> archive_cases.Case:
    """Two walls at x = 0 and x = 1, from y = -1 to 1 and z = -1 to 1."""
    rng = np.random.default_rng(5)
    walls = rng.uniform(-1, 1, (3000, 3))
    walls[:, 0] = np.repeat([0.0, 1.0], 1500)
    return archive_cases.build(tmp_path_factory.mktemp("clash"), walls, voxel=1.0, level=False)


def path_through(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return times and poses of a straight way through both walls."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3] = np.linspace(-0.7, 1.7, count)
    return np.arange(count) / 10, poses


def test_clashes_are_those_of_brute_force(case: archive_cases.Case, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clash_check, "BATCH_POSES", 7)
    times, poses = path_through(97)
    told: list[Any] = []
    shares: list[float] = []
    with Scene.open(case.archive) as scene:
        scene.add_avatar("body", BODY, RADIUS)
        step, radius = scene.info().lattice_step, scene.info().radius
        checked = check_path(
            scene, "body", times, poses, reach=0.5, watcher=Watcher(told.append, shares.append)
        )
        contacts = scene.contacts("body", poses)
        pictures = []
        for clash in checked.clashes:
            view = find_viewpoint(scene, clash, poses, np.array([0.0, 0.0, 0.15]), 0.3, (0, 0, 1))
            # Both sides of the wall are free; the camera is on one of them, and sees the clash.
            assert abs(view.eye[0] - clash.place[0]) > 0.25
            pose = poses[clash.deepest]
            clouds = surroundings(scene, clash, pose, BODY, clash.place[None], np.array([0.0, 0.0, 1.0]))
            assert sum(len(cloud.points) for cloud in clouds) == scene.info().points + len(BODY) + 1
            pictures.append(draw(view, clouds, (160, 90)))
    gaps = np.array([
        np.linalg.norm((BODY + pose[:3, 3])[:, None] - case.points[None], axis=2).min() for pose in poses
    ]) - RADIUS - radius  # fmt: skip
    known = gaps < 0.5
    # Archives keep whole lattice steps.
    assert np.allclose(checked.signed_distance[known], gaps[known], atol=2 * step)
    assert np.isinf(checked.signed_distance[~known]).all()
    assert np.array_equal(checked.verdict, np.where(gaps <= 0, Verdict.CONTACT, Verdict.CLEAR))
    assert len(checked.clashes) == 2
    for clash in checked.clashes:
        own = slice(clash.first, clash.last + 1)
        assert (gaps[own] <= 0).all()
        assert gaps[clash.first - 1] > 0
        assert gaps[clash.last + 1] > 0
        assert clash.depth == pytest.approx(-gaps[own].min(), abs=2 * step)
        assert clash.contacts == contacts.pairs_found[own].max()
        assert clash.place[0] == pytest.approx(round(clash.place[0]), abs=step)
    assert np.array_equal(np.concatenate([each.verdict for each in told]), checked.verdict)
    assert [each.first for each in told] == list(range(0, 97, 7))
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    assert checked.complete
    # Between poses it may be deeper, but two spheres overlap by no more than their radii.
    assert checked.clearance is not None
    assert -RADIUS - radius - 2e-6 <= checked.clearance <= checked.signed_distance.min()
    # The contact is drawn in red over everything, near the middle of the picture.
    for picture in pictures:
        red = np.argwhere((picture[..., 0] > 200) & (picture[..., 1] < 100))
        assert len(red)
        assert np.abs(red.mean(axis=0) - (45, 80)).max() < 25


class FakeScene:
    """Scene in which everything is clear; it stops answering after some requests."""

    def __init__(self, answers: int) -> None:
        self.left, self.unanswered = answers, 0

    def distance(self, name: str, poses: np.ndarray, reach: float) -> Any:
        self.left -= 1
        if self.left < 0:
            self.unanswered += len(poses)
        none = np.full((len(poses), 3), np.nan)
        return SimpleNamespace(
            signed_distance=np.full(len(poses), 0.25),
            verdict=np.full(len(poses), Verdict.CLEAR, np.uint8),
            witness_avatar=none,
            witness_cloud=none,
            stopped="",
            faults=(),
        )

    def sweep(self, name: str, first: np.ndarray, last: np.ndarray, margin: float) -> Any:
        found = self.distance(name, first, 1.0)
        found.upper = np.full(len(first), np.inf)
        return found

    def silence(self, operation: str) -> str:
        return f"{operation}: no answer within 5 s"


def test_stopped_check_leaves_the_rest_unknown() -> None:
    times, poses = path_through(1000)
    told: list[Any] = []
    watcher = Watcher(told.append, stopped=lambda: len(told) == 2)
    checked = check_path(FakeScene(99), "body", times, poses, watcher=watcher)  # type: ignore[arg-type]
    examined = 2 * clash_check.BATCH_POSES
    assert not checked.complete
    assert checked.count(Verdict.UNKNOWN) == 1000 - examined
    assert checked.unknown == [(examined - 1, 999)]
    assert checked.count_motions(Verdict.CLEAR) == examined - 1
    assert checked.clearance is not None
    assert 0.12 < checked.clearance <= 0.25


def test_request_that_the_server_ends_is_asked_again_in_halves(case: archive_cases.Case) -> None:
    times, poses = path_through(64)
    with Scene.open(case.archive) as scene:
        scene.add_avatar("body", BODY, RADIUS)
        expected = check_path(scene, "body", times, poses, reach=0.5)
        for most, faults in ((9, ()), (0, ("it took too long",))):
            hasty = HastyScene(scene, most)
            checked = check_path(hasty, "body", times, poses, reach=0.5)  # type: ignore[arg-type]
            assert checked.faults == faults
            if most:
                assert np.array_equal(checked.verdict, expected.verdict)
                assert [each.depth for each in checked.clashes] == [each.depth for each in expected.clashes]
                assert 64 in hasty.asked
            else:
                assert checked.unknown == [(0, 63)]
                assert checked.clashes == []


class HastyScene:
    """Scene that ends requests of more than `most` poses."""

    def __init__(self, scene: Scene, most: int) -> None:
        self.scene, self.most = scene, most
        self.asked: list[int] = []

    def distance(self, name: str, poses: np.ndarray, reach: float) -> Any:
        return self.limited(self.scene.distance(name, poses, reach))

    def sweep(self, name: str, first: np.ndarray, last: np.ndarray, margin: float) -> Any:
        return self.limited(self.scene.sweep(name, first, last, margin))

    def contacts(self, name: str, poses: np.ndarray, limit: int, margin: float) -> Any:
        return self.limited(self.scene.contacts(name, poses, limit, margin))

    def limited(self, answers: Any) -> Any:
        self.asked.append(len(answers))
        if len(answers) <= self.most:
            return answers
        unknown = np.full(len(answers), Verdict.UNKNOWN, np.uint8)
        return structs.replace(answers, verdict=unknown, stopped="it took too long")


def ball_path(step: float) -> np.ndarray:
    """Return poses of the way through the wall at x = 0, none of which touches it if `step` is large."""
    places = np.arange(-0.35, 0.5, step)
    poses = np.tile(np.eye(4), (len(places), 1, 1))
    poses[:, 0, 3] = places
    return poses


@pytest.mark.parametrize("step", [0.7, 0.35, 0.1, 0.02])
def test_wall_between_two_poses_is_a_clash(case: archive_cases.Case, step: float) -> None:
    """Issue 35: a body before and behind a wall had no clash, and a clearance of 7 cm."""
    poses = ball_path(step)
    with Scene.open(case.archive) as scene:
        scene.add_avatar("body", BODY, RADIUS)
        checked = check_path(scene, "body", np.arange(len(poses)) * 2.0, poses)
        at_poses = scene.collide("body", poses).verdict == Verdict.CONTACT
        swept = scene.sweep("body", poses[:-1], poses[1:])
        assert len(checked.clashes) == 1
        (clash,), fraction = checked.clashes, checked.fraction(checked.clashes[0])
        assert np.array_equal(checked.motions.verdict, swept.verdict)
        assert checked.clearance is not None
        assert checked.clearance <= -clash.depth
        number = checked.track.number[clash.first]
        deepest = scene.distance("body", checked.track.poses[clash.deepest])
        assert clash.depth == pytest.approx(-float(deepest.signed_distance[0]), abs=1e-9)
        if at_poses.any():
            assert fraction is None
            assert (clash.first, clash.last) == (at_poses.argmax(), len(poses) - 1 - at_poses[::-1].argmax())
            return
        motion = int((swept.verdict == Verdict.CONTACT).argmax())
        assert fraction == pytest.approx(float(swept.upper[motion]), abs=1e-9)
        assert checked.poses_of(clash.first, clash.last) == (motion, motion + 1)
        assert checked.track.times[clash.first] == pytest.approx(2 * number)
        assert clash.depth > 0.01
        assert clash.place[0] == pytest.approx(0.0, abs=1e-3)


def test_clashes_at_and_between_poses_are_one_list(case: archive_cases.Case) -> None:
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, 0, 3] = [-0.35, 0.0, 0.4, 1.6]
    shares: list[float] = []
    with Scene.open(case.archive) as scene:
        scene.add_avatar("body", BODY, RADIUS)
        watcher = Watcher(progress=shares.append)
        checked = check_path(scene, "body", np.arange(4.0), poses, watcher=watcher)
    assert {checked.poses_of(each.first, each.last) for each in checked.clashes} == {(1, 1), (2, 3)}
    assert [each.depth for each in checked.clashes] == sorted(
        (each.depth for each in checked.clashes), reverse=True
    )
    assert checked.motions.verdict.tolist() == [Verdict.CONTACT] * 3
    assert shares == sorted(shares)


@pytest.mark.parametrize("seed", range(3))
def test_clearance_is_at_most_the_least_distance_on_the_motions(case: archive_cases.Case, seed: int) -> None:
    rng = np.random.default_rng(seed)
    poses = np.array([
        archive_cases.pose_of(archive_cases.random_rotation(rng), rng.uniform([0.3, -0.8, -0.5], [0.7, 0.8, 0.5]))
        for _ in range(6)
    ])  # fmt: skip
    fractions = np.linspace(0, 1, 400)
    with Scene.open(case.archive) as scene:
        scene.add_avatar("body", BODY, RADIUS)
        checked = check_path(scene, "body", np.arange(6.0), poses)
        dense = [np.array([pose_at(one, two, t) for t in fractions]) for one, two in pairwise(poses)]
        least = [float(scene.distance("body", each).signed_distance.min()) for each in dense]
    assert checked.clearance is not None
    assert checked.clearance <= min(least)
    if min(least) > 0:
        # The dense poses are up to 2 mm apart.
        assert checked.clearance > min(least) - 1e-3 - 2e-3
    touches = np.array(least) <= 0
    assert (checked.motions.verdict[touches] == Verdict.CONTACT).all()
    clear = checked.motions.verdict == Verdict.CLEAR
    assert (checked.motions.clearance[clear] <= np.array(least)[clear]).all()
    assert (checked.motions.clearance[clear] > 0.3 * np.array(least)[clear] - 2e-3).all()


def test_unknown_motion_makes_a_stretch_unknown(
    case: archive_cases.Case,
) -> None:
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, 0, 3] = np.linspace(0.3, 0.6, 5)

    class BlindScene:
        """Scene in which the sweep of the motion from pose 2 is unknown."""

        def __init__(self, scene: Scene) -> None:
            self.distance, self.contacts, self.scene = scene.distance, scene.contacts, scene

        def sweep(self, name: str, first: np.ndarray, last: np.ndarray, margin: float) -> Any:
            answers = self.scene.sweep(name, first, last, margin)
            verdict = np.where(first[:, 0, 3] == poses[2, 0, 3], Verdict.UNKNOWN, answers.verdict)
            return structs.replace(answers, verdict=verdict.astype(np.uint8))

    with Scene.open(case.archive) as scene:
        scene.add_avatar("body", BODY, RADIUS)
        checked = check_path(BlindScene(scene), "body", np.arange(5.0), poses)  # type: ignore[arg-type]
    assert checked.count(Verdict.UNKNOWN) == 0
    assert checked.unknown == [(2, 3)]
    assert checked.count_motions(Verdict.UNKNOWN) == 1
