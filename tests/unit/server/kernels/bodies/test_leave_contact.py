"""What rules points and nodes out changes no bit of the heights and times that motions in contact use.

Heights and sums of an avatar's patch are compared with numpy over all points.
"""

import os

import numpy as np
import pytest
from solidcloud.server.avatars.avatar_model import make_avatar
from solidcloud.server.kernels.bodies import leave_contact as kernel
from solidcloud.server.kernels.core.normal_codes import SUMS

COUNT = 60 if os.environ.get("NUMBA_DISABLE_JIT") == "1" else 1500


def test_heights_by_the_tree_are_those_of_all_centres(rng: np.random.Generator) -> None:
    for count in (1, 70, 3000):
        points = rng.normal(0.0, 0.4, (count, 3)) + np.array([7.0, -3.0, 0.5])
        body, found = make_avatar(points, 0.02).reference, np.empty(len(kernel.DIRECTIONS))
        kernel.find_heights(body, kernel.DIRECTIONS, found)
        x, y, z = points.T
        naive = [((a * x + b * y) + c * z).max() for a, b, c in kernel.DIRECTIONS]
        assert found.tolist() == naive


def test_points_beside_the_way_meet_nothing(rng: np.random.Generator) -> None:
    """Every point is examined if the avatar's box is without end."""
    centres = rng.uniform(-0.3, 0.3, (400, 3))
    body = make_avatar(centres, 0.02).reference
    points, reach = rng.uniform(-1.0, 1.0, (5000, 3)), rng.uniform(0.03, 0.05, 5000)
    box, none = np.array([centres.min(axis=0), centres.max(axis=0)]), np.zeros(5000, bool)
    met = 0
    for length in (0.0, 0.04, 0.5):
        found = []
        for each in (box, np.array([[-np.inf] * 3, [np.inf] * 3])):
            times, own = np.empty(5000), np.zeros((5000, 3))
            way, planes = np.array([length, -length / 2, 0.0]), np.empty((0, kernel.PLANE))
            kernel.meet_points(body, each, points, reach, none, planes, way, times, own)
            found.append(times.tobytes() + own.tobytes())
            met += int((times <= 1.0).sum())
        assert found[0] == found[1]
    assert met > 100


@pytest.mark.interpreted
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
        kernel.lowest_heights(model.reference, at, reach, directions, heights, sums)
        near = (points - at)[:-inner]
        near = near[(near**2).sum(axis=1) <= reach**2]
        np.testing.assert_allclose(heights, (near @ directions.T).min(axis=0), atol=1e-14)
        x, y, z = np.rint(near * kernel.PATCH_STEPS).astype(np.int64).T
        expected = [v.sum() for v in (x, y, z, x * x, y * y, z * z, y * z, z * x, x * y)]
        assert sums.tolist() == [len(near), *expected]


@pytest.mark.interpreted
def test_a_patch_without_points_has_no_height() -> None:
    model = make_avatar([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], 0.1)
    heights, sums = np.full(1, 7.0), np.full(SUMS, 7, np.int64)
    at, along = np.array([0.5, 0.0, 0.0]), np.array([[1.0, 0.0, 0.0]])
    kernel.lowest_heights(model.reference, at, 0.1, along, heights, sums)
    assert heights[0] == 0.0 and not sums.any()
