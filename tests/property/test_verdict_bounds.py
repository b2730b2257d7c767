"""Test verdicts within a tolerance: their bounds, and the pairs that are surely within it."""

import numpy as np
import pytest
from solidcloud.server.kernels.collide.collide_poses import CLEAR, CONTACT, EARLY, UNKNOWN, set_early
from solidcloud.server.queries.collide import verdict_bounds
from solidcloud.server.queries.query_inputs import QueryBudget


@pytest.mark.interpreted
def test_verdicts_become_bounds() -> None:
    said = np.array([CLEAR, CONTACT, UNKNOWN, EARLY], np.uint8)
    verdict, radii = said.copy(), np.arange(4) << 24
    found = verdict_bounds(verdict, radii, 0.25, 1 << 24, QueryBudget(tolerance=0.125))
    assert found["lower"].tolist() == [0.25, -0.25, -0.5, -0.75]
    assert found["upper"].tolist() == [np.inf, 0.25, np.inf, np.nextafter(0.375, np.inf)]
    assert found["exact"].tolist() == [True, True, False, False]
    assert verdict.tolist() == [CLEAR, CONTACT, UNKNOWN, CONTACT]


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
