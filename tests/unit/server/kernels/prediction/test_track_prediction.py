"""Ways ahead and the voxels they bring within reach, against brute force over all voxels at many moments."""

import os

import numpy as np
import pytest
from numpy.typing import NDArray
from solidcloud.schemas.archive.voxel_grid import KEY_BIAS
from solidcloud.schemas.kernels.morton import morton_encode
from solidcloud.server.kernels.core.voxels_in_reach import SceneIndex
from solidcloud.server.kernels.prediction.track_prediction import (
    PredictionLimits,
    predict_path,
    rows_ahead,
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
@pytest.mark.parametrize(("side", "count", "reach"), [(6, 700, 40), (3, 300, 0)])
def test_what_is_wanted_is_what_brute_force_finds(side: int, count: int, reach: float, ring: float) -> None:
    rng = np.random.default_rng([side, count])
    index = scattered(rng, side, count)
    met = 0
    for turn in range(40):
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


# --- where users will be --------------------------------------------------------------------------------


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
