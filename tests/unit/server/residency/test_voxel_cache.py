"""Test the voxel cache: one load a voxel, all waiting requests answered, pins and budget respected.

The policy is tested against a naive model of lists, in random runs of demands, prefetches, scans and faults.
"""

import os
import threading
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from pathlib import Path

import archive_cases
import numpy as np
import pytest
import synthetic_scans
from fake_store import BLOCK, FakeStore
from numpy.typing import NDArray
from sample_sizes import sample
from solidcloud.schemas.errors import BadRequestError
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.schemas.wire.requests import QuestionOptions
from solidcloud.server.kernels.core.scene_arrays import Arena
from solidcloud.server.residency.voxel_cache import POLICIES, EvictionPolicy, HeldVoxels, VoxelCache
from solidcloud.server.scene import Scene

pytestmark = pytest.mark.interpreted

INTERPRETED = os.environ.get("NUMBA_DISABLE_JIT") == "1"
DEADLINE = 20.0  # [s], for what takes microseconds when it is right
POLICY_BUDGET = 1000


def take(residency: VoxelCache, rows: list[int]) -> HeldVoxels:
    """Hold rows for a moment."""
    with residency.hold(rows) as held:
        for row in rows:
            assert (residency.where[row, 0] >= 0) or held.faults
        assert held.waited > 0 or not held.misses
        return held._replace(waited=0.0)


def resident(residency: VoxelCache) -> list[int]:
    """The rows whose voxels are resident."""
    return np.flatnonzero(residency.where[:, 0] >= 0).tolist()


def test_a_budget_below_the_largest_voxel_is_refused() -> None:
    with pytest.raises(BadRequestError, match="the largest voxel takes 192"):
        VoxelCache(FakeStore([1, 3]), 3 * BLOCK - 1)
    assert VoxelCache(FakeStore([]), 0).resident == 0


def test_the_least_recently_used_goes_first() -> None:
    store = FakeStore([1] * 5)
    residency = VoxelCache(store, 3 * BLOCK)
    for row in (0, 1, 2, 0, 3):
        take(residency, [row])
    assert resident(residency) == [0, 2, 3]
    assert (residency.stats.hits, residency.stats.misses, residency.stats.evicted) == (1, 4, 1)
    assert take(residency, [2, 4]) == HeldVoxels(1, 1, ())
    assert resident(residency) == [2, 3, 4] and store.loads == {0: 1, 1: 1, 2: 1, 3: 1, 4: 1}
    assert residency.resident_bytes == 3 * BLOCK
    residency.check()


def test_room_in_pieces_between_own_voxels_is_made_whole() -> None:
    store = FakeStore([1, 1, 1, 1, 3])
    residency = VoxelCache(store, 4 * BLOCK)
    take(residency, [0, 1, 2, 3])
    # Row 1 lies in the middle: what is free beside it is enough for row 4, but not in one run.
    with residency.hold([1, 4]) as held:
        assert held.misses == 1
        for row in (1, 4):
            run = residency.buffer.arena.ints[int(residency.where[row, 0]) :][: store.sizes[row] // 4]
            assert (run == row).all()
    assert resident(residency) == [1, 4] and store.loads[1] == 1
    residency.check()


def test_a_request_waits_for_pinned_room_and_then_goes_on() -> None:
    store = FakeStore([2, 2])
    residency = VoxelCache(store, 3 * BLOCK)
    with ThreadPoolExecutor(1) as pool:
        with residency.hold([0]):
            other = pool.submit(take, residency, [1])
            assert not store.wait_for_load(1, 0.05), "there is no room while row 0 is held"
            assert resident(residency) == [0]
        assert other.result(DEADLINE) == HeldVoxels(0, 1, ())
    assert resident(residency) == [1]


def test_requests_that_need_each_others_room_both_end() -> None:
    residency = VoxelCache(FakeStore([1] * 8), 4 * BLOCK)
    left, right = [0, 1, 2, 3], [2, 3, 4, 5]
    with ThreadPoolExecutor(8) as pool:
        jobs = [pool.submit(take, residency, (left, right)[i % 2]) for i in range(400)]
        assert sum(sum(job.result(DEADLINE)[:2]) for job in jobs) == 1600
    residency.check()


def test_one_load_however_many_wait() -> None:
    store = FakeStore([1])
    store.gate.clear()
    residency = VoxelCache(store, BLOCK)
    with ThreadPoolExecutor(8) as pool:
        jobs = [pool.submit(take, residency, [0]) for _ in range(8)]
        assert store.wait_for_load(0, DEADLINE)
        store.gate.set()
        held = [job.result(DEADLINE) for job in jobs]
    assert store.loads == {0: 1}
    assert sorted(h.misses for h in held) == [0] * 7 + [1]
    residency.check()


@pytest.mark.parametrize("fault", ["corrupt", "unreadable"])
def test_every_waiter_hears_of_a_load_that_fails(fault: str) -> None:
    store = FakeStore([1, 1])
    store.faults[0] = fault
    store.gate.clear()
    residency = VoxelCache(store, 2 * BLOCK)
    ready = threading.Barrier(8)

    def wait_and_leave(_: int) -> HeldVoxels:
        with residency.hold([0, 1]) as held:
            assert residency.where[0, 0] == -1 and residency.where[1, 0] >= 0
            ready.wait(DEADLINE)  # all inside at once
        return held

    with ThreadPoolExecutor(8) as pool:
        jobs = [pool.submit(wait_and_leave, i) for i in range(8)]
        assert store.wait_for_load(0, DEADLINE)
        store.gate.set()
        faults = [job.result(DEADLINE).faults for job in jobs]
    assert all(len(f) == 1 and "file.h5: voxel 0" in f[0] for f in faults)
    assert store.loads[0] == 1, "nobody tries again while somebody holds it"
    residency.check()
    del store.faults[0]
    again = take(residency, [0])
    if fault == "corrupt":  # the same bytes would be read again
        assert again.faults and store.loads[0] == 1
    else:
        assert not again.faults and store.loads[0] == 2 and resident(residency) == [0, 1]


def test_a_failed_voxel_does_not_appear_under_who_began_without_it() -> None:
    store = FakeStore([1])
    store.faults[0] = "unreadable"
    residency = VoxelCache(store, BLOCK)
    with residency.hold([0]) as first:
        del store.faults[0]
        with residency.hold([0]) as second:
            assert first.faults == second.faults != ()
            assert residency.where[0].tolist() == [-1, -1, -1]
    assert take(residency, [0]).faults == ()


def test_a_load_that_raises_anything_else_leaves_nothing_behind() -> None:
    store = FakeStore([1, 1, 1])
    store.faults[1] = "out of memory"
    residency = VoxelCache(store, 3 * BLOCK)
    with pytest.raises(MemoryError), residency.hold([0, 1, 2]):
        pass
    residency.check()
    assert resident(residency) == [0] and residency.resident_bytes == BLOCK
    del store.faults[1]
    assert take(residency, [0, 1, 2]) == HeldVoxels(1, 2, ())


def test_who_waits_for_a_load_that_raises_is_answered() -> None:
    store = FakeStore([1])
    store.faults[0] = "out of memory"
    store.gate.clear()
    residency = VoxelCache(store, BLOCK)
    with ThreadPoolExecutor(2) as pool:
        first = pool.submit(take, residency, [0])
        assert store.wait_for_load(0, DEADLINE)
        second = pool.submit(take, residency, [0])
        while residency._pins.get(0, 0) < 2:
            pass
        store.gate.set()
        with pytest.raises(MemoryError):
            first.result(DEADLINE)
        assert "MemoryError" in second.result(DEADLINE).faults[0]
    residency.check()


@pytest.mark.parametrize("broken", ["bytes", "overlap", "lost gap", "where", "pin"])
def test_check_finds_what_is_broken(broken: str) -> None:
    residency = VoxelCache(FakeStore([1, 1, 1]), 3 * BLOCK)
    take(residency, [0, 1])
    residency.check()
    if broken == "bytes":
        residency._allocator.used_bytes += BLOCK
    elif broken == "overlap":
        residency._allocator.offsets[1] = residency._allocator.offsets[0]
    elif broken == "lost gap":
        residency._allocator._gaps.clear()
    elif broken == "where":
        residency.where[1] = -1
    else:
        residency._pins[1] = 0
    with pytest.raises(AssertionError):
        residency.check()


@pytest.mark.parametrize("policy", POLICIES[:1] if INTERPRETED else POLICIES[:2])
def test_eight_threads_and_a_tiny_budget_change_no_answer(
    tmp_path: Path, rng: np.random.Generator, policy: str
) -> None:
    points, count, requests = (400, 40, 30) if INTERPRETED else sample((800, 80, 55), (1500, 160, 110))
    scan = synthetic_scans.make_scan("noise", 9, points)
    case = archive_cases.build(tmp_path, scan, voxel=0.4, leaf=8)
    avatar = rng.uniform(-0.2, 0.2, (40, 3))
    poses = archive_cases.near_poses(rng, case.points, avatar, count, 0.04)
    expected = case.judge(avatar, 0.005, poses).astype(int)
    assert count / 4 < expected.sum() < count * 3 / 4
    # Requests of one pose, which are answered at once where all is resident, and of two, which hold their voxels.
    parts = [np.sort(part) for part in np.array_split(rng.permutation(count), requests)] * 3
    with Scene.open(case.archive) as scene:
        everything = scene.info().resident_bytes
    with Scene.open(case.archive, budget_bytes=everything // 6, policy=policy) as scene:
        over, unknown = [], []

        def ask(number: int) -> list[int]:
            """A request of a user of its own thread; every third one does not wait."""
            part, client = parts[number], str(threading.get_ident())
            scene.add_avatar("avatar", avatar, 0.005, client=client)
            options: QuestionOptions = {"budget_ms": 0.0} if number % 3 == 0 else {}
            answers = scene.collide("avatar", poses[part], client=client, **options)
            over.append(scene.stats().resident_bytes + scene.stats().level_bytes > everything // 6)
            late = answers.verdict == Verdict.UNKNOWN
            unknown.append(int(late.sum()))
            assert not late.any() or options
            assert answers.late or not late.any() or not answers.misses
            return np.where(late, expected[part], answers.verdict).tolist()

        with ThreadPoolExecutor(8) as pool:
            verdicts = list(pool.map(ask, range(len(parts))))
        scene.residency.check()
        stats = scene.stats()
        assert scene.residency.stats.evicted > 0 and not any(over) and sum(unknown) > 0
        assert stats.requests == len(parts) and stats.unknown == sum(unknown)
        assert sum(user.requests for user in stats.users) == stats.requests
        assert sum(user.misses for user in stats.users) <= stats.misses
        assert stats.prefetched == stats.used + stats.wasted + len(scene.residency.stats.fresh)
        assert policy != "lru" or stats.prefetched == 0
    for part, verdict in zip(parts, verdicts, strict=True):
        assert verdict == expected[part].tolist()


def test_a_disk_that_is_stuck_keeps_no_other_request_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("solidcloud.server.residency.voxel_cache.LOADS_WITHOUT_TURN", 0)
    store, go = FakeStore([1, 1, 1]), threading.Event()
    residency, load = VoxelCache(store, 3 * BLOCK), store.load

    def stuck(row: int, arena: Arena, offset: int) -> NDArray[np.int64]:
        assert row or go.wait(DEADLINE)
        return load(row, arena, offset)

    store.load = stuck  # type: ignore[method-assign]
    with ThreadPoolExecutor(1) as pool:
        first = pool.submit(take, residency, [0])
        while not residency.is_resident(0):
            assert not first.done()
        assert take(residency, [1]) == HeldVoxels(0, 1, ()) and not first.done()
        go.set()
        assert first.result(DEADLINE).misses == 1
    residency.check()


class NaiveLru:
    """Least recently used first, all in lists; what only scans wanted first while it holds over a tenth."""

    def __init__(self) -> None:
        self.order: list[int] = []
        self.scans: list[int] = []
        self.size: dict[int, int] = {}

    def added(self, row: int, size: int, scan: bool) -> None:
        self.order.append(row)
        self.size[row] = size
        if scan:
            self.scans.append(row)

    def used(self, row: int, scan: bool) -> None:
        self.order.remove(row)
        self.order.append(row)
        if row in self.scans:
            self.scans.remove(row)
            if scan:
                self.scans.append(row)

    def removed(self, row: int) -> None:
        self.order.remove(row)
        if row in self.scans:
            self.scans.remove(row)

    def next_after(self, named: list[int]) -> int | None:
        """Who goes next when those named have gone."""
        scans = [row for row in self.scans if row not in named]
        if sum(self.size[row] for row in scans) > POLICY_BUDGET // 10:
            return scans[0]
        return next((row for row in self.order if row not in named), None)


def named(policy: EvictionPolicy, naive: NaiveLru, most: int) -> list[int]:
    """The first victims of a policy, which are the naive one's."""
    found = list(islice(policy.victims(), most))
    expected: list[int] = []
    while len(expected) < most and (row := naive.next_after(expected)) is not None:
        expected.append(row)
    assert found == expected
    return found


@pytest.mark.parametrize("seed", range(8))
def test_a_policy_does_as_its_model(seed: int) -> None:
    rng = np.random.default_rng(seed)
    policy, naive = EvictionPolicy(POLICY_BUDGET), NaiveLru()
    resident: dict[int, int] = {}
    evictions = scans = 0
    for _ in range(400):
        row, scan = int(rng.integers(60)), bool(rng.random() < 0.3)
        if row in resident:
            policy.used(row, scan=scan)
            naive.used(row, scan)
        else:
            size = int(rng.integers(1, 150))
            while sum(resident.values()) + size > POLICY_BUDGET:
                # The first few are in use, now and then.
                skipped = int(rng.integers(3)) if rng.random() < 0.2 else 0
                victims = named(policy, naive, skipped + 1)
                policy.removed(victims[-1])
                naive.removed(victims[-1])
                del resident[victims[-1]]
                evictions += 1
            resident[row] = size
            policy.added(row, size, scan=scan)
            naive.added(row, size, scan)
            scans += scan
            if rng.random() < 0.1:  # the record was corrupt
                policy.removed(row)
                naive.removed(row)
                del resident[row]
        if rng.random() < 0.1:
            assert sorted(named(policy, naive, 100)) == sorted(resident)
    assert evictions > 20 and scans > 20


def test_nothing_resident_has_no_victims() -> None:
    policy = EvictionPolicy(POLICY_BUDGET)
    assert list(policy.victims()) == []
    policy.added(3, 10, scan=False)
    policy.removed(3)
    assert list(policy.victims()) == []


def test_an_unknown_policy_is_refused() -> None:
    with pytest.raises(BadRequestError, match="policy 'mru': expected one of lru, lru\\+prefetch"):
        EvictionPolicy(POLICY_BUDGET, "mru")
