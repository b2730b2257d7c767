"""Heights and sums of an avatar's patch, compared with numpy over all points."""

import os

import numpy as np
import pytest
from solidcloud.server.avatars.avatar_model import make_avatar
from solidcloud.server.kernels.bodies.avatar_patch import PATCH_STEPS, lowest_heights
from solidcloud.server.kernels.core.normal_codes import SUMS

pytestmark = pytest.mark.interpreted

COUNT = 60 if os.environ.get("NUMBA_DISABLE_JIT") == "1" else 1500


@pytest.mark.parametrize("reach", [1e-6, 0.05, 0.2, 2.0])
def test_heights_and_sums_are_those_of_the_surfaces_points_within_reach(
    rng: np.random.Generator, reach: float
) -> None:
    points = rng.uniform(-0.4, 0.4, (COUNT, 3))
    inner = 10
    model = make_avatar(points, 0.01, inner)
    directions = rng.normal(size=(3, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    heights, sums = np.empty(3), np.empty(SUMS, np.int64)
    for at in points[: -inner : COUNT // 20]:
        lowest_heights(model.reference, at, reach, directions, heights, sums)
        near = (points - at)[:-inner]
        near = near[(near**2).sum(axis=1) <= reach**2]
        np.testing.assert_allclose(heights, (near @ directions.T).min(axis=0), atol=1e-14)
        x, y, z = np.rint(near * PATCH_STEPS).astype(np.int64).T
        expected = [v.sum() for v in (x, y, z, x * x, y * y, z * z, y * z, z * x, x * y)]
        assert sums.tolist() == [len(near), *expected]


def test_a_patch_without_points_has_no_height() -> None:
    model = make_avatar([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], 0.1)
    heights, sums = np.full(1, 7.0), np.full(SUMS, 7, np.int64)
    at, along = np.array([0.5, 0.0, 0.0]), np.array([[1.0, 0.0, 0.0]])
    lowest_heights(model.reference, at, 0.1, along, heights, sums)
    assert heights[0] == 0.0 and not sums.any()
