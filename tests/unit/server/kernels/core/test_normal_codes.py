"""Compare the codes of surface normals of planes, edges, corners, balls and lines with numpy."""

import math

import naive_normals
import numpy as np
import pytest
from numpy.typing import NDArray
from solidcloud.schemas.errors import BadRequestError
from solidcloud.server.kernels.core.normal_codes import (
    THICK,
    decode_normal,
    encode_normal,
    normal_code,
    squared_reach,
)

pytestmark = pytest.mark.interpreted

COARSE = 0.56  # of codes [degrees]
GOLDEN = [32896, 23417, 37545, 28847, 16575, 30947]


def code_of(away: NDArray[np.int64]) -> int:
    """The code of a point of these differences (n, 3) to its neighbours."""
    x, y, z = away.T
    sums = np.array(
        [len(away), *(column.sum() for column in (x, y, z, x * x, y * y, z * z, y * z, z * x, x * y))]
    )
    return int(normal_code(sums))


def turned(rng: np.random.Generator) -> NDArray[np.float64]:
    """A rotation (3, 3), any."""
    return np.linalg.qr(rng.normal(size=(3, 3)))[0]


def disc(rng: np.random.Generator, count: int, radius: float) -> NDArray[np.float64]:
    """Points (count, 3) in a disc about the origin, z = 0."""
    angle, out = rng.uniform(0, 2 * np.pi, count), radius * np.sqrt(rng.uniform(0, 1, count))
    return np.stack([out * np.cos(angle), out * np.sin(angle), np.zeros(count)], axis=1)


def test_codes_are_off_by_half_a_degree_and_axes_by_nothing() -> None:
    rng = np.random.default_rng(1)
    for vector in rng.normal(size=(500, 3)):
        unit = vector / np.linalg.norm(vector)
        for scale in (1.0, -1.0, 1e-3):
            code = int(encode_normal(*(scale * vector)))
            assert code >> 8 and code & 0xFF and code < 1 << 16
            found = np.array(decode_normal(code))
            assert abs((found**2).sum() - 1.0) < 1e-15 and found[2] >= 0
            assert naive_normals.angle(found, unit) < COARSE
    for axis in np.eye(3):
        assert decode_normal(encode_normal(*axis)) == decode_normal(encode_normal(*-axis)) == tuple(axis)


@pytest.mark.parametrize("noise", [0.0, 0.5, 20.0])
def test_a_plane_is_found_as_numpy_finds_it(noise: float) -> None:
    rng = np.random.default_rng(2)
    for _ in range(20):
        turn = turned(rng)
        points = disc(rng, int(rng.integers(6, 80)), 800.0)
        points[:, 2] += rng.normal(0, noise, len(points))
        away = np.rint(points @ turn.T).astype(np.int64)
        expected = naive_normals.find(away, np.zeros(3, np.int64), 1 << 40)
        assert expected is not None and expected.values[0] < THICK * expected.values[1]
        found = np.array(decode_normal(code_of(away)))
        assert naive_normals.angle(found, expected.normal) < COARSE
        if noise < 1:
            assert naive_normals.angle(found, turn[:, 2]) < 1.0


def test_sums_of_the_farthest_points_are_exact() -> None:
    """A wall at the end of 63 bits: no sum of what `normal_reach` lets pass overflows."""
    count = 1 << 23
    square = squared_reach(1.0, 1e-6, count)
    assert square == 10**12 and count * square < 1 << 63
    x, y = 600_000, 800_000
    n = count // 4
    sums = np.array([4 * n, 0, 0, 0, 4 * n * x * x, 4 * n * y * y, 0, 0, 0, 0])  # points (+-x, +-y, 0)
    assert sums[5] == 4 * n * y * y > 1 << 60
    assert decode_normal(normal_code(sums)) == (0.0, 0.0, 1.0)


def test_reach_counts_as_its_decimal_text_and_has_bounds() -> None:
    assert squared_reach(0.08, 1e-4, 1) == 800**2
    assert squared_reach(0.08, 0.0003, 1) == 80_000_000 // 1125  # (800 / 3)^2
    assert squared_reach(1, 0.5, 1) == 4
    for reach in (0.0, -0.1, math.nan, math.inf, 1.01):
        with pytest.raises(BadRequestError, match="normal reach"):
            squared_reach(reach, 1e-4, 1)
    with pytest.raises(BadRequestError, match="63 bits: give at most 0"):
        squared_reach(1.0, 1e-6, 1 << 24)


def test_codes_are_these_on_any_machine() -> None:
    """No operation is in them but those that IEEE 754 rounds, and no sum but of integers."""
    i = np.arange(1, 400, dtype=np.int64)
    cloud = np.stack([i * 7919 % 1603 - 801, i * 104729 % 1601 - 800, i * i % 211], axis=1)
    shears = [(1, 0, 0), (-3, 2, 1), (5, 7, -2), (1, 1, 1), (0, -4, 3), (2, -2, 9)]
    found = [code_of(cloud @ np.array([[2, a, 0], [b, 3, c], [c, 0, 1]])) for a, b, c in shears]
    assert found == GOLDEN
