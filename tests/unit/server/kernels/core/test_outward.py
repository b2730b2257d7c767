"""Whole numbers that float32 does not hold become the neighbour on the side that keeps a bound a bound."""

import numpy as np
import pytest
from solidcloud.server.kernels.core.scene_arrays import _outward

pytestmark = pytest.mark.interpreted


def test_a_bound_is_the_nearest_float32_on_its_side() -> None:
    rng = np.random.default_rng(4)
    near = [(1 << shift) + more for shift in (0, 23, 24, 25, 30) for more in range(-5, 6)]
    for value in [*near, *rng.integers(0, 1 << 31, 200).tolist(), (1 << 31) - 1]:
        for whole in (value, -value):
            for up in (True, False):
                found = float(_outward(np.int32(whole), up))
                assert found >= whole if up else found <= whole
                back = np.nextafter(np.float32(found), np.float32(-np.inf if up else np.inf))
                assert float(back) < whole if up else float(back) > whole, "the next one inward is no bound"
