"""Test the check of a load test's budgets against its archive."""

import numpy as np
import pytest
from solidcloud.schemas.errors import BadRequestError
from solidcloud.server.report.load.runs.cache_budgets import checked_shares, least_share
from solidcloud.server.report.load.users.archive_voxels import Voxels

USUAL = (0.03, 0.05, 0.1, 0.2, 0.4)


def voxels(*sizes: int) -> Voxels:
    count = len(sizes)
    return Voxels(np.arange(count, dtype=np.uint64), np.zeros((count, 2, 3)), np.array(sizes), 0.01)


def test_usual_budgets_are_raised_to_the_largest_voxel() -> None:
    """A town of 1e6 points: its largest voxel alone takes more than a tenth."""
    town = voxels(*[10] * 85, 150)
    assert least_share(town) == 0.15
    shares, said = checked_shares(USUAL, None, town, "--budgets")
    assert shares == [0.15, 0.2, 0.4] and "the largest voxel takes" in said
    assert all(int(town.decoded * share) >= 150 for share in shares)
    assert checked_shares([0.1], None, voxels(70), "--budget")[0] == [1.0]


@pytest.mark.parametrize("share", [0.1, 0.0, -1.0, float("nan")])
def test_a_given_budget_that_is_too_small_is_refused(share: float) -> None:
    with pytest.raises(BadRequestError, match="--budget"):
        checked_shares([0.1], [share], voxels(*[10] * 85, 150), "--budget")
