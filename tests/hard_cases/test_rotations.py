"""Hard cases of Euler angles and quaternions at their limits; a test's number is its row in NUMERICS.md."""

import itertools
import math
import sys
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import archive_cases
import numpy as np
import pytest
from numpy.typing import NDArray
from solidcloud import poses
from solidcloud.schemas.errors import BadRequestError
from solidcloud.server.cli.input.pose_file import read_poses

Floats = NDArray[np.float64]
Rows = list[list[Fraction]]
# NUMERICS.md, cases 37 and 38: largest error of a number of a rotation.
WITHIN = Fraction(1, 10**15)
# Fixed point: the largest float64 has 1024 bits before the point, and 300 remain behind it.
BITS = 1400
TINY, LARGEST = 5e-324, sys.float_info.max
QUARTER = math.pi / 2


def arctangent(n: int) -> int:
    """Return atan(1/n) in fixed point, by Gregory's series."""
    total, term = 0, (1 << BITS) // n
    for k in itertools.count():
        if term == 0:
            return total
        total += (-1) ** k * (term // (2 * k + 1))
        term //= n * n
    raise AssertionError


# Machin's formula.
PI = 4 * (4 * arctangent(5) - arctangent(239))


def sine_cosine(angle: float) -> tuple[Fraction, Fraction]:
    """Return sine and cosine of an angle [rad], to 2^-300, by their power series."""
    exact = Fraction(angle)
    turns, left = divmod(exact.numerator * (1 << BITS) // exact.denominator, 2 * PI)
    assert turns < 1 << 1024
    sums, term = [0, 0, 0, 0], 1 << BITS
    for k in itertools.count(1):
        sums[(k - 1) % 4] += term
        term = (term * left >> BITS) // k
        if term == 0:
            break
    if abs(exact) < Fraction(1, 1 << 200):  # below the fixed point
        return exact, Fraction(1)
    return Fraction(sums[1] - sums[3], 1 << BITS), Fraction(sums[0] - sums[2], 1 << BITS)


def product(a: Rows, b: Rows) -> Rows:
    """Return the product of two matrices."""
    return [[sum((x * y for x, y in zip(row, column, strict=True)), Fraction(0)) for column in zip(*b, strict=True)]
            for row in a]  # fmt: skip


def euler_rotation(angles: Sequence[float], axes: str) -> Rows:
    """Return the rotation of successive angles, by the definition of extrinsic and intrinsic axes."""
    found = [[Fraction(i == j) for j in range(3)] for i in range(3)]
    for angle, axis in zip(angles, axes, strict=True):
        first = "xyz".index(axis.lower())
        second, third = (first + 1) % 3, (first + 2) % 3
        sine, cosine = sine_cosine(angle)
        turn = [[Fraction(0)] * 3 for _ in range(3)]
        turn[first][first] = Fraction(1)
        turn[second][second] = turn[third][third] = cosine
        turn[third][second], turn[second][third] = sine, -sine
        found = product(turn, found) if axes.islower() else product(found, turn)
    return found


def quaternion_rotation(w: float, x: float, y: float, z: float) -> Rows:
    """Return the rotation of a quaternion of any length but zero, exactly."""
    a, b, c, d = map(Fraction, (w, x, y, z))
    square = a * a + b * b + c * c + d * d
    rows = [
        [a * a + b * b - c * c - d * d, 2 * (b * c - a * d), 2 * (b * d + a * c)],
        [2 * (b * c + a * d), a * a - b * b + c * c - d * d, 2 * (c * d - a * b)],
        [2 * (b * d - a * c), 2 * (c * d + a * b), a * a - b * b - c * c + d * d],
    ]
    return [[number / square for number in row] for row in rows]


def assert_rotation(found: Floats, expected: Rows) -> None:
    """Assert that a pose is a rotation: each number within the bound, and the product with its transpose."""
    rows = [[Fraction(number) for number in row] for row in found[:3, :3].tolist()]
    for own, right in zip(rows, expected, strict=True):
        for number, exact in zip(own, right, strict=True):
            assert abs(number - exact) <= WITHIN, (float(number), float(exact))
    gram = product(rows, [list(column) for column in zip(*rows, strict=True)])
    for i, j in itertools.product(range(3), repeat=2):
        # Three products, each off by twice the error of a number.
        assert abs(gram[i][j] - (i == j)) <= 6 * WITHIN
    assert found[3].tolist() == [0.0, 0.0, 0.0, 1.0] and found[:3, 3].tolist() == [0.0, 0.0, 0.0]


def angles_at_limits() -> list[float]:
    """Return quarter turns and their neighbours, many turns, and tiny angles, of either sign."""
    locks = [float(k * QUARTER) for k in range(5)]
    locks += [math.nextafter(lock, to) for lock in locks[1:] for to in (0.0, 9.0)]
    turns = [2e3 * math.pi, 1e6 + 0.1, 1e15, 1e22, 2.0**60, 2.0**200, 1e300, LARGEST]
    tiny = [0.0, TINY, 1e-310, 2.0**-1022, 1e-160, 1e-17, 2.0**-53, 1e-9]
    return [sign * angle for angle in (*locks, *turns, *tiny, 0.3) for sign in (1.0, -1.0)]


@pytest.mark.case(
    37, "Euler angles at ±90° and beside it, of 1e300 rad and of 5e-324: the exact rotation to 1e-15 a number"
)
@pytest.mark.parametrize("axes", ["xyz", "ZYX", "zxz", "YXY"])
def test_case_37_euler_angles_at_their_limits(axes: str) -> None:
    assert abs(Fraction(PI, 1 << BITS) - Fraction(math.pi)) < Fraction(1, 1 << 52)
    limits, rng = angles_at_limits(), np.random.default_rng(37)
    for middle in limits:
        angles = [float(rng.choice(limits)), middle, float(rng.choice(limits))]
        assert_rotation(poses.from_euler(angles, axes=axes), euler_rotation(angles, axes))


@pytest.mark.case(
    37,
    "one angle: sine and cosine to 2^-51 of themselves; at gimbal lock outer angles of one sum are one rotation",
)
def test_case_37_tiny_angles_and_gimbal_lock() -> None:
    for angle in angles_at_limits():
        found = poses.from_euler(angle, axes="z")
        sine, cosine = sine_cosine(angle)
        for number, exact in ((found[1, 0], sine), (found[0, 0], cosine), (-found[0, 1], sine)):
            # Numbers below 2^-1022 have a fixed distance from one another.
            allowed = max(abs(exact) * Fraction(1, 1 << 51), Fraction(TINY))
            assert abs(Fraction(float(number)) - exact) <= allowed, (angle, number)
    # The quarter turn about Y takes the axis of roll to that of yaw, or to its opposite.
    for side in (1.0, -1.0):
        same = [poses.from_euler((yaw, side * QUARTER, side * roll), axes="ZYX")
                for yaw, roll in ((0.5, 0.25), (0.75, 0.5), (2.0**-30, 2.0**-30 - 0.25))]  # fmt: skip
        assert np.abs(np.array(same) - same[0]).max() <= 2e-15


def quaternions_at_limits() -> list[tuple[float, ...]]:
    """Return quaternions (w, x, y, z) of tiny and huge lengths, nearly half turns, and mixtures."""
    lengths = [TINY, 3 * TINY, 1e-310, 2.0**-1022, 1e-160, 1e-9, 1 - 1e-6, 3.0, 1e150, 1e200, LARGEST / 2]
    shapes = [(1.0, 0.0, 0.0, 0.0), (0.5, 0.5, -0.5, 0.5), (0.1, -0.7, 0.3, 0.9), (1.0, 1.0, 1.0, 2.0)]
    found: list[tuple[float, ...]] = []
    found += [tuple(length * number for number in shape) for length in lengths for shape in shapes]
    found += [(LARGEST, -LARGEST, LARGEST, LARGEST), (LARGEST, TINY, 0.0, 1.0), (TINY, 0.0, TINY, -TINY)]
    # Half turns, and w so small that its square, or the number itself, is lost beside the others.
    for w in (0.0, -0.0, TINY, 1e-200, 1e-17, 1e-9, 1e-8, 1e-4):
        found += [(w, 1.0, 0.0, 0.0), (w, 0.6, 0.0, -0.8), (w, -0.3, 0.2, 0.7)]
    # Rotations by as little.
    found += [(1.0, tiny, -tiny, 0.0) for tiny in (TINY, 1e-200, 1e-17, 1e-9)]
    return [quaternion for quaternion in found if any(quaternion)]


@pytest.mark.case(
    38,
    "lengths of 5e-324 to 1.7e308, half turns, either sign: the exact rotation to 1e-15 a number, -q that of q",
)
def test_case_38_quaternions_at_their_limits() -> None:
    given = np.array(quaternions_at_limits())
    found = poses.from_quaternion(given, order="wxyz")
    for quaternion, pose in zip(given.tolist(), found, strict=True):
        assert_rotation(pose, quaternion_rotation(*quaternion))
    assert np.array_equal(poses.from_quaternion(-given, order="wxyz"), found)
    assert np.array_equal(poses.from_quaternion(np.roll(given, -1, axis=1), order="xyzw"), found)
    # A power of two changes no digit.
    assert np.array_equal(
        poses.from_quaternion(np.array([0.1, -0.7, 0.3, 0.9]) * 2.0**900, order="wxyz"),
        poses.from_quaternion([0.1, -0.7, 0.3, 0.9], order="wxyz"),
    )


@pytest.mark.case(
    38,
    "zero of either sign and NaN are refused; pose files take -q and half turns, and refuse tiny and huge lengths",
)
def test_case_38_what_is_no_rotation_is_refused(tmp_path: Path) -> None:
    for zero in ([0.0] * 4, [-0.0] * 4):
        with pytest.raises(BadRequestError, match="quaternion 1 is zero"):
            poses.from_quaternion([[1, 0, 0, 0], zero], order="wxyz")
    for bad in (math.nan, math.inf, -math.inf):
        with pytest.raises(BadRequestError, match="expected finite numbers"):
            poses.from_quaternion([1.0, bad, 0.0, 0.0], order="wxyz")
    path = tmp_path / "poses.csv"

    def rows(*quaternions: Any) -> Floats:
        """Return the poses read from a file of these quaternions."""
        text = "".join(f"0,0,0,0,{','.join(map(repr, q))}\n" for q in quaternions)
        path.write_text("t,x,y,z,qw,qx,qy,qz\n" + text)
        return read_poses(path)[1]

    unit = [q for q in quaternions_at_limits() if abs(math.hypot(*q) - 1) <= 1e-6]
    assert len(unit) >= 20
    found = rows(*unit, *(tuple(-number for number in q) for q in unit))
    for q, pose, opposite in zip(unit, found, found[len(unit) :], strict=False):
        assert_rotation(pose, quaternion_rotation(*q))
        assert np.array_equal(pose, opposite)
    others = [q for q in quaternions_at_limits() if abs(math.hypot(*q) - 1) > 1e-6]
    for q in (*others, (0.0, -0.0, 0.0, 0.0)):
        with pytest.raises(BadRequestError, match=r"line 2: quaternion of length "):
            rows(q)


@pytest.mark.case(
    38, "the engine takes every such rotation, Euler angles' too, and gives the judge's verdicts"
)
def test_case_38_the_engine_takes_these_rotations(tmp_path: Path) -> None:
    case = archive_cases.build(tmp_path, np.array([[0.0, 0.0, 0.0], [1.0, 0.5, 0.25]]), radius=0.3)
    given = [poses.from_quaternion(q, order="wxyz") for q in quaternions_at_limits()]
    limits = angles_at_limits()
    given += [poses.from_euler((a, QUARTER, limits[-1 - i]), axes="ZYX") for i, a in enumerate(limits)]
    body = np.array([[0.6, 0.3, 0.1], [-0.4, 0.7, 0.2]])
    stacked = np.array(given)
    verdicts = archive_cases.ask(case, body, 0.2, stacked)
    assert verdicts.tolist() == case.judge(body, 0.2, stacked).astype(int).tolist()
    assert 0 < verdicts.sum() < len(verdicts)
