"""Ways ahead and the voxels they bring within reach, against brute force over all voxels at many moments."""

import os

import numpy as np
import pytest
from numpy.typing import NDArray
from solidcloud.schemas.archive.voxel_grid import KEY_BIAS
from solidcloud.schemas.kernels.morton import morton_encode
from solidcloud.server.kernels.core.voxels_in_reach import SceneIndex
from solidcloud.server.kernels.prediction import track_prediction
from solidcloud.server.kernels.prediction.track_prediction import (
    MAX_CELLS,
    PredictionLimits,
    first_touch,
    fit_motion,
    predict_path,
    rows_ahead,
    rows_in_reach,
    write_path_distances,
)

pytestmark = pytest.mark.interpreted

INTERPRETED = os.environ.get("NUMBA_DISABLE_JIT") == "1"
VOXEL_STEPS = 100
MOTION = PredictionLimits(history=0.5, speed=15.0, acceleration=6.0, fade=0.5)


def scattered(rng: np.random.Generator, side: int, count: int) -> SceneIndex:
    """Voxels about the origin of the lattice, each with a box of points inside it."""
    coordinates = np.unique(rng.integers(-side, side, (count, 3)), axis=0)
    keys = morton_encode((coordinates + KEY_BIAS).astype(np.uint64))
    order = np.argsort(keys)
    base = coordinates[order] * VOXEL_STEPS
    ends = np.sort(rng.integers(0, VOXEL_STEPS, (2, len(base), 3)), axis=0)
    low, high = base + ends[0], base + ends[1]
    return SceneIndex(keys[order], low, high, low.min(axis=0), high.max(axis=0))


def gaps(index: SceneIndex, centers: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distances (k, v) from places (k, 3) to the boxes of all voxels."""
    away = np.maximum(np.maximum(index.low - centers[:, None], centers[:, None] - index.high), 0)
    return np.sqrt((away**2).sum(axis=2))


def walked(places: NDArray[np.float64], rate: float = 30.0) -> NDArray[np.float64]:
    """Poses (h, 4) of places (h, 3) at an even rate."""
    return np.column_stack([np.arange(len(places)) / rate, places])


# --- which voxels ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("ring", [0.0, 60.0])
@pytest.mark.parametrize(("side", "count", "reach"), [(2, 20, 15), (6, 700, 40), (40, 900, 400), (3, 300, 0)])
def test_what_is_wanted_is_what_brute_force_finds(side: int, count: int, reach: float, ring: float) -> None:
    rng = np.random.default_rng([side, count])
    index = scattered(rng, side, count)
    met = 0
    for turn in range(6 if INTERPRETED and reach > 100 else 40):
        way = np.cumsum(rng.normal(0, 1, (9, 3)) * rng.choice([0.0, 5.0, 60.0], (9, 1)), axis=0)
        way += index.low[rng.integers(len(index.low))] + rng.uniform(-20, 20, 3)
        if turn % 5 == 0:
            way[:] = way[0]  # stands
        rows, need = np.full(1000, -1), np.full(1000, np.nan)
        found = rows_ahead(way, reach, ring, index, VOXEL_STEPS, rows, need)
        rows, need = rows[:found], need[:found]
        assert len(set(rows.tolist())) == found
        each = list(zip(need.tolist(), rows.tolist(), strict=True))
        assert each == sorted(each), "soonest first, of equals by row"
        along = np.linspace(0, 8, 401)
        centers = np.column_stack([np.interp(along, np.arange(9), way[:, k]) for k in range(3)])
        apart = gaps(index, centers)
        touched = (apart <= reach).any(axis=0)
        on_way = need <= 8
        assert set(np.flatnonzero(touched).tolist()) <= set(rows[on_way].tolist())
        # Between moments the ball moves at most half of what it moves from one to the next.
        between = np.linalg.norm(np.diff(centers, axis=0), axis=1).max() / 2
        assert (apart[:, rows[on_way]].min(axis=0) <= reach + between + 1e-6).all()
        for row, when in zip(rows[on_way].tolist(), need[on_way].tolist(), strict=True):
            here = np.array([[np.interp(when, np.arange(9), way[:, k]) for k in range(3)]])
            moved = np.linalg.norm(way[min(int(when), 7) + 1] - way[min(int(when), 7)])
            assert gaps(index, here)[0, row] <= reach + moved / 2048 + 1e-6, (
                "no sooner than it touches, but a little"
            )
            if touched[row]:
                assert when <= along[np.argmax(apart[:, row] <= reach)] + 1e-9, "never late"
        around = apart[0] <= reach + ring
        assert set(rows[~on_way].tolist()) == (
            set(np.flatnonzero(around & ~touched).tolist()) - set(rows[on_way].tolist())
        )
        if ring:
            expected = 9 + (apart[0, rows[~on_way]] - reach) / ring
            assert np.allclose(need[~on_way], expected)
        else:
            assert on_way.all()
        met += found
    assert met > 10


def test_of_more_than_there_is_room_for_the_first_pieces_come_first() -> None:
    """A row of voxels that each hold one point, walked along."""
    coordinates = np.array([[i, 0, 0] for i in range(20)])
    keys = morton_encode((coordinates + KEY_BIAS).astype(np.uint64))
    order = np.argsort(keys)
    base = coordinates[order] * VOXEL_STEPS
    index = SceneIndex(keys[order], base, base, base.min(axis=0), base.max(axis=0))
    way = np.column_stack([np.linspace(-20, 1800, 14), np.zeros((14, 2))])
    rows, need = np.empty(5, np.int64), np.empty(5)
    assert rows_ahead(way, 10.0, 500.0, index, VOXEL_STEPS, rows, need) == 5
    assert (base[rows, 0] == [0, 100, 200, 300, 400]).all()
    assert np.allclose(need, (np.array([0, 100, 200, 300, 400]) - 10 + 20) / 140, atol=1 / 2048)


def test_far_outside_the_scene_nothing_is_wanted() -> None:
    index = scattered(np.random.default_rng(3), 3, 50)
    rows, need = np.empty(9, np.int64), np.empty(9)
    for place in (1e9, -1e300, 1e18):
        assert rows_ahead(np.full((3, 3), place), 50.0, 50.0, index, VOXEL_STEPS, rows, need) == 0
    empty = SceneIndex(index.keys[:0], index.low[:0], index.high[:0], index.scene_low, index.scene_high)
    assert rows_ahead(np.zeros((3, 3)), 50.0, 50.0, empty, VOXEL_STEPS, rows, need) == 0


@pytest.mark.parametrize(("beyond", "found"), [(-1, 1), (0, 0)])
def test_no_more_cells_are_looked_at_than_are_said(
    monkeypatch: pytest.MonkeyPatch, beyond: int, found: int
) -> None:
    """A row of voxels that a ball comes down to at its end, which is looked at last."""
    most = 500 if INTERPRETED else MAX_CELLS
    monkeypatch.setattr(track_prediction, "MAX_CELLS", most)
    count = most + 1 + beyond
    coordinates = np.column_stack([np.arange(count), np.zeros((count, 2), np.int64)])
    base = coordinates * VOXEL_STEPS
    keys = morton_encode((coordinates + KEY_BIAS).astype(np.uint64))
    index = SceneIndex(keys, base, base, base[0], base[-1] + [0, 300, 0])
    way = np.array([base[0] + [0, 200, 0], base[-1]], np.float64)
    rows, need = np.empty(9, np.int64), np.empty(9)
    assert rows_ahead(way, 1e-3, 0.0, index, VOXEL_STEPS, rows, need) == found


def test_a_ball_that_passes_by_touches_where_it_is_nearest(rng: np.random.Generator) -> None:
    """Along an edge and past a corner, by a little less than its reach and a little more."""
    low, high = np.zeros(3), np.full(3, 10.0)
    for corner in ([10.0, 10.0, 10.0], [10.0, 10.0, 5.0], [10.0, 4.0, 5.0]):
        out = (np.array(corner) - 5.0) * (np.array(corner) == 10.0)
        out /= np.linalg.norm(out)
        along = np.cross(out, rng.normal(size=3))
        along /= np.linalg.norm(along)
        if corner[2] == 5.0:  # or the piece is nearest to another place of the edge
            along = np.cross(out, [0.0, 0.0, 1.0]) if corner[1] == 10.0 else along
        nearest = np.array(corner) + out * 3.0
        way = np.array([nearest - along * 4.0, nearest + along * 2.0])
        assert first_touch(way, 0, low, high, 3.0 - 1e-6) == -1.0
        assert 0.0 <= first_touch(way, 0, low, high, 3.0 + 1e-6) <= 4.0 / 6.0
        assert first_touch(way, 0, low, high, 50.0) == 0.0


@pytest.mark.parametrize(("side", "count"), [(2, 20), (6, 700), (40, 900)])
def test_what_balls_touch_is_what_brute_force_finds(side: int, count: int) -> None:
    rng = np.random.default_rng([side, count])
    index = scattered(rng, side, count)
    centers = rng.uniform(-side - 1, side + 1, (60, 3)) * VOXEL_STEPS
    centers[:20] = index.low[rng.integers(len(index.low), size=20)] + rng.uniform(-30, 30, (20, 3))
    reaches = rng.choice([0.0, 20.0, 90.0], 60)
    starts, rows = np.empty(61, np.int64), np.full(9000, -1)
    needed = rows_in_reach(centers, reaches, index, VOXEL_STEPS, starts, rows)
    assert needed == starts[-1] > 0 and starts[0] == 0
    touched = gaps(index, centers) <= reaches[:, None]
    for i in range(60):
        assert sorted(rows[starts[i] : starts[i + 1]].tolist()) == np.flatnonzero(touched[i]).tolist()
    few = np.full(needed // 2, -1)
    assert rows_in_reach(centers, reaches, index, VOXEL_STEPS, starts, few) == needed
    assert few.tolist() == rows[: needed // 2].tolist()


def test_distance_to_ways_is_the_least_of_all(rng: np.random.Generator) -> None:
    index = scattered(rng, 5, 90)
    ways = rng.uniform(-600, 600, (4, 6, 3))
    rows, far = rng.integers(0, len(index.keys), 30), np.empty(30)
    write_path_distances(ways, rows, index, far)
    assert np.allclose(far, gaps(index, ways.reshape(-1, 3)).min(axis=0)[rows])
    write_path_distances(ways[:0], rows, index, far)
    assert np.isinf(far).all()


# --- where users will be --------------------------------------------------------------------------------


@pytest.mark.parametrize("offset", [0.0, 5e6])
def test_straight_and_even_is_seen_as_such(offset: float) -> None:
    t = np.arange(16) / 30
    poses = walked(offset + t[:, None] * np.array([1.5, -0.5, 0.1]))
    velocity, acceleration = fit_motion(poses, MOTION)
    assert np.allclose(velocity, [1.5, -0.5, 0.1], atol=0.05) and np.linalg.norm(acceleration) < 0.2


def test_acceleration_is_seen() -> None:
    t = np.arange(16)[:, None] / 30
    velocity, acceleration = fit_motion(walked(t**2 * [1.0, 0.0, 0.0]), MOTION)
    assert np.allclose(velocity, [1.0, 0, 0], atol=0.1) and np.allclose(acceleration, [2.0, 0, 0], atol=0.3)


def test_few_poses_and_equal_times_say_little() -> None:
    for poses in (np.array([[3.0, 1, 2, 3]]), np.array([[3.0, 1, 2, 3], [3.0, 2, 2, 3], [3.0, 1, 5, 3]])):
        velocity, acceleration = fit_motion(poses, MOTION)
        assert (velocity == 0).all() and (acceleration == 0).all()
    two = np.array([[0.0, 0, 0, 0], [1 / 30, 0.05, 0, 0]])
    velocity, _ = fit_motion(two, MOTION)
    assert 1.0 < velocity[0] <= 1.5 and (velocity[1:] == 0).all()


def test_what_is_older_than_the_history_says_nothing() -> None:
    t = np.concatenate([np.arange(30) / 30, 2.0 + np.arange(16) / 30])
    still = np.concatenate([np.arange(30) / 3, np.full(16, 10.0)])
    velocity, acceleration = fit_motion(np.column_stack([t, still, still, still]), MOTION)
    assert (velocity == 0).all() and (acceleration == 0).all()


@pytest.mark.parametrize("seed", range(5))
def test_jitter_of_clock_and_place_moves_a_prediction_little(seed: int) -> None:
    rng = np.random.default_rng(seed)
    t = np.arange(16) / 30
    places = t[:, None] * [1.5, 0.0, 0.0] + rng.normal(0, 0.01, (16, 3))
    late = np.maximum.accumulate(t + rng.uniform(0, 0.01, 16))
    way = np.empty((17, 3))
    predict_path(np.column_stack([late, places]), MOTION, 1.0, way)
    assert np.linalg.norm(way[-1] - [2.0, 0, 0]) < 0.5


def test_turning_is_followed() -> None:
    """A circle of 1.5 m at 1.5 m/s: half a second ahead the prediction is nearer than a straight line is."""
    angle = np.arange(16) / 30
    poses = walked(1.5 * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle]))
    way = np.empty((17, 3))
    predict_path(poses, MOTION, 0.5, way)
    end = angle[-1] + 0.5
    truth = 1.5 * np.array([np.cos(end), np.sin(end), 0])
    straight = poses[-1, 1:] + 0.75 * np.array([-np.sin(angle[-1]), np.cos(angle[-1]), 0])
    assert np.linalg.norm(way[-1] - truth) < np.linalg.norm(straight - truth) * 0.6
    assert np.array_equal(way[0], poses[-1, 1:])


@pytest.mark.parametrize("power", [1, 2, 3])
def test_no_motion_is_beyond_its_bounds(power: int) -> None:
    t = np.arange(16)[:, None] / 30
    velocity, acceleration = fit_motion(walked(1e3 * t**power * [1.0, -1.0, 0.5]), MOTION)
    assert np.linalg.norm(velocity) == pytest.approx(MOTION.speed)
    assert np.linalg.norm(acceleration) <= MOTION.acceleration * (1 + 1e-9)
    if power > 1:
        assert np.linalg.norm(acceleration) == pytest.approx(MOTION.acceleration)


def test_acceleration_fades_so_that_what_is_far_ahead_goes_straight() -> None:
    """At 1 m/s, gaining 2 m/s a second: after half a second some 60 % of a second's worth, then hardly more."""
    t = np.arange(16)[:, None] / 30
    way = np.empty((17, 3))
    predict_path(walked((0.5 * t + t**2) * [1.0, 0.0, 0.0]), MOTION, 4.0, way)
    velocity, gained = 1.5, 2.0 * MOTION.fade
    expected = velocity * 4.0 + gained * (4.0 - MOTION.fade * (1 - np.exp(-4.0 / MOTION.fade)))
    assert way[-1, 0] - way[0, 0] == pytest.approx(expected, rel=0.05)
    speeds = np.diff(way[:, 0]) / 0.25
    assert speeds[1] > speeds[0] + 0.1 and speeds[-1] - speeds[-2] < 0.01


@pytest.mark.parametrize("power", [1, 2, 3])
def test_no_way_is_longer_than_people_go(power: int) -> None:
    t = np.arange(16)[:, None] / 30
    way = np.empty((17, 3))
    predict_path(walked(1e3 * t**power * [1.0, -1.0, 0.5]), MOTION, 2.0, way)
    assert np.isfinite(way).all()
    lengths = np.linalg.norm(np.diff(way, axis=0), axis=1)
    assert (lengths <= MOTION.speed * 2.0 / 16 + 1e-9).all() and lengths.sum() > 10


def test_of_no_time_ahead_the_user_stands() -> None:
    way = np.empty((5, 3))
    for seconds in (0.0, -3.0):
        predict_path(walked(np.arange(48.0).reshape(16, 3)), MOTION, seconds, way)
        assert (way == [45.0, 46.0, 47.0]).all()
