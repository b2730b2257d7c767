"""Test that a walk through an unknown scan stays on the floor."""

import numpy as np
import pytest
from solidcloud.schemas.errors import BadDataError
from solidcloud.server.report.common.floor_walk import LAYER, SOLE, floor_walk


def hall(rng: np.random.Generator, turned: bool = False) -> np.ndarray:
    """Return a hall of 20 by 8 m with a floor rising from 1 to 2 m and a ceiling 4 m above.

    Outliers lie below and beside it.
    """
    x, y = rng.uniform(0, 20, 60_000), rng.uniform(0, 8, 60_000)
    floor = np.column_stack([x, y, 1 + x / 20])
    ceiling = np.column_stack([x, y, 5 + x / 20])[:20_000]
    stray = np.column_stack([rng.uniform(-90, 90, (60, 2)), rng.uniform(-9, -3, 60)])
    points = np.concatenate([floor, ceiling, stray])
    return points[:, [1, 0, 2]] if turned else points


@pytest.mark.parametrize("turned", [False, True])
def test_feet_stay_just_above_the_floor(turned: bool, rng: np.random.Generator) -> None:
    times, poses = floor_walk(hall(rng, turned))
    along, across = (1, 0) if turned else (0, 1)
    at = poses[:, :3, 3]
    assert times[-1] == pytest.approx(1199 / 30) and len(poses) == 1200
    assert at[0, along] < 1 and at[-1, along] > 19 and np.abs(at[:, across] - 4).max() < 0.2
    above = at[:, 2] - (1 + np.clip(at[:, along], 0, 20) / 20)
    inside = (at[:, along] > 1) & (at[:, along] < 19)
    assert above[inside].min() > SOLE - 1.5 / 20 and above[inside].max() < SOLE + 2 * LAYER


@pytest.mark.parametrize("turned", [False, True])
def test_figure_is_upright_and_faces_its_way(turned: bool, rng: np.random.Generator) -> None:
    _, poses = floor_walk(hall(rng, turned))
    turn = poses[0, :3, :3]
    assert np.array_equal(turn @ turn.T, np.eye(3)) and np.linalg.det(turn) == 1
    assert turn[:, 2].tolist() == [0, 0, 1]
    step = poses[-1, :3, 3] - poses[0, :3, 3]
    assert turn[:2, 1] @ step[:2] == pytest.approx(np.linalg.norm(step[:2]))


@pytest.mark.parametrize("points", [np.empty((0, 3)), np.array([[0.0, 0, 0], [50, 0, 0]])])
def test_scan_without_a_floor_is_refused(points: np.ndarray) -> None:
    with pytest.raises(BadDataError, match="expected a floor"):
        floor_walk(points)
