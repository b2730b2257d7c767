"""Which of two gaps sqrt(D) - R is less: exact, ties and all, up to the largest squares that there are."""

import math
from decimal import Decimal, localcontext

import numpy as np
import pytest
from solidcloud.server.kernels.core.placed_avatar import CERTAIN, compare_separations

pytestmark = pytest.mark.interpreted

LARGEST = 3 << 60  # of a square: a difference of 2^30 on each axis
# A gap's difference times its three conjugates, each below 2^34, is a whole number: so it is 0 or above 2^-102.
LEAST = Decimal(2) ** -102


def judged(square: int, radius: int, other: int, other_radius: int) -> int:
    """The sign of the first gap less the second."""
    with localcontext() as context:
        context.prec = 80
        apart = (Decimal(square).sqrt() - radius) - (Decimal(other).sqrt() - other_radius)
    return 0 if abs(apart) < LEAST else 1 if apart > 0 else -1


def check(square: int, radius: int, other: int, other_radius: int) -> int:
    """Assert that both orders of the two pairs are told as they are; returns the sign."""
    right = judged(square, radius, other, other_radius)
    numbers = [np.int64(n) for n in (square, radius, other, other_radius)]
    assert compare_separations(*numbers) == right, numbers
    assert compare_separations(*numbers[2:], *numbers[:2]) == -right, numbers
    return right


def test_gaps_of_whole_numbers_tie_exactly_and_a_unit_is_seen(rng: np.random.Generator) -> None:
    for bits in (1, 5, 15, 30):
        for _ in range(20):
            a, b = (int(n) for n in rng.integers(0, 1 << bits, 2))
            shift = int(rng.integers(-(1 << 30), 1 << 30))
            assert check(a * a, a + shift, b * b, b + shift) == 0
            assert check(a * a + 1, a + shift, b * b, b + shift) == 1
            assert check(a * a, a + shift + 1, b * b, b + shift) == -1


def test_pairs_whose_gaps_float64_cannot_tell_apart(rng: np.random.Generator) -> None:
    """sqrt(a (a + i)) - a and the same of b differ by i^2 / 8 (1 / b - 1 / a): nothing that float64 would see."""
    signs = []
    for _ in range(100):
        a, b = (int(n) for n in rng.integers(1 << 28, 3 << 29, 2))
        i = int(rng.integers(1, 50))
        square, other = a * (a + i), b * (b + i)
        if max(square, other) > LARGEST:
            continue
        assert abs((math.sqrt(square) - a) - (math.sqrt(other) - b)) < CERTAIN
        signs.append(check(square, a, other, b))
    assert {-1, 1} == set(signs) and len(signs) > 50


def test_any_squares_and_radii(rng: np.random.Generator) -> None:
    for _ in range(100):
        other, other_radius = int(rng.integers(0, LARGEST + 1)), int(rng.integers(-(1 << 31), 1 << 31))
        more = int(rng.integers(-(1 << 31), 1 << 31))
        check(int(rng.integers(0, LARGEST + 1)), other_radius // 2 + more // 2, other, other_radius)
        # The nearest squares there are to the same gap.
        root = math.isqrt(other) + more
        if not 0 <= root * root <= LARGEST - 4 * root:
            continue
        near = math.isqrt(other * more * more * 4) + other + more * more
        for square in (near - 1, near, near + 1, root * root):
            if 0 <= square <= LARGEST:
                check(square, other_radius + more, other, other_radius)


def test_the_largest_and_the_least() -> None:
    edge = 1 << 31
    for square in (0, 1, LARGEST - 1, LARGEST):
        for other in (0, 1, LARGEST - 1, LARGEST):
            for radius in (-edge, 0, 1, edge):
                for other_radius in (-edge, 0, edge):
                    check(square, radius, other, other_radius)
    root = math.isqrt(LARGEST)
    for square, radius in (
        (root * root, root),
        (root * root - 1, root),
        (LARGEST, root),
        (LARGEST, root + 1),
    ):
        check(square, radius, 0, 0)
