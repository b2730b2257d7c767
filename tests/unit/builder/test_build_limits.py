"""Memory is shared among processes, their own included; a record that is read back takes what its formula says."""

import re
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from solidcloud.builder.build_limits import (
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
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.edit.archive_change import _read_back, _ReadUnit
from solidcloud.builder.edit.stored_points import FindUnit, GatherUnit, find_scans, gather
from solidcloud.builder.passes.point_spacing import _own_sums, _OwnUnit
from solidcloud.builder.passes.preview import _choose
from solidcloud.builder.passes.preview import _Unit as PreviewUnit
from solidcloud.builder.passes.verify import _Unit as VerifyUnit
from solidcloud.builder.passes.verify import _verify_rows
from solidcloud.builder.pipeline import build_archive
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.errors import SolidcloudError
from synthetic_scans import write_ply


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


FEW, MANY = 100_000, 250_000
# Of all points so many are asked for the radius, or chosen for the preview, that they count as nothing.
SHARE = 1e-4
ALL = frozenset({"scan", "intensity"})
OPTIONS: dict[str, dict[str, Any]] = {
    "coordinates alone": {},
    "scan and intensity": {"keep": ALL},
    "scan, intensity and classes": {"keep": ALL, "models": frozenset({"mean", "local"})},
    "all that scans have": {"keep": ALL | {"rgb", "classification"}},
    "small leaf nodes": {"leaf": 4, "degree": 4},
}


def one_voxel(folder: Path, points: int, config: BuildConfig) -> Path:
    """An archive of one voxel, of two scans whose points and intensities cannot be compressed much."""
    rng = np.random.default_rng(points)
    folder.mkdir()
    for name in ("a.ply", "b.ply"):
        xyz = rng.uniform(0, 1, (points // 2, 3)) * [1, 1, 0.1]
        write_ply(folder / name, xyz, rng.uniform(0, 1, points // 2).astype(np.float32))
    build_archive([folder / "a.ply", folder / "b.ply"], folder / "hall", config)
    return folder / "hall"


def readings(folder: Path, points: int, config: BuildConfig) -> dict[str, Callable[[], object]]:
    """What reads back the only voxel of an archive, in one process."""
    with Archive(folder) as archive:
        assert len(archive.voxels) == 1
        with_scans = archive.header.scan_index
    rows = range(1)
    spool = folder.with_name("spool")
    spool.mkdir(exist_ok=True)
    gathered = GatherUnit(folder, (0,), points, spool, "old", frozenset(), None, config, 1 << 12)
    finding: dict[str, Callable[[], object]] = {
        "find": lambda: find_scans(FindUnit(folder, (0,), points, frozenset({1}))),
    }
    return (finding if with_scans else {}) | {
        "gather": lambda: gather(gathered),
        "what was built": lambda: _read_back(_ReadUnit(folder, (0,), points)),
        "radius": lambda: _own_sums(_OwnUnit(folder, rows, SHARE, points)),
        "preview": lambda: _choose(PreviewUnit(folder, rows, SHARE, points)),
        "verify": lambda: _verify_rows(VerifyUnit(folder, rows, False, None, True, points)),
    }


def held(function: Callable[[], object]) -> int:
    """Bytes that a call holds at most: numpy's arrays and Python's bytes, of which records are made.

    What zstandard and numba take by themselves is not seen: tables of a few MB, and nothing.
    """
    function()
    tracemalloc.start()
    try:
        function()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("name", OPTIONS)
def test_a_record_read_back_holds_what_is_counted_for_it(name: str, tmp_path: Path) -> None:
    config = BuildConfig(voxel=4.0, jobs=1, radius=None, **OPTIONS[name])
    peaks: dict[str, list[int]] = {}
    for points in (FEW, MANY):
        for task, call in readings(one_voxel(tmp_path / str(points), points, config), points, config).items():
            peaks.setdefault(task, []).append(held(call))
    counted = record_bytes_a_point(config)
    found = {task: (many - few) / (MANY - FEW) for task, (few, many) in peaks.items()}
    assert max(found.values()) <= counted, found
    assert max(found.values()) > counted / 2, found  # what cannot be compressed at all takes the rest
    assert all(many <= MANY * counted + RECORD_BYTES for _, many in peaks.values())


def test_one_record_is_held_at_a_time(tmp_path: Path) -> None:
    """Of several in a unit: the one before is let go before the next is read."""
    rng = np.random.default_rng(7)
    for at, name in enumerate(("a.ply", "b.ply", "c.ply")):
        write_ply(tmp_path / name, rng.uniform(0, 1, (FEW, 3)) * [1, 1, 0.1] + [1 + 4 * at, 0, 0])
    config = BuildConfig(voxel=4.0, jobs=1, keep=frozenset({"scan"}), radius=0.01)
    folder = tmp_path / "hall"
    build_archive([tmp_path], folder, config)
    with Archive(folder) as archive:
        assert archive.voxels["rows"][:, 2].tolist() == [FEW] * 3
    all_rows = range(3)
    tasks: dict[str, Callable[[range], object]] = {
        "find": lambda rows: find_scans(FindUnit(folder, tuple(rows), FEW, frozenset({7}))),
        "what was built": lambda rows: _read_back(_ReadUnit(folder, tuple(rows), FEW)),
        "preview": lambda rows: _choose(PreviewUnit(folder, rows, SHARE, FEW)),
        "verify": lambda rows: _verify_rows(VerifyUnit(folder, rows, False, None, True, FEW)),
    }
    for name, task in tasks.items():
        one = max(held(lambda row=row, task=task: task(range(row, row + 1))) for row in all_rows)
        assert held(lambda task=task: task(all_rows)) < 1.15 * one, name
