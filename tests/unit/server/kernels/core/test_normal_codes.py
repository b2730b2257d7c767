"""Compare the codes of surface normals of planes, edges, corners, balls and lines with numpy."""

import math

import naive_normals
import numpy as np
import pytest
from numpy.typing import NDArray
from solidcloud.schemas.errors import BadRequestError
from solidcloud.server.kernels.core.normal_codes import (
    LINE,
    NO_NORMAL,
    THICK,
    decode_normal,
    encode_normal,
    least_direction,
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


def test_every_code_names_a_direction_that_has_it() -> None:
    again = 0
    for high in range(1, 256, 7):
        for low in range(1, 256, 7):
            code = 256 * high + low
            other = int(encode_normal(*decode_normal(code)))
            # On the rim of the square, where z is 0, two codes are one direction, from either side.
            assert (
                other == code
                or naive_normals.angle(np.array(decode_normal(code)), np.array(decode_normal(other))) < 1e-6
            )
            again += other == code
    assert again > 1300


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


@pytest.mark.parametrize(("faces", "out"), [(2, [1.0, 1.0, 0.0]), (3, [1.0, 1.0, 1.0])])
def test_an_edge_and_a_corner_face_between_their_faces(faces: int, out: list[float]) -> None:
    rng = np.random.default_rng(3)
    flat = disc(rng, 3000, 800.0)
    points = []
    for face in range(faces):
        own = np.roll(flat, face + 1, axis=1)  # flat across axis `face`
        own = np.abs(own) if faces == 3 else np.where([True, True, False], np.abs(own), own)
        points.append(own)
    found = np.array(decode_normal(code_of(np.rint(np.concatenate(points)).astype(np.int64))))
    assert naive_normals.angle(found, np.array(out) / math.sqrt(faces)) < 2.0


def test_thresholds_are_where_they_are_said_to_be() -> None:
    """Of an ellipsoid's six ends the eigenvalues are as the squares of its axes."""
    ends = np.concatenate([np.eye(3, dtype=np.int64), -np.eye(3, dtype=np.int64)])
    rng = np.random.default_rng(4)
    kinds = set()
    for _ in range(400):
        squares = 10.0 ** rng.uniform(-7, 0, 3) if rng.integers(2) else rng.uniform(0.3, 1, 3)
        axes = np.rint(30_000 * np.sqrt(squares)).astype(np.int64)
        least, second, greatest = np.sort(axes.astype(float)) ** 2
        line, thick = second / greatest / LINE, least / second / THICK
        if min(abs(line - 1), abs(thick - 1)) < 1e-9:
            continue
        code = code_of(ends * axes)
        assert (code == NO_NORMAL) == (line <= 1 or thick > 1)
        kinds.add((line <= 1, thick > 1))
        if code != NO_NORMAL:
            assert decode_normal(code)[int(np.argmin(axes))] == 1.0
    assert kinds == {(False, False), (True, False), (False, True), (True, True)}


def test_few_points_lines_and_balls_have_no_normal() -> None:
    rng = np.random.default_rng(5)
    plane = np.array([[0, 0, 0], [300, 0, 0], [0, 300, 0]])
    assert code_of(plane) != NO_NORMAL
    assert code_of(plane[:2]) == code_of(plane[:1]) == NO_NORMAL
    assert code_of(np.zeros((50, 3), np.int64)) == code_of(np.full((3, 3), 7)) == NO_NORMAL
    for _ in range(20):
        way = rng.normal(size=3)
        line = np.rint(np.outer(rng.uniform(-800, 800, 40), way)).astype(np.int64)
        assert code_of(line) == NO_NORMAL
    ball = rng.normal(size=(4000, 3))
    assert code_of(np.rint(ball * 500).astype(np.int64)) == NO_NORMAL


def test_least_direction_is_numpys() -> None:
    rng = np.random.default_rng(6)
    for _ in range(300):
        values = np.sort(10.0 ** rng.uniform(-8, 0, 3))
        values /= values.sum()
        turn = turned(rng)
        matrix = (turn * values) @ turn.T
        found, vector = least_direction(
            matrix[0, 0], matrix[1, 1], matrix[2, 2], matrix[1, 2], matrix[2, 0], matrix[0, 1]
        )
        assert np.allclose(found, np.linalg.eigvalsh(matrix), rtol=0, atol=4e-16 * 4)
        residue = matrix @ np.array(vector) - found[0] * np.array(vector)
        assert np.abs(residue).max() < 1e-15 and abs(np.linalg.norm(vector) - 1) < 1e-14


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
