"""Which pairs of pose and voxel coarse tops settle, and which they leave to those who look closer."""

import os
from itertools import chain
from pathlib import Path

import archive_cases
import numpy as np
import pytest
import radius_class_archives
from coarse_tops import ROOM, Made, build_scattered, open_made, rows_of
from numpy.typing import NDArray
from solidcloud.schemas.archive.radius_model import LOCAL_CLASSES
from solidcloud.server.avatars.avatar_model import AvatarModel, make_avatar
from solidcloud.server.kernels.collide import coarse_clearance
from solidcloud.server.kernels.collide.coarse_clearance import any_with_coarse_bounds
from solidcloud.server.kernels.collide.collide_poses import collide_poses
from solidcloud.server.kernels.collide.early_contact import CLEAR, CONTACT
from solidcloud.server.kernels.core.voxels_in_reach import VoxelsInReach
from solidcloud.server.queries.context.query_budget import NO_LIMIT
from solidcloud.server.residency.coarse_bounds import CoarseBounds, drop_clear_pairs
from solidcloud.server.runtime.stop_flag import NO_STOP, StopFlag

INTERPRETED = os.environ.get("NUMBA_DISABLE_JIT") == "1"


@pytest.fixture(scope="module")
def opened(tmp_path_factory: pytest.TempPathFactory) -> Made:
    """Open an archive of eight voxels."""
    return open_made(build_scattered(tmp_path_factory.mktemp("scattered")))


@pytest.fixture
def made(opened: Made) -> Made:
    """Return the eight voxels without coarse bounds."""
    return opened._replace(coarse=CoarseBounds(opened.voxels, ROOM))


@pytest.fixture(scope="module")
def walls(tmp_path_factory: pytest.TempPathFactory) -> Made:
    """Open an archive of a floor and two walls, in one voxel."""
    side = np.stack(np.meshgrid(*[np.linspace(0.05, 3.95, 60)] * 2), axis=-1).reshape(-1, 2)
    flat = np.column_stack([side, np.full(len(side), 0.05)])
    wall = flat[:: 7 if INTERPRETED else 1]
    scan = np.concatenate([flat, np.roll(wall, 1, axis=1), np.roll(wall, 2, axis=1)])
    folder = tmp_path_factory.mktemp("walls")
    return open_made(archive_cases.build(folder, scan, voxel=16.0, radius=0.02, resolution=1e-3).archive)


@pytest.fixture
def corner(walls: Made) -> Made:
    """Return the floor and the walls without coarse bounds."""
    return walls._replace(coarse=CoarseBounds(walls.voxels, ROOM))


def shifted(*places: tuple[float, float, float]) -> NDArray[np.float64]:
    """Poses (k, 4, 4) that only shift."""
    return np.array([archive_cases.pose_of(np.eye(3), np.array(place)) for place in places])


BODY = make_avatar(np.random.default_rng(1).uniform([-0.2, -0.2, 0.1], [0.2, 0.2, 0.5], (400, 3)), 0.01)


@pytest.mark.interpreted
def test_a_pose_between_walls_is_settled_and_one_at_a_wall_is_not(corner: Made) -> None:
    poses = shifted((2, 2, 2), (2, 2, -0.1), (0.1, 2, 2), (1.5, 2.5, 1.5))
    reach = corner.reach(BODY, poses)
    assert rows_of(reach) == [[0]] * 4
    found, settled = drop_clear_pairs(corner.arrays, corner.coarse.arrays, BODY.arrays, poses, reach)
    assert found is reach and settled == 0  # no voxel has a slot
    corner.fill()
    found, settled = drop_clear_pairs(corner.arrays, corner.coarse.arrays, BODY.arrays, poses, reach)
    assert (rows_of(found), settled) == ([[], [0], [0], []], 2)
    for name in ("scales", "units", "boxes", "outside"):
        assert getattr(found, name) is getattr(reach, name)
    resident = corner.resident(0)
    found, settled = drop_clear_pairs(resident.arrays, corner.coarse.arrays, BODY.arrays, poses, reach)
    assert found is reach and settled == 0


@pytest.mark.interpreted
def test_feet_above_a_floor_are_settled_by_their_points(corner: Made) -> None:
    corner.fill()
    # 4 cm, and then so low that they are in contact. The sphere around the body reaches below the floor in both.
    lowest = float(BODY.points[:, 2].min())
    poses = shifted((2, 2, 0.05 + 0.04 - lowest), (2, 2, 0.05 + 0.02 - lowest))
    assert corner.settled(BODY, poses) == ([[0], [0]], [[0], []])
    verdict, counts = np.zeros(2, np.uint8), np.zeros((3, 2), np.uint32)
    reach = corner.reach(BODY, poses)
    collide_poses(
        poses, BODY.arrays, corner.resident(0).arrays, reach, np.arange(2), 0, NO_LIMIT, verdict, counts
    )
    assert verdict.tolist() == [CLEAR, CONTACT]


def test_an_avatar_of_many_points_is_settled_by_its_front(corner: Made) -> None:
    corner.fill()
    many = make_avatar(np.random.default_rng(2).uniform(-0.2, 0.2, (20_000, 3)), 0.005)
    assert many.arrays.first[many.arrays.front_first] >= 0  # inner nodes
    poses = shifted((2, 2, 2), (2, 2, 0.24), (0.8, 0.8, 0.8))
    assert corner.settled(many, poses) == ([[0]] * 3, [[0], [], [0]])


@pytest.mark.interpreted
def test_an_avatar_without_points_has_nothing_to_settle(made: Made) -> None:
    made.fill()
    avatar, poses = make_avatar(np.empty((0, 3))), np.eye(4)[None]
    reach = made.reach(make_avatar([[0.0, 0, 0]], 0.01), poses)._replace(starts=np.zeros(2, np.int64))
    found, settled = drop_clear_pairs(made.arrays, made.coarse.arrays, avatar.arrays, poses, reach)
    assert found is reach and settled == 0


@pytest.mark.interpreted
def test_resident_voxels_and_those_without_a_slot_stay(made: Made, rng: np.random.Generator) -> None:
    avatar = make_avatar(rng.uniform(-0.3, 0.3, (40, 3)), 0.01)
    poses = shifted(*rng.uniform(0, 2, (30, 3)).tolist())
    made.fill(3)
    before, gone = made.resident(0, 2).settled(avatar, poses)
    assert any({0, 2, 3} & set(rows) for rows in before)
    assert not any({0, 2, 3} & set(rows) for rows in gone)
    _, all_gone = made.settled(avatar, poses)
    assert gone == [[row for row in rows if row not in (0, 2)] for rows in all_gone]
    assert 0 < sum(map(len, gone)) < sum(map(len, all_gone)) < sum(map(len, before))


@pytest.mark.interpreted
def test_what_is_settled_of_a_long_avatar_is_clear(made: Made, rng: np.random.Generator) -> None:
    """A rod, much of which is far from its middle: along each axis, at random places."""
    made.fill()
    everything, count = made.resident(*range(made.voxels)), 10 if INTERPRETED else 30
    for axis in range(3):
        rod = make_avatar(
            np.roll(np.column_stack([np.linspace(-0.6, 0.6, 40), np.zeros((40, 2))]), axis, axis=1), 0.01
        )
        poses = shifted(*rng.uniform(0, 2, (count, 3)).tolist())
        before, gone = made.settled(rod, poses)
        assert 0 < sum(map(len, gone)) < sum(map(len, before))
        starts = np.cumsum([0, *map(len, gone)])
        reach = made.reach(rod, poses)._replace(starts=starts, rows=np.array(list(chain(*gone)), np.int64))
        verdict, counts = np.zeros(count, np.uint8), np.zeros((3, count), np.uint32)
        collide_poses(
            poses, rod.arrays, everything.arrays, reach, np.arange(count), 0, NO_LIMIT, verdict, counts
        )
        assert (verdict == CLEAR).all()


@pytest.mark.interpreted
def test_only_what_is_not_resident_and_has_a_slot_is_worth_asking() -> None:
    """Also at the very beginning of the arena, and of the slots."""
    where = np.array([[-1, -1, -1], [0, 0, 0], [-1, -1, -1]])
    slot = np.array([0, 1, -1], np.int32)
    for rows, worth in (([0], True), ([1], False), ([2], False), ([1, 2], False), ([2, 1, 0], True)):
        assert any_with_coarse_bounds(where, slot, np.array(rows), len(rows), NO_STOP.flag) is worth
    assert not any_with_coarse_bounds(where, slot, np.array([1, 0]), 1, NO_STOP.flag), "of the first alone"


def pairs_of(made: Made) -> tuple[AvatarModel, NDArray[np.float64], VoxelsInReach]:
    """An avatar, poses and more than 32 pairs of a pose and a voxel."""
    made.fill()
    ball = make_avatar(np.zeros((1, 3)), 0.01)
    poses = shifted(*np.random.default_rng(6).uniform(0, 2, (60, 3)).tolist())
    reach = made.reach(ball, poses, 1 << 22)
    assert reach.starts[-1] > 32
    return ball, poses, reach


@pytest.mark.interpreted
@pytest.mark.skipif(not INTERPRETED, reason="the looks of compiled kernels cannot be counted")
def test_the_stop_flag_is_read_once_every_some_voxels(made: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    """Resident or not."""
    ball, poses, reach = pairs_of(made)
    looks = []
    usual = coarse_clearance.stopped
    monkeypatch.setattr(coarse_clearance, "stopped", lambda flag: looks.append(flag) or usual(flag))
    monkeypatch.setattr(coarse_clearance, "ROWS_AT_ONCE", 16)
    for where in (made.arrays.where, np.zeros_like(made.arrays.where)):
        looks.clear()
        drop_clear_pairs(made.arrays._replace(where=where), made.coarse.arrays, ball.arrays, poses, reach)
        assert len(looks) >= reach.starts[-1] // 16


@pytest.mark.interpreted
def test_a_stop_ends_the_search_for_pairs_to_drop(made: Made) -> None:
    ball, poses, reach = pairs_of(made)
    assert drop_clear_pairs(made.arrays, made.coarse.arrays, ball.arrays, poses, reach)[1] > 0
    stop = StopFlag()
    stop.set("the test says so")
    for where in (made.arrays.where, np.zeros_like(made.arrays.where)):
        arrays = made.arrays._replace(where=where, stop=stop.flag)
        found, removed = drop_clear_pairs(arrays, made.coarse.arrays, ball.arrays, poses, reach)
        assert found is reach and removed == 0


@pytest.mark.interpreted
def test_radii_of_a_model_are_those_of_the_nodes(tmp_path: Path) -> None:
    # Two plates: the lower one of small spheres, the upper one of the largest.
    side = np.stack(np.meshgrid(*[np.linspace(0, 1, 12)] * 2), axis=-1).reshape(-1, 2)
    scan = np.concatenate([np.column_stack([side, np.full(len(side), z)]) for z in (0.1, 1.0)])
    with radius_class_archives.any_classes(lambda local: _small_below(local)):
        case = archive_cases.build(tmp_path, scan, voxel=8.0, models=radius_class_archives.STORED, leaf=8)
    made = open_made(case.archive, "local")
    made.remember(0)
    avatar = make_avatar([[0.0, 0, 0], [0.01, 0, 0]], 0.001)
    # 20 mm below a point of either plate: clear of spheres of 1 mm, not of such of 32.
    poses = shifted((6 / 11, 6 / 11, 0.1 - 0.02), (6 / 11, 6 / 11, 1.0 - 0.02))
    assert made.settled(avatar, poses) == ([[0], [0]], [[0], []])
    filled = made._replace(coarse=CoarseBounds(made.voxels, ROOM))  # knows no better than that all are large
    filled.fill()
    assert filled.settled(avatar, poses) == ([[0], [0]], [[], []])
    poses[:, 2, 3] -= 0.02
    assert filled.settled(avatar, poses[1:]) == ([[0]], [[0]])


def _small_below(local: NDArray[np.int32]) -> NDArray[np.uint8]:
    """The least class in the lower half metre of what is built, the largest above. The lattice begins at the scan."""
    return np.where(local[:, 2] < 5000, 0, LOCAL_CLASSES - 1).astype(np.uint8)
