"""Pairs of placed avatars by the kernels alone: boxes, the sweep over them, the definition to the unit, the work."""

import math

import archive_cases
import naive
import numpy as np
import pytest
from numpy.typing import NDArray
from solidcloud.server.avatars.avatar_model import AvatarModel, make_avatar
from solidcloud.server.kernels.bodies import body_pairs as kernel
from solidcloud.server.runtime.stop_flag import NO_STOP, StopFlag

pytestmark = pytest.mark.interpreted

ORIGIN = np.array([3.0, -20.0, 500.0])
UNIT = 2.0**-26


# --- the sweep ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
def test_pairs_of_boxes_are_those_of_all_pairs(seed: int) -> None:
    """Whole numbers, so that sides lie upon each other."""
    rng = np.random.default_rng(seed)
    n = 14
    low = rng.integers(0, 8, (n, 3)).astype(float)
    high = low + rng.integers(0, 4, (n, 3))
    groups, masks = rng.integers(0, 8, (2, n)).astype(np.uint32)
    meet, stopped = [], 0
    for i in range(n):
        for j in range(i + 1, n):
            if (low[i] <= high[j]).all() and (low[j] <= high[i]).all():
                let = groups[i] & masks[j] and groups[j] & masks[i]
                meet += [[i, j]] if let else []
                stopped += not let
    assert meet or stopped
    order = np.argsort(low[:, 0], kind="stable")
    for room in (len(meet) + 1, len(meet), 1, 0):
        pairs = np.full((room, 2), -1, np.int32)
        found = kernel.sweep_and_prune(order, low, high, groups, masks, NO_STOP.flag, pairs)
        assert found == (len(meet), stopped)
        written = [row for row in pairs.tolist() if row != [-1, -1]]
        assert len(written) == min(room, len(meet)) and all(row in meet for row in written)
        if room >= len(meet):
            assert sorted(written) == meet and pairs[len(meet) :].tolist() == [[-1, -1]] * (room - len(meet))


# --- boxes ----------------------------------------------------------------------------------------------


def placed(
    model: AvatarModel, pose: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64], float]:
    """An avatar's points in exact units; where its root's centre is, from the origin, and the root's radius [m]."""
    center = pose[:3, :3] @ model.arrays.center[0] + (pose[:3, 3] - ORIGIN)
    return naive.placed_units(model.points, pose, ORIGIN), center, float(model.arrays.radius[0])


@pytest.mark.parametrize("far", [0.0, 1e8])
def test_boxes_hold_the_spheres_and_half_the_margin_and_little_more(
    rng: np.random.Generator, far: float
) -> None:
    model = make_avatar(rng.uniform(-1, 1, (20, 3)) + np.array([5, 0, 0]), 0.125)
    poses = np.array(
        [
            archive_cases.pose_of(archive_cases.random_rotation(rng), rng.uniform(-1, 1, 3) * far + ORIGIN)
            for _ in range(4)
        ]
    )
    units = np.array([naive.reach_units(model.radius, 0.0, 0.0) for pose in poses])
    low, high = np.full((4, 3), 9e99), np.full((4, 3), 9e99)
    margin = 1_000_001  # of it half a unit is in either box
    which = np.array([3, 0, 1])
    kernel.bound_objects(model.arrays, poses, which, units, ORIGIN, margin, low, high)
    assert (low[2] == 9e99).all() and (high[2] == 9e99).all()
    for i in which:
        points, center, radius = placed(model, poses[i])
        reach = int(units[i]) + margin / 2
        assert (low[i] / UNIT <= points.min(axis=0) - reach).all()
        assert (high[i] / UNIT >= points.max(axis=0) + reach).all()
        # Not larger than the root's ball with reach by more than rounding: its bounds and two units, widened by 1e-8.
        extent = radius * (1 + 1e-8) + reach * UNIT
        size = np.abs(poses[i][:3, 3]).max() + 20
        slack = 2 * UNIT + size * 2.0**-49
        assert np.abs(low[i] - (center - extent)).max() <= 2 * slack
        assert np.abs(high[i] - (center + extent)).max() <= 2 * slack
        assert (high[i] - low[i] >= 2 * (extent + 1.9 * UNIT)).all()


# --- two avatars ----------------------------------------------------------------------------------------


class Asked:
    """Two avatars under two poses, asked with a reach; and what the definition says."""

    def __init__(self, a: AvatarModel, b: AvatarModel, poses: NDArray[np.float64]) -> None:
        self.a, self.b, self.poses = a, b, poses
        one, other = (naive.placed_units(m.points, p, ORIGIN) for m, p in zip((a, b), poses, strict=True))
        square = naive.least_square(one, other)
        self.least = math.isqrt(square - 1) + 1 if square else 0

    def ask(self, reach: int, turned: bool = False) -> tuple[int, int, int]:
        """The verdict, node visits and pairs of points tested, with radii and margin adding up to `reach` units."""
        units = np.array([reach // 2, reach // 3])
        verdict, counters = np.full(1, 9, np.uint8), np.array([100, 200])
        a, b, pair = (self.b, self.a, [1, 0]) if turned else (self.a, self.b, [0, 1])
        kernel.touch_pairs(
            a.arrays, b.arrays, self.poses, units, np.array([pair]), reach - int(units.sum()),
            ORIGIN, NO_STOP.flag, verdict, counters,
        )  # fmt: skip
        return int(verdict[0]), int(counters[0]) - 100, int(counters[1]) - 200


def asked(seed: int, counts: tuple[int, int], far: float = 0.0, apart: float = 1.2) -> Asked:
    """Two shells of so many points whose middles are `apart` from each other, `far` from the origin [m]."""
    rng = np.random.default_rng(seed)
    models = []
    for count in counts:
        points = rng.normal(size=(count, 3))
        models.append(make_avatar(0.5 * points / np.sqrt((points * points).sum(axis=1))[:, None], 0.0))
    away = rng.normal(size=3)
    at = rng.uniform(-1, 1, 3) * far
    away *= apart / math.sqrt(float(away @ away))
    poses = [
        archive_cases.pose_of(archive_cases.random_rotation(rng), ORIGIN + at + d) for d in (0 * away, away)
    ]
    return Asked(*models, np.array(poses))


COUNTS = [(1, 1), (5, 40), (33, 33), (300, 8)]


@pytest.mark.parametrize("counts", COUNTS)
@pytest.mark.parametrize("far", [0.0, 1e8])
def test_contact_begins_at_the_unit_the_definition_says(counts: tuple[int, int], far: float) -> None:
    case = asked(sum(counts), counts, far)
    for turned in (False, True):
        assert case.ask(case.least, turned=turned)[0] == kernel.CONTACT
        assert case.ask(case.least - 1, turned=turned)[0] == kernel.CLEAR
        assert case.ask(case.least * 9 // 8, turned=turned)[0] == kernel.CONTACT
        assert case.ask(case.least * 7 // 8, turned=turned)[0] == kernel.CLEAR


def test_a_pair_farther_along_one_axis_than_any_reach_is_clear() -> None:
    """2^33 units along an axis: its square is 2^66, which 64 bits would take for 0."""
    ball = make_avatar([[0.0, 0, 0]], 0.0)
    poses = np.array([archive_cases.pose_of(np.eye(3), ORIGIN + d) for d in ([0, 0, 0], [0, 128.0, 0])])
    case = Asked(ball, ball, poses)
    one, other = (kernel.PlacedBody(ball.arrays, pose, tuple(pose[:3, 3] - ORIGIN)) for pose in poses)
    for reach in (1, 1 << 30):
        assert not kernel._points_touch(one, 0, 0, other, 0, 0, reach)
        assert case.ask(reach)[0] == kernel.CLEAR
    # 16 m, the farthest reach: to the unit.
    poses[1, :3, 3] = ORIGIN + np.array([0, 16.0, 0])
    assert Asked(ball, ball, poses).ask(1 << 30)[0] == kernel.CONTACT
    assert Asked(ball, ball, poses).ask((1 << 30) - 1)[0] == kernel.CLEAR


# --- the stop flag --------------------------------------------------------------------------------------


def test_pairs_after_the_stop_are_unknown_and_not_examined() -> None:
    """Also those whose root nodes are apart: 50,000 of them would take 20 ms."""
    model, n = make_avatar(np.zeros((1, 3)), 0.125), 40
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, 0, 3] = 10.0 * np.arange(n)
    pairs = np.array([(i, j) for i in range(n) for j in range(i + 1, n)])
    stop = StopFlag()
    for expected in (kernel.CLEAR, kernel.UNKNOWN):
        verdict, counters = np.full(len(pairs), 99, np.uint8), np.zeros(2, np.int64)
        kernel.touch_pairs(
            model.arrays, model.arrays, poses, np.full(n, 2**23), pairs, 0, ORIGIN, stop.flag,
            verdict, counters,
        )  # fmt: skip
        assert (verdict == expected).all()
        assert counters.tolist() == [0 if stop else len(pairs), 0]
        stop.set("test")
