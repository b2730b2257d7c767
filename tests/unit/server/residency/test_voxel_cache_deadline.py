"""Test the cache with deadlines: a late voxel is missing for its own request only; every load is begun."""

import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from fake_store import BLOCK, FakeStore
from solidcloud.server.residency.voxel_cache import HeldVoxels, VoxelCache

pytestmark = pytest.mark.interpreted
PATIENCE = 20.0  # [s], for what takes microseconds when it is right


def soon(seconds: float = 0.05) -> float:
    """A deadline."""
    return time.perf_counter() + seconds


def take(residency: VoxelCache, rows: list[int], deadline: float = float("inf")) -> HeldVoxels:
    """Hold rows for a moment; what is not late is there, and whole."""
    with residency.hold(rows, deadline) as held:
        for row in set(rows) - set(held.late):
            first = int(residency.where[row, 0])
            assert first >= 0
            assert (residency.buffer.arena.ints[first : first + BLOCK // 4] == row).all()
    assert held.waited > 0 or not (held.misses or held.late)
    return held._replace(waited=0.0)


def test_after_the_deadline_no_load_is_begun() -> None:
    store = FakeStore([1] * 4)
    residency = VoxelCache(store, 4 * BLOCK)
    take(residency, [1])
    assert take(residency, [0, 1, 2], deadline=0.0) == HeldVoxels(1, 2, (), (0, 2))
    assert store.loads == {1: 1} and residency.resident == 1
    residency.check()
    assert take(residency, [0, 1, 2]) == HeldVoxels(1, 2, ()), "and who has time gets them"
    assert take(residency, [0, 1, 2], deadline=0.0) == HeldVoxels(3, 0, ()), "what is there is not late"


def test_who_does_not_wait_gets_what_is_there_and_evicts_nothing() -> None:
    store = FakeStore([1] * 4)
    residency = VoxelCache(store, 2 * BLOCK)
    take(residency, [1])
    take(residency, [3])
    woken: list[int] = []
    residency.on_owed = lambda: woken.append(1)
    store.gate.clear()  # a load would block
    with residency.hold([0, 1, 2, 3], -np.inf) as held:
        assert held == HeldVoxels(2, 0, (), (0, 2)), "more than fit together may be asked for"
        assert residency.resident == 2 and residency._pins == {0: 1, 1: 1, 2: 1, 3: 1}
    assert store.loads == {1: 1, 3: 1} and woken == [1]
    assert [residency.take_owed() for _ in range(3)] == [0, 2, None]
    assert not residency._pins
    residency.check()


def test_who_does_not_wait_is_told_of_faults() -> None:
    store = FakeStore([1] * 2)
    store.faults[1] = "corrupt"
    residency = VoxelCache(store, 2 * BLOCK)
    with residency.hold([1]) as held:
        assert held.faults
    with residency.hold([0, 1], -np.inf) as held:
        assert held.late == (0,) and len(held.faults) == 1
    residency.check()


def test_a_load_of_another_is_waited_for_until_the_deadline_and_goes_on() -> None:
    store = FakeStore([1])
    residency = VoxelCache(store, BLOCK)
    store.gate.clear()
    with ThreadPoolExecutor(1) as pool:
        loader = pool.submit(take, residency, [0])
        assert store.wait_for_load(0, PATIENCE)
        with residency.hold([0], soon()) as held:
            assert held.late == (0,) and held.faults == ()
            assert residency.where[0, 0] == -1
            store.gate.set()
            assert loader.result(PATIENCE) == HeldVoxels(0, 1, ())
            assert residency.where[0, 0] >= 0, "it became resident while one holds it as late"
            residency.check()
    assert store.loads == {0: 1}


def test_a_load_that_was_not_begun_is_taken_over_by_who_waits_for_it() -> None:
    store = FakeStore([1, 1])
    residency = VoxelCache(store, 2 * BLOCK)
    store.gate.clear()
    with ThreadPoolExecutor(2) as pool:
        deadline = soon(0.2)
        hurried = pool.submit(take, residency, [0, 1], deadline)
        assert store.wait_for_load(0, PATIENCE)
        patient = pool.submit(take, residency, [1])
        while residency._pins.get(1, 0) < 2 or time.perf_counter() < deadline:
            time.sleep(0.001)
        store.gate.set()
        assert hurried.result(PATIENCE).late in ((1,), ()), "unless the other was faster to load it"
        assert patient.result(PATIENCE).late == ()
    assert store.loads == {0: 1, 1: 1}
    residency.check()


def test_who_waits_for_room_waits_until_the_deadline() -> None:
    store = FakeStore([1, 1, 1])
    residency = VoxelCache(store, 2 * BLOCK)
    with residency.hold([0, 1]):
        assert take(residency, [1, 2], soon()) == HeldVoxels(1, 0, (), (2,))
        residency.check()
    assert store.loads == {0: 1, 1: 1}
    assert take(residency, [1, 2], soon(PATIENCE)).late == ()


def test_many_in_a_hurry_leave_nobody_without_an_answer() -> None:
    store = FakeStore([1, 2, 1, 1, 3, 1, 2, 1])
    residency = VoxelCache(store, 5 * BLOCK)

    def one(seed: int) -> tuple[HeldVoxels, bool]:
        rng = np.random.default_rng(seed)
        rows = rng.permutation(8)[: rng.integers(1, 3)].tolist()
        hurried = bool(rng.integers(2))
        return take(
            residency, rows, soon(rng.choice([0.0, 1e-5, 1e-4])) if hurried else float("inf")
        ), hurried

    with ThreadPoolExecutor(8) as pool:
        for held, hurried in pool.map(one, range(600), timeout=10 * PATIENCE):
            assert hurried or not held.late
    residency.check()
    assert not residency._pins and not residency._loading
