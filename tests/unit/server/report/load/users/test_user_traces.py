"""Test the traces of a load test: speeds, floors, bounds, smooth turns, reproducible bits."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from solidcloud.builder.synthetic.figure import figure_points
from solidcloud.builder.synthetic.town import POINTS_PER_FACADE, town_lots
from solidcloud.builder.synthetic.truth import SceneTruth
from solidcloud.server.avatars.avatar_model import make_avatar
from solidcloud.server.report.load.users import town_paths, user_traces, walking_motion
from solidcloud.server.report.load.users.user_traces import KINDS, Trace

MOVING = ("stroll", "run", "tour", "crowd")
SECONDS, USERS = 40.0, 4


@pytest.fixture(scope="module")
def truth() -> SceneTruth:
    """Return the ground truth of seven façades: two whole rows of three, and a third row of one."""
    lots = town_lots(7 * POINTS_PER_FACADE, 5)
    return SceneTruth(5, 7 * POINTS_PER_FACADE, 0.0, (), tuple(lot.truth for lot in lots))


def trace(truth: SceneTruth, kind: str, seed: int = 3) -> Trace:
    return user_traces.traces(kind, truth, USERS, SECONDS, seed)


def one(made: Trace, user: int) -> NDArray[np.float64]:
    return user_traces.of_users(made, [user]).pose


def speeds(pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return speeds over half a second each, in which sway and jitter hardly count [m/s]."""
    place = pose[:, :2, 3]
    return np.linalg.norm(place[15:] - place[:-15], axis=1) * walking_motion.RATE / 15


def turned(pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation from each pose to the next [degrees]."""
    yaw = np.unwrap(np.arctan2(-pose[:, 0, 1], pose[:, 0, 0]))
    return np.degrees(np.diff(yaw))


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_arguments_give_the_same_bits_and_another_seed_others(truth: SceneTruth, kind: str) -> None:
    first, again, other = trace(truth, kind), trace(truth, kind), trace(truth, kind, seed=4)
    assert all(a.tobytes() == b.tobytes() for a, b in zip(first, again, strict=True))
    assert not np.array_equal(first.pose, other.pose)


@pytest.mark.parametrize("kind", KINDS)
def test_every_user_has_thirty_poses_a_second_and_all_are_in_order_of_time(
    truth: SceneTruth, kind: str
) -> None:
    made = trace(truth, kind)
    assert (np.diff(made.time) >= 0).all()
    assert np.bincount(made.user).tolist() == [round(SECONDS * 30)] * USERS
    for user in range(USERS):
        time = made.time[made.user == user]
        assert np.allclose(np.diff(time), 1 / 30) and 0 <= time[0] < 1 / 30
    # The frames of different users are not due at the same time.
    assert len(np.unique(made.time[:USERS])) == USERS


@pytest.mark.parametrize("kind", KINDS)
def test_poses_are_upright_on_the_floor_and_within_the_town(truth: SceneTruth, kind: str) -> None:
    made, town = trace(truth, kind), town_paths.make_town_of(truth)
    pose = made.pose
    assert np.allclose(pose[:, :3, :3] @ pose[:, :3, :3].transpose(0, 2, 1), np.eye(3))
    assert np.allclose(pose[:, 2, :3], (0, 0, 1)) and np.array_equal(
        pose[:, 3], np.tile((0, 0, 0, 1), (len(pose), 1))
    )
    low, high = town.bounds()
    assert ((pose[:, :2, 3] >= low) & (pose[:, :2, 3] <= high)).all()
    # No sole is in the floor; up to a stride before a step it is already raised.
    height = pose[:, 2, 3] - town.floor(pose[:, :2, 3])
    assert height.min() > 0.0 and height.max() < 0.5
    assert np.median(height) == pytest.approx(0.03)


@pytest.mark.parametrize("kind", [*MOVING, "turn"])
def test_turns_are_as_people_make_them(truth: SceneTruth, kind: str) -> None:
    made = trace(truth, kind)
    for user in range(USERS):
        turns = turned(one(made, user))
        assert np.abs(turns).max() < 300 / 30  # 300 degrees a second
        assert np.abs(np.diff(turns)).max() < 2500 / 900  # 2,500 degrees per second squared


@pytest.mark.parametrize("kind", ["stroll", "run", "crowd"])
def test_nobody_is_faster_than_the_kind_and_straight_on_all_are_as_fast(truth: SceneTruth, kind: str) -> None:
    made, speed = trace(truth, kind), user_traces.SPEEDS[kind]
    found = np.concatenate([speeds(one(made, user)) for user in range(USERS)])
    assert found.max() < 1.05 * speed and np.percentile(found, 90) > 0.97 * speed


def test_another_speed_may_be_asked_for(truth: SceneTruth) -> None:
    found = speeds(one(user_traces.traces("stroll", truth, 1, SECONDS, 3, speed=3.0), 0))
    assert 2.9 < np.percentile(found, 90) < 3.1


def test_who_turns_on_the_spot_stays_there_and_looks_all_around(truth: SceneTruth) -> None:
    made = trace(truth, "turn")
    for user in range(USERS):
        pose = one(made, user)
        assert np.ptp(pose[:, :2, 3], axis=0).max() < 0.02
        assert np.abs(turned(pose)).sum() > 720


def test_a_tour_passes_every_facade(truth: SceneTruth) -> None:
    made = user_traces.traces("tour", truth, 3, 120.0, 1)
    for facade in truth.facades:
        local = made.pose[:, :2, 3] - np.asarray(facade.origin[:2])
        assert (np.abs(local) < (2.5, 1.0)).all(axis=1).any(), facade.origin  # in its main door
    for user in range(3):
        assert (
            speeds(one(made, user)).max() < 1.05 * user_traces.SPEEDS["tour"]
        )  # over the seam of the loop too


def test_a_crowd_goes_through_one_door_and_nobody_through_its_jambs(truth: SceneTruth) -> None:
    made, passed = user_traces.traces("crowd", truth, 6, 150.0, 3), []
    facade = min(truth.facades, key=lambda f: np.abs(made.pose[:, :2, 3] - f.origin[:2]).sum())
    door = facade.door("main")
    for user in range(6):
        local = one(made, user)[:, :2, 3] - np.asarray(facade.origin[:2])
        within = (local[:, 1] > door.y_front) & (local[:, 1] < door.y_back)
        passed.append(within.any())
        assert (np.abs(local[within, 0]) < door.width / 2 - 0.25).all()
    assert all(passed)


def test_who_teleports_is_elsewhere_every_second_and_stands_meanwhile(truth: SceneTruth) -> None:
    made = trace(truth, "teleport")
    for user in range(USERS):
        steps = np.linalg.norm(np.diff(one(made, user)[:, :2, 3], axis=0), axis=1)
        jumped = np.flatnonzero(steps > 0.05)
        assert set(jumped + 1) <= set(range(30, round(SECONDS * 30), 30))
        assert len(jumped) >= 0.9 * (SECONDS - 1)


def test_one_facade_alone_is_walked_around_in(truth: SceneTruth) -> None:
    alone = SceneTruth(1, 1000, 0.0, (), truth.facades[:1])
    for kind in KINDS:
        made = user_traces.traces(kind, alone, 2, 60.0, 1)
        low, high = town_paths.make_town_of(alone).bounds()
        assert ((made.pose[:, :2, 3] >= low) & (made.pose[:, :2, 3] <= high)).all()


def test_what_cannot_be_traced_is_refused(truth: SceneTruth) -> None:
    with pytest.raises(ValueError, match="expected one of stroll, run"):
        user_traces.traces("adversary", truth, 1, 1.0, 1)
    with pytest.raises(ValueError, match="at least one"):
        user_traces.traces("stroll", truth, 0, 1.0, 1)


def test_a_recorded_trace_is_replayed_bit_for_bit(truth: SceneTruth, tmp_path: Path) -> None:
    made = trace(truth, "stroll")
    user_traces.save(tmp_path / "a" / "stroll.npz", made)
    back = user_traces.load(tmp_path / "a" / "stroll.npz")
    assert all(a.dtype == b.dtype and a.tobytes() == b.tobytes() for a, b in zip(made, back, strict=True))


def test_what_is_no_trace_is_refused(tmp_path: Path) -> None:
    np.savez(
        tmp_path / "a.npz", user=np.zeros(2, np.int64), time=np.array([1.0, 0.0]), pose=np.zeros((2, 4, 4))
    )
    np.savez(tmp_path / "b.npz", user=np.zeros(2, np.int64))
    with pytest.raises(ValueError, match="ascending"):
        user_traces.load(tmp_path / "a.npz")
    with pytest.raises(ValueError, match="no trace"):
        user_traces.load(tmp_path / "b.npz")


def test_centers_enclose_the_avatar_in_every_pose(truth: SceneTruth) -> None:
    avatar, made = make_avatar(figure_points(200)), trace(truth, "stroll")
    found = user_traces.centers(made, avatar, margin=0.25)
    assert found.center.shape == (len(made.user), 3) and found.reach.shape == (len(made.user),)
    for i in (0, 17, 800):
        points = avatar.points @ made.pose[i, :3, :3].T + made.pose[i, :3, 3]
        farthest = np.linalg.norm(points - found.center[i], axis=1).max() + avatar.radius + 0.25
        assert farthest <= found.reach[i] + 1e-9 < farthest + 0.3


def test_only_poses_after_a_teleport_are_scans(truth: SceneTruth) -> None:
    avatar = make_avatar(figure_points(200))
    for kind in MOVING:
        assert not user_traces.centers(trace(truth, kind), avatar).scan.any()
    made = trace(truth, "teleport")
    found = user_traces.centers(made, avatar)
    assert found.scan.sum() >= 0.9 * USERS * (SECONDS - 1)
    for user in range(USERS):
        assert not (np.flatnonzero(found.scan[made.user == user]) % 30).any()
