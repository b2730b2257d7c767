"""Compare the hash of an archive's points with the published function in Python's integers."""

from decimal import Decimal, localcontext

import numpy as np
import pytest
from solidcloud.builder.kernels.points.content_hash import SEEDS, content_sum

pytestmark = pytest.mark.interpreted

WRAP = (1 << 64) - 1


def finalised(value: int) -> int:
    """fmix64 of MurmurHash3."""
    for factor in (0xFF51AFD7ED558CCD, 0xC4CEB9FE1A85EC53):
        value = (value ^ (value >> 33)) * factor & WRAP
    return value ^ (value >> 33)


@pytest.mark.parametrize("seed", [0, 1, WRAP])
@pytest.mark.parametrize("columns", [1, 3])
def test_the_sum_is_that_of_the_hash(rng: np.random.Generator, seed: int, columns: int) -> None:
    values = rng.integers(0, 1 << 64, (columns, 5), np.uint64)
    values[:, 0] = 0
    total = 0
    for point in values.T.tolist():
        hashed = seed
        for value in point:
            hashed = (finalised(hashed ^ value) + seed) & WRAP
        total += finalised(hashed)
    assert int(content_sum(values, np.uint64(seed))) == total & WRAP
    assert content_sum(values[:, ::-1], np.uint64(seed)) == content_sum(values, np.uint64(seed))
    assert content_sum(values[:, :0], np.uint64(seed)) == 0


def test_the_seeds_are_those_of_the_archives_there_are() -> None:
    """2^64 through the real roots of x^2 = x + 1 and x^4 = x + 1, made odd."""
    with localcontext(prec=50):
        golden = (1 + Decimal(5).sqrt()) / 2
        fourth = Decimal(1)
        for _ in range(200):
            fourth = (1 + fourth).sqrt().sqrt()
        assert SEEDS.tolist() == [int(2**64 / root) | 1 for root in (golden, fourth)]
