"""Memory is shared among processes, their own included."""

import re

import numpy as np
import pytest
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.run.memory_shares import (
    ALONE_BYTES,
    BUILDER_BYTES,
    CLUSTER_WORKER_BYTES,
    CLUSTER_WORKER_KILLED,
    MIN_SHARE,
    OVER_BYTES,
    RECORD_BYTES,
    WORKER_BYTES,
    bytes_beside_records,
    cluster_worker_limit,
    jobs_that_fit,
    memory_share,
    readers_that_fit,
    record_bytes_a_point,
)
from solidcloud.schemas.errors import SolidcloudError


def test_a_single_worker_of_a_cluster_is_a_process_beside_the_builder() -> None:
    memory = 1 << 30
    assert memory_share(1, BuildConfig(memory_bytes=memory)) == memory - ALONE_BYTES
    for options in ({"cluster": "local:1"}, {"scheduler": "tcp://here:8786"}):
        config = BuildConfig(memory_bytes=memory, **options)
        assert memory_share(1, config) == memory - BUILDER_BYTES - WORKER_BYTES


@pytest.mark.parametrize("memory", [64 << 20, 256 << 20, 1 << 30, 4 << 30, 100 << 30])
@pytest.mark.parametrize("wanted", [1, 2, 7, 64])
def test_all_processes_fit(memory: int, wanted: int) -> None:
    config = BuildConfig(memory_bytes=memory)
    jobs = jobs_that_fit(wanted, config)
    assert 1 <= jobs <= wanted
    share = memory_share(jobs, config)
    base = ALONE_BYTES if jobs == 1 else BUILDER_BYTES + jobs * WORKER_BYTES
    assert base + jobs * share <= max(memory + OVER_BYTES, ALONE_BYTES + MIN_SHARE)
    if jobs < wanted:  # one more would not have had what it cannot do without
        assert BUILDER_BYTES + (jobs + 1) * (WORKER_BYTES + MIN_SHARE) > memory + OVER_BYTES


def test_a_gigabyte_is_enough_for_two_and_some() -> None:
    config = BuildConfig(memory_bytes=1 << 30)
    assert jobs_that_fit(2, config) == 2
    assert memory_share(2, config) > 3 * MIN_SHARE


@pytest.mark.parametrize("jobs", [1, 2, 5])
@pytest.mark.parametrize("memory", [64 << 20, 1 << 30, 2 << 30])
def test_no_more_processes_read_than_hold_the_largest_voxels(jobs: int, memory: int) -> None:
    config = BuildConfig(memory_bytes=memory)
    base = ALONE_BYTES if jobs == 1 else BUILDER_BYTES + jobs * WORKER_BYTES
    room = max(memory + OVER_BYTES - base, MIN_SHARE)
    for points in (1, 10**6, 5 * 10**6, 4 * 10**7, 10**9):
        counts = np.array([7, points, points // 2, points, 3])
        each = sorted(
            (n * record_bytes_a_point(config) + RECORD_BYTES for n in counts.tolist()), reverse=True
        )
        if each[0] > room:
            with pytest.raises(
                SolidcloudError, match=rf"{points} points.*give .*--memory \d+MB.*smaller --voxel and --fresh"
            ):
                readers_that_fit(counts, jobs, config)
            continue
        readers = readers_that_fit(counts, jobs, config)
        assert sum(each[:readers]) <= room
        assert readers == jobs or sum(each[: readers + 1]) > room
    assert readers_that_fit(np.empty(0, np.int64), jobs, config) == jobs
    assert readers_that_fit(np.array([5]), 64, BuildConfig(memory_bytes=100 << 30)) == 64


@pytest.mark.parametrize("cluster", [False, True])
@pytest.mark.parametrize("wanted", [1, 2, 3, 4, 7, 8, 16, 32])
@pytest.mark.parametrize("memory", [64, 128, 256, 512, 1024, 2048])
def test_the_memory_and_the_jobs_named_for_a_large_voxel_are_enough(
    wanted: int, memory: int, cluster: bool
) -> None:
    """More memory lets more processes start, and each takes of it."""

    def read(points: int, memory: int, number: int) -> int:
        config = BuildConfig(
            memory_bytes=memory << 20, jobs=number, cluster=f"local:{number}" if cluster else None
        )
        jobs = number if cluster else jobs_that_fit(number, config)
        readers = readers_that_fit(np.array([points, 1000]), jobs, config)
        assert 1 <= readers <= jobs
        return readers

    refused = 0
    for points in (10**6, 5 * 10**6, 7 * 10**6, 10**7, 3 * 10**7, 4 * 10**7, 10**8, 10**9):
        try:
            read(points, memory, wanted)
            continue
        except SolidcloudError as error:
            said = str(error)
        refused += 1
        named = re.search(r"give (?:--(?:jobs |cluster local:)(\d+) or )?--memory (\d+)MB to resume", said)
        assert named, said
        read(points, int(named[2]), wanted)
        with pytest.raises(SolidcloudError):  # and no more than that
            read(points, int(named[2]) - 2, wanted)
        if named[1]:
            read(points, memory, int(named[1]))
    assert refused


@pytest.mark.parametrize("cluster", [False, True])
def test_no_more_jobs_would_be_enough_than_are_named(cluster: bool) -> None:
    counts = np.array([4 * 10**7])

    def given(number: int) -> BuildConfig:
        return BuildConfig(memory_bytes=1 << 30, jobs=number, cluster=f"local:{number}" if cluster else None)

    with pytest.raises(SolidcloudError) as error:
        readers_that_fit(counts, 7, given(7))
    named = re.search(r"give --(?:jobs |cluster local:)(\d+) or", str(error.value))
    assert named and readers_that_fit(counts, int(named[1]), given(int(named[1]))) >= 1
    for fewer in range(int(named[1]) + 1, 7):
        with pytest.raises(SolidcloudError):
            readers_that_fit(counts, fewer, given(fewer))


@pytest.mark.parametrize("jobs", [1, 2, 5])
@pytest.mark.parametrize("memory", [64 << 20, 1 << 30, 2 << 30])
def test_what_is_held_beside_records_fits_beside_them(jobs: int, memory: int) -> None:
    config = BuildConfig(memory_bytes=memory)
    base = ALONE_BYTES if jobs == 1 else BUILDER_BYTES + jobs * WORKER_BYTES
    room = max(memory + OVER_BYTES - base, MIN_SHARE)
    for points in (1, 10**6, 3 * 10**6, 5 * 10**6):
        counts = np.array([7, points, points // 2, points, 3])
        readers = readers_that_fit(counts, jobs, config)
        each = sorted((counts * record_bytes_a_point(config) + RECORD_BYTES).tolist())[-readers:]
        beside = bytes_beside_records(counts, readers, jobs, config)
        assert 0 <= beside <= memory_share(jobs, config)
        assert sum(each) + readers * beside <= room
    # What workers elsewhere may hold is known there.
    elsewhere = BuildConfig(memory_bytes=memory, scheduler="tcp://127.0.0.1:1")
    assert bytes_beside_records(np.array([1 << 40]), jobs, jobs, elsewhere) == memory_share(jobs, elsewhere)


def test_a_worker_of_a_local_cluster_holds_what_dask_leaves_it() -> None:
    """Dask kills it at its own limit, whatever the others hold."""
    memory, jobs = 2 << 30, 4
    limit = cluster_worker_limit(jobs, memory)
    local = BuildConfig(memory_bytes=memory, cluster="local:4")
    most = (int(limit * CLUSTER_WORKER_KILLED) - CLUSTER_WORKER_BYTES - RECORD_BYTES) // record_bytes_a_point(
        local
    )
    assert 1 <= readers_that_fit(np.array([most] * jobs), jobs, local) < jobs
    with pytest.raises(SolidcloudError, match="give --cluster local:3 or --memory"):
        readers_that_fit(np.array([most + 1]), jobs, local)
    assert readers_that_fit(np.array([most + 1]), jobs, BuildConfig(memory_bytes=memory)) == jobs
    # What workers elsewhere may hold is known there.
    elsewhere = BuildConfig(memory_bytes=memory, scheduler="tcp://127.0.0.1:1")
    assert readers_that_fit(np.array([1 << 40]), jobs, elsewhere) == jobs


def test_fewer_jobs_are_named_where_they_are_enough() -> None:
    counts, config = np.array([4 * 10**7]), BuildConfig(memory_bytes=1 << 30)
    with pytest.raises(SolidcloudError, match="give --jobs 4 or --memory"):
        readers_that_fit(counts, 7, config)
