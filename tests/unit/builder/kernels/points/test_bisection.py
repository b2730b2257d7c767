"""Compare bisection with np.searchsorted of a part."""

import numpy as np
import pytest
from solidcloud.builder.kernels.points.octree_cells import first_at_least


@pytest.mark.interpreted
def test_the_first_that_is_not_below_is_found_in_every_part() -> None:
    values = np.array([0, 1, 1, 1, 4, 9, 9, 2**63, 2**64 - 1], np.uint64)
    wanted = np.unique(np.concatenate([values, values + np.uint64(1), values - np.uint64(1)]))
    for lo in range(len(values) + 1):
        for hi in range(lo, len(values) + 1):
            for value in wanted:
                expected = lo + np.searchsorted(values[lo:hi], value)
                assert first_at_least(values, lo, hi, value) == expected, (lo, hi, value)
