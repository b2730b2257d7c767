"""A walker's verdicts are those of `collide`, whatever way it goes, and those of brute force.

What it remembers of a pose may only ever save work: every step below that is smaller, larger, or stranger than it
hopes for must be answered as if it remembered nothing.
"""

from pathlib import Path

import cases
import numpy as np
import pytest
from numpy.typing import NDArray
from solidcloud.schemas.errors import CorruptError
from solidcloud.server.kernels import memory
from solidcloud.server.kernels.layout import Arena
from solidcloud.server.kernels.overlap import UNKNOWN
from solidcloud.server.scene import Scene

KINDS = ("smooth", "jitter", "jumps", "turning", "sliding", "standing", "in and out", "scaled")


def room(rng: np.random.Generator, count: int) -> NDArray[np.float64]:
    """Points (n, 3) [m] of a floor and two walls, a millimetre rough, with a ball and a loose point in the room."""
    flat = rng.uniform(-1, 1, (count, 3))
    flat[:, 2] = rng.normal(0, 1e-3, count)
    walls = (
        np.roll(flat, 1, axis=1) + np.array([-1.0, 0, 1.0]),
        np.roll(flat, 2, axis=1) + np.array([0, 1.0, 1.0]),
    )
    ball = rng.normal(size=(count // 4, 3))
    ball = ball / np.linalg.norm(ball, axis=1)[:, None] * 0.2 + [0.4, -0.3, 0.5]
    return np.concatenate([flat, *walls, ball, [[0.3, 0.4, 0.7]]])


def body(rng: np.random.Generator, count: int) -> NDArray[np.float64]:
    """Points (n, 3) [m] of two flat feet and a trunk, the soles at 0."""
    trunk = rng.uniform(-1, 1, (count, 3)) * [0.1, 0.06, 0.2] + [0, 0, 0.3]
    feet = rng.uniform(-1, 1, (count, 3)) * [0.04, 0.1, 0.02] + [0, 0, 0.02]
    feet[:, 0] += np.where(np.arange(count) % 2, 0.08, -0.08)
    return np.concatenate([trunk, feet])


def turn_about(axis: int, angle: float) -> NDArray[np.float64]:
    """The rotation (3, 3) about an axis of the world."""
    turn, (i, j) = np.eye(3), [k for k in range(3) if k != axis]
    turn[i, i] = turn[j, j] = np.cos(angle)
    turn[i, j], turn[j, i] = -np.sin(angle), np.sin(angle)
    return turn


def walk(rng: np.random.Generator, kind: str, count: int) -> NDArray[np.float64]:
    """Poses (count, 4, 4) of a way through the room."""
    at, angle, tilt = rng.uniform(-0.6, 0.6, 3) * [1, 1, 0] + [0, 0, 0.03], rng.uniform(0, 6), 0.0
    ahead, scale, poses = rng.normal(size=3) * [1, 1, 0.02], 1.0, []
    for i in range(count):
        if kind == "smooth":
            ahead += rng.normal(size=3) * [0.2, 0.2, 0.02]
            at, angle = at + 0.02 * ahead / np.linalg.norm(ahead), angle + rng.normal() * 0.05
        elif kind == "jitter":
            at, angle = at + rng.normal(size=3) * 1e-6, angle + rng.normal() * 1e-6
        elif kind == "jumps" and i % 7 == 0:
            at, angle, tilt = (
                rng.uniform(-1, 1, 3) * [1, 1, 0.3] + [0, 0, 0.3],
                rng.uniform(0, 6),
                rng.normal(),
            )
        elif kind == "turning":
            angle, tilt = angle + 0.1, tilt + rng.normal() * 0.02
        elif kind == "sliding":
            at = np.array([-1 + 0.16 + rng.uniform(0, 1e-3), -0.8 + 0.01 * i, 0.014 + rng.uniform(0, 2e-3)])
            angle = rng.normal() * 1e-3
        elif kind == "in and out":
            at = np.array([0.3 + 0.01 * (i % 5), 0.2 + 0.03 * np.sin(i), 0.02 + 0.02 * np.sin(0.3 * i)])
        elif kind == "scaled":
            at, scale = at + rng.normal(size=3) * 0.01, (1.0, 0.8, 1.3)[i // 5 % 3]
        at = np.clip(at, [-1.2, -1.2, -0.05], [1.2, 1.2, 1.0])
        poses.append(cases.pose_of(turn_about(0, tilt) @ turn_about(2, angle) * scale, at))
    return np.array(poses)


@pytest.mark.parametrize("options", [{"voxel": 4.0}, {"voxel": 0.7, "leaf": 8, "degree": 4}, {"voxel": 0.3}])
@pytest.mark.parametrize("margin", [0.0, 0.004])
def test_verdicts_are_those_of_collide(
    tmp_path: Path, rng: np.random.Generator, options: dict[str, float], margin: float
) -> None:
    """One walker goes all ways, one after the other, in calls of all lengths."""
    case = cases.build(tmp_path, room(rng, 4000), radius=0.008, **options)
    avatar, touched, clear = body(rng, 600), 0, 0
    with Scene.open(case.archive) as scene:
        scene.add_avatar("avatar", avatar, 0.005)
        walker = scene.walker("avatar", margin)
        for _ in range(6):
            for kind in KINDS:
                poses = walk(rng, kind, 60)
                expected = scene.collide("avatar", poses, margin)
                at = 0
                while at < len(poses):
                    part = int(rng.choice([1, 1, 2, 25]))
                    answers = walker.collide(poses[at : at + part])
                    assert answers.verdict.tolist() == expected.verdict[at : at + part].tolist(), (kind, at)
                    assert answers.outside.tolist() == expected.outside[at : at + part].tolist()
                    at += part
                touched, clear = (
                    touched + int(expected.verdict.sum()),
                    clear + int((expected.verdict == 0).sum()),
                )
    assert touched > 100 and clear > 100


@pytest.mark.parametrize("kind", KINDS)
def test_verdicts_are_those_of_brute_force(tmp_path: Path, rng: np.random.Generator, kind: str) -> None:
    case = cases.build(tmp_path, room(rng, 600), radius=0.02, voxel=0.9)
    avatar, poses = body(rng, 60), walk(rng, kind, 80)
    expected = case.judge(avatar, 0.005, poses)
    with Scene.open(case.archive) as scene:
        scene.add_avatar("avatar", avatar, 0.005)
        assert scene.walker("avatar").collide(poses).verdict.tolist() == expected.astype(int).tolist()


def test_contact_begins_at_the_unit_it_begins_at(tmp_path: Path, rng: np.random.Generator) -> None:
    """Steps of a unit, 15 nm, towards a wall: bounds that err inward by less than any real step would show here."""
    case = cases.build(tmp_path, room(rng, 600), radius=0.02, voxel=0.9)
    avatar = body(rng, 60)
    with Scene.open(case.archive) as scene:
        scene.add_avatar("avatar", avatar, 0.005)
        walker = scene.walker("avatar")
        for _ in range(5):
            high = cases.pose_of(turn_about(2, rng.uniform(0, 6)), np.append(rng.uniform(-0.5, 0, 2), 0.2))
            low = high.copy()
            low[2, 3] = -0.02
            while high[2, 3] - low[2, 3] > 2.0**-27:
                middle = high.copy()
                middle[2, 3] = (high[2, 3] + low[2, 3]) / 2
                touches = scene.collide("avatar", middle[None]).verdict[0]
                assert walker.collide(middle[None]).verdict[0] == touches
                low, high = (middle, high) if touches else (low, middle)
            steps = np.repeat(high[None], 80, axis=0)
            steps[:, 2, 3] += np.arange(40, -40, -1) * 2.0**-26
            expected = scene.collide("avatar", steps).verdict
            assert walker.collide(steps).verdict.tolist() == expected.tolist()
            assert 0 < expected.sum() < 80


def test_a_corner_against_a_point(tmp_path: Path, rng: np.random.Generator) -> None:
    """The box around a leaf node's points is tight at its corners: there it has to be given all the room there is."""
    case = cases.build(tmp_path, np.zeros((1, 3)), radius=0.02, voxel=0.9)
    avatar = np.stack(np.meshgrid(*[[-0.1, 0.1]] * 3), axis=-1).reshape(-1, 3)
    with Scene.open(case.archive) as scene:
        scene.add_avatar("avatar", avatar, 0.005)
        walker, found = scene.walker("avatar"), []
        for _ in range(20):
            turn = cases.random_rotation(rng)
            away = turn @ avatar[rng.integers(8)] / np.linalg.norm(avatar[0])
            # The corner goes from 1 mm outside of contact to 1 mm inside, in steps of 20 um.
            ways = np.linalg.norm(avatar[0]) + 0.025 + np.arange(50, -50, -1) * 2e-5 + 1e-6
            poses = np.array([cases.pose_of(turn, -away * way) for way in ways])
            found.append(walker.collide(poses).verdict.tolist())
            assert found[-1] == scene.collide("avatar", poses).verdict.tolist()
        assert 0 < sum(map(sum, found)) < 2000


def test_voxels_may_come_and_go(tmp_path: Path, rng: np.random.Generator) -> None:
    """A cache of a few voxels: what is remembered of one holds when it is loaded again, elsewhere in memory."""
    case = cases.build(tmp_path, room(rng, 4000), radius=0.008, voxel=0.4)
    avatar = body(rng, 200)
    with Scene.open(case.archive) as whole:
        sizes = np.sort(whole._opened.store.sizes)
        whole.add_avatar("avatar", avatar, 0.005)
        with Scene.open(case.archive, budget_bytes=int(sizes[-11:].sum())) as scene:
            scene.add_avatar("avatar", avatar, 0.005)
            walker = scene.walker("avatar")
            for kind in ("smooth", "sliding", "jumps", "smooth"):
                poses = walk(rng, kind, 60)
                expected = whole.collide("avatar", poses).verdict
                for i in range(len(poses)):
                    assert walker.collide(poses[i : i + 1]).verdict[0] == expected[i], (kind, i)
                assert walker.collide(poses).verdict.tolist() == expected.tolist()  # over the budget
                scene.residency.check()
            assert scene.residency.evictions > 10


@pytest.mark.parametrize("count", [0, 1, 12_000])
def test_an_avatar_without_a_front_of_leaf_nodes(
    tmp_path: Path, rng: np.random.Generator, count: int
) -> None:
    case = cases.build(tmp_path, room(rng, 600), radius=0.008, voxel=0.9)
    poses = walk(rng, "smooth", 30)
    with Scene.open(case.archive) as scene:
        scene.add_avatar("avatar", body(rng, count)[:count], 0.005)
        expected = scene.collide("avatar", poses).verdict
        assert scene.walker("avatar").collide(poses).verdict.tolist() == expected.tolist()


def test_where_there_is_no_room_for_entries_it_starts_afresh(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    """A great cloud of single points, and the avatar in it: clear, through a touch, clear."""
    grid = np.stack(np.meshgrid(*[np.arange(-0.5, 0.5, 0.04)] * 3), axis=-1).reshape(-1, 3)
    case = cases.build(tmp_path, grid, radius=0.001, voxel=2.0, leaf=1, degree=2)
    avatar = np.stack(np.meshgrid(*[np.arange(-0.3, 0.3, 0.08)] * 3), axis=-1).reshape(-1, 3) + 0.02
    poses = np.repeat(np.eye(4)[None], 40, axis=0)
    poses[:, :3, 3] = np.linspace(0, 0.04, 40)[:, None]
    with Scene.open(case.archive) as scene:
        scene.add_avatar("avatar", avatar, 0.02)
        expected = scene.collide("avatar", poses).verdict
        walker = scene.walker("avatar")
        assert walker.collide(poses).verdict.tolist() == expected.tolist()
        assert walker._memory.counts[0] <= memory.ENTRIES and 0 < expected.sum() < 40
        assert walker._memory.state[memory.KNOWN] == 0.0


def test_a_voxel_that_cannot_be_read_is_unknown(
    tmp_path: Path, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    case = cases.build(tmp_path, room(rng, 600), radius=0.008, voxel=0.5)
    with Scene.open(case.archive) as scene:
        load = scene._opened.store.load

        def broken(row: int, arena: Arena, at: int) -> NDArray[np.int64]:
            if row % 3 == 0:
                raise CorruptError("made for this test")
            return load(row, arena, at)

        monkeypatch.setattr(scene._opened.store, "load", broken)
        scene.add_avatar("avatar", body(rng, 200), 0.005)
        walker = scene.walker("avatar")
        for kind in ("smooth", "jumps"):
            poses = walk(rng, kind, 40)
            expected = scene.collide("avatar", poses).verdict
            assert walker.collide(poses).verdict.tolist() == expected.tolist()
            for i in range(len(poses)):
                assert walker.collide(poses[i : i + 1]).verdict[0] == expected[i]
            assert (expected == UNKNOWN).any()


@pytest.mark.interpreted
def test_a_few_steps(tmp_path: Path, rng: np.random.Generator) -> None:
    case = cases.build(tmp_path, room(rng, 40), radius=0.05)
    avatar, poses = body(rng, 20), walk(rng, "smooth", 12)
    expected = case.judge(avatar, 0.03, poses)
    with Scene.open(case.archive) as scene:
        scene.add_avatar("avatar", avatar, 0.03)
        walker = scene.walker("avatar")
        found = [walker.collide(poses[:1]).verdict, walker.collide(poses[1:]).verdict]
    assert np.concatenate(found).tolist() == expected.astype(int).tolist()
