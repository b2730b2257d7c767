"""Test the traces of a load test: speeds, floors, bounds, smooth turns, reproducible bits."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from solidcloud.builder.synthetic.town import POINTS_PER_FACADE, town_lots
from solidcloud.builder.synthetic.truth import SceneTruth
from solidcloud.server.report.load.users import town_paths, user_traces, walking_motion
from solidcloud.server.report.load.users.user_traces import KINDS, Trace

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


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_arguments_give_the_same_bits_and_another_seed_others(truth: SceneTruth, kind: str) -> None:
    first, again, other = trace(truth, kind), trace(truth, kind), trace(truth, kind, seed=4)
    assert all(a.tobytes() == b.tobytes() for a, b in zip(first, again, strict=True))
    assert not np.array_equal(first.pose, other.pose)


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
