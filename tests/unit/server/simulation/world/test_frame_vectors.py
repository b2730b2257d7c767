"""Vectors and rotations of a frame: what they are, and that their bits are those of one order of sums."""

import math

import numpy as np
import pytest
from solidcloud.server.simulation.world.frame import (
    dot,
    frobenius_norm,
    horizontal,
    min_height,
    multiply,
    norm,
    rotate,
    rotate_back,
    rotation_matrix,
    unit_vector,
)

pytestmark = pytest.mark.interpreted
UP = np.array([0.0, 0.0, 1.0])


@pytest.mark.parametrize("angle", [0.0, 1e-9, math.pi / 2, math.pi, 4.0, -2.0, -40.0])
def test_rotation_is_that_of_its_angle(angle: float) -> None:
    c, s = math.cos(angle), math.sin(angle)
    found = rotation_matrix(UP, angle)
    assert np.allclose(found, [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], atol=1e-14)
    axis = unit_vector((1.0, -2.0, 0.5))
    turn = rotation_matrix(axis, angle)
    assert np.allclose(turn @ turn.T, np.eye(3), atol=1e-14) and np.allclose(turn @ axis, axis, atol=1e-15)


def test_products_are_numpys_but_for_rounding(rng: np.random.Generator) -> None:
    for _ in range(50):
        one, other = rng.normal(size=(2, 4, 4))
        a, b = rng.normal(size=(2, 3))
        assert np.allclose(rotate(one, a), one[:3, :3] @ a, rtol=1e-13, atol=1e-13)
        assert np.allclose(rotate_back(one, a), one[:3, :3].T @ a, rtol=1e-13, atol=1e-13)
        assert np.allclose(multiply(one, other), one[:3, :3] @ other[:3, :3], rtol=1e-13, atol=1e-13)
        assert dot(a, b) == pytest.approx(float(a @ b), abs=1e-13)
        assert norm(a) == pytest.approx(float(np.linalg.norm(a)), rel=1e-14)
        assert frobenius_norm(one[:3, :3]) == pytest.approx(float(np.linalg.norm(one[:3, :3])), rel=1e-14)
        assert abs(dot(horizontal(a, UP), UP)) < 1e-15 and np.allclose(horizontal(a, UP)[:2], a[:2])
        points = rng.normal(size=(20, 3))
        assert min_height(points, b) == pytest.approx(float((points @ b).min()), abs=1e-13)
