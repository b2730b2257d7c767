"""Test verdicts within a tolerance on production kernels: bounds, and no write beside the columns.

The unit tests check indices, which changes the loop: LLVM once vectorised it to write beyond a column.
"""

import numpy as np
import pytest
from solidcloud.server.kernels.collide.early_contact import (
    CLEAR,
    CONTACT,
    EARLY,
    UNKNOWN,
    set_early,
    write_verdict_bounds,
)

BESIDE = 128


@pytest.mark.interpreted
@pytest.mark.parametrize("k", [0, 1, 7, 8, 31, 57, 64, 65, 513])
def test_verdicts_become_bounds_and_nothing_else_is_written(k: int) -> None:
    rng = np.random.default_rng(k)
    types = (np.uint8, np.int64, np.float64, np.float64, np.bool_)
    buffers = [np.ones(k + 2 * BESIDE, kind) for kind in types]
    verdict, radii, lower, upper, exact = (buffer[BESIDE : BESIDE + k] for buffer in buffers)
    verdict[:], radii[:] = rng.integers(0, 4, k), rng.integers(0, 1 << 26, k)
    said = verdict.copy()
    write_verdict_bounds(verdict, radii, 0.25, 0.5, 0.75, lower, upper, exact)
    assert (lower == np.where(said == CLEAR, 0.25, -radii / 2.0**26)).all()
    highest = {CLEAR: np.inf, CONTACT: 0.5, UNKNOWN: np.inf, EARLY: 0.75}
    assert upper.tolist() == [highest[one] for one in said.tolist()]
    assert (exact == ((said == CLEAR) | (said == CONTACT))).all()
    assert (verdict == np.where(said == EARLY, CONTACT, said)).all()
    for buffer in buffers:
        assert (buffer[:BESIDE] == 1).all() and (buffer[BESIDE + k :] == 1).all()


@pytest.mark.interpreted
@pytest.mark.parametrize("units", [0, 1 << 20])
@pytest.mark.parametrize("tolerance", [1, 1 << 26])
def test_a_pair_is_sure_only_below_what_all_errors_leave(units: int, tolerance: int) -> None:
    early, per_step = np.empty(2, np.float32), 2.0**-14 * 2.0**26
    for error in (0.0, 0.01, 3.0):
        set_early(early, tolerance, units, per_step, np.float32(error))
        true = (units + tolerance) / per_step
        if early[1] > 0:
            # A float32 square is off by 8 half units in the last place, and its distance by the error.
            assert np.sqrt(float(early[1]) * (1 + 8 * 2.0**-24)) + error <= true
        else:
            assert true * (1 - 2.0**-20) <= error + 1e-9
        assert early[0] >= true * (1 - 1e-6)
