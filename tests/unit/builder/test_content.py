"""The sum that names an archive's points, against the published hash in Python's integers: old archives keep theirs."""

import numpy as np
import pytest
from solidcloud.builder.kernels.content import content_sum

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
