"""Memory is shared among processes, their own included."""

import pytest
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.memory import (
    ALONE_BYTES,
    BUILDER_BYTES,
    LEAST_SHARE,
    OVER_BYTES,
    WORKER_BYTES,
    jobs_that_fit,
    memory_share,
)


@pytest.mark.parametrize("memory", [64 << 20, 256 << 20, 1 << 30, 4 << 30, 100 << 30])
@pytest.mark.parametrize("wanted", [1, 2, 7, 64])
def test_all_processes_fit(memory: int, wanted: int) -> None:
    config = BuildConfig(memory_bytes=memory)
    jobs = jobs_that_fit(wanted, config)
    assert 1 <= jobs <= wanted
    share = memory_share(jobs, config)
    base = ALONE_BYTES if jobs == 1 else BUILDER_BYTES + jobs * WORKER_BYTES
    assert base + jobs * share <= max(memory + OVER_BYTES, ALONE_BYTES + LEAST_SHARE)
    if jobs < wanted:  # one more would not have had what it cannot do without
        assert BUILDER_BYTES + (jobs + 1) * (WORKER_BYTES + LEAST_SHARE) > memory + OVER_BYTES


def test_a_gigabyte_is_enough_for_two_and_some() -> None:
    config = BuildConfig(memory_bytes=1 << 30)
    assert jobs_that_fit(2, config) == 2
    assert memory_share(2, config) > 3 * LEAST_SHARE
