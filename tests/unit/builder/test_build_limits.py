"""Test how many processes the memory of a build allows, and what an error advises."""

import numpy as np
import pytest
from solidcloud.builder.build_limits import MIN_SHARE, jobs_that_fit, memory_share, readers_that_fit
from solidcloud.builder.config import BuildConfig
from solidcloud.schemas.errors import SolidcloudError


def test_a_gigabyte_is_enough_for_two_and_some() -> None:
    config = BuildConfig(memory_bytes=1 << 30)
    assert jobs_that_fit(2, config) == 2
    assert memory_share(2, config) > 3 * MIN_SHARE


def test_fewer_jobs_are_named_where_they_are_enough() -> None:
    counts, config = np.array([4 * 10**7]), BuildConfig(memory_bytes=1 << 30)
    with pytest.raises(SolidcloudError, match="give --jobs 4 or --memory"):
        readers_that_fit(counts, 7, config)
