"""Prefetching: what is wanted comes before it is asked for, soonest first, and never in anybody's way."""

import time
from collections.abc import Callable

import numpy as np
import pytest
from fake_store import BLOCK, FakeStore
from solidcloud.server.residency.motion_prediction import PredictedVoxels, User
from solidcloud.server.residency.prefetch import Prefetcher
from solidcloud.server.residency.voxel_cache import VoxelCache

PATIENCE = 20.0  # [s], for what takes microseconds when it is right
ANNA = ("client", "anna")


class Wishes:
    """A neighbourhood that wants what it is told to. wanted: row -> seconds.  standing: rows kept."""

    def __init__(self) -> None:
        self.wanted: dict[int, float] = {}
        self.standing: list[int] = []
        self.gone: list[str] = []
        self.plans = 0

    def record_pose(self, user: User, now: float, center: tuple[float, float, float], reach: float) -> bool:
        """Whether a user comes from nowhere is read off its reach."""
        return reach > 100.0

    def leave_client(self, client: str) -> None:
        """A client went, and nothing is wanted any more."""
        self.gone.append(client)
        self.wanted, self.standing = {}, []

    def expire(self, now: float, after: float) -> None:
        """Nobody is."""

    def plan(self, now: float, load_seconds: float) -> PredictedVoxels:
        """What is wanted, soonest first."""
        self.plans += 1
        rows = sorted(self.wanted, key=lambda row: self.wanted[row])
        need = np.array([self.wanted[row] for row in rows])
        return PredictedVoxels(np.array(rows, np.int64), need)

    def kept(self) -> np.ndarray:
        """What users stand in."""
        return np.array(self.standing, np.int64)


class Table:
    """A residency of voxels of some blocks each, its prefetcher, and who wishes."""

    def __init__(self, sizes: list[int], blocks: int, **options: object) -> None:
        self.store = FakeStore(sizes)
        self.residency = VoxelCache(self.store, blocks * BLOCK)  # type: ignore[arg-type]
        self.wishes = Wishes()
        self.prefetcher = Prefetcher(self.residency, self.wishes, **options)  # type: ignore[arg-type]

    def see(self) -> None:
        """A user moves."""
        self.prefetcher.record_pose(ANNA, (0.0, 0.0, 0.0), 1.0)

    def resident(self) -> list[int]:
        """The rows that are there."""
        return np.flatnonzero(self.residency.where[:, 0] >= 0).tolist()


def until(condition: Callable[[], bool]) -> bool:
    """Whether it comes to be, before patience ends."""
    end = time.monotonic() + PATIENCE
    while not condition() and time.monotonic() < end:
        time.sleep(0.001)
    return condition()


def test_what_is_wanted_is_loaded_soonest_first_and_counted() -> None:
    table = Table([1] * 5, 5)
    table.wishes.wanted = {3: 0.5, 1: 0.1, 4: 2.0}
    with table.prefetcher:
        table.see()
        assert until(lambda: table.resident() == [1, 3, 4])
        assert list(table.store.loads) == [1, 3, 4], "in this order"
        with table.residency.hold([1]) as held:
            assert (held.hits, held.misses) == (1, 0)
        counters = table.residency.counters()
        assert (counters.prefetched, counters.used, counters.wasted) == (3, 1, 0)
        assert counters.prefetched_bytes == 3 * BLOCK
    table.residency.check()


def test_what_users_stand_in_or_need_sooner_does_not_go() -> None:
    table = Table([1] * 6, 3)
    table.wishes.wanted = {0: 0.0, 1: 0.2, 2: 0.4, 3: 0.6, 4: 0.8}
    table.wishes.standing = [0]
    with table.prefetcher:
        table.see()
        assert until(lambda: table.resident() == [0, 1, 2])
        plans = table.wishes.plans
        table.see()
        assert until(lambda: table.wishes.plans > plans)
        assert table.resident() == [0, 1, 2] and table.residency.evictions == 0
        # A request may have the room of what is only wanted, and of what is stood in last of all.
        with table.residency.hold([4, 5]) as held:
            assert held.misses == 2 and table.resident() == [0, 4, 5]
        assert table.residency.counters().wasted == 2
        with table.residency.hold([1, 2, 3]):
            assert table.resident() == [1, 2, 3]
    table.residency.check()


def test_nothing_is_begun_while_a_request_waits() -> None:
    table = Table([1] * 3, 3)
    table.store.gate.clear()
    table.wishes.wanted = {1: 0.1}
    with table.prefetcher:
        from concurrent.futures import ThreadPoolExecutor

        with ThreadPoolExecutor(1) as pool:
            asked = pool.submit(lambda: table.residency.acquire([0]))
            assert table.store.wait_for_load(0, PATIENCE)
            table.see()
            assert until(lambda: table.wishes.plans > 0)
            assert not table.store.wait_for_load(1, 0.05)
            table.store.gate.set()
            assert asked.result(PATIENCE).misses == 1
        assert until(lambda: table.resident() == [0, 1])
        table.residency.release([0])


def test_what_came_too_late_for_a_request_is_loaded_after_it() -> None:
    table = Table([1] * 3, 2, prefetch=False)
    with table.prefetcher:
        with table.residency.hold([0, 2], deadline=0.0) as held:
            assert held.late == (0, 2)
        assert until(lambda: table.resident() == [0, 2])
        counters = table.residency.counters()
        assert (counters.late, counters.prefetched, counters.used) == (2, 0, 0)
    table.residency.check()


@pytest.mark.parametrize("fault", ["corrupt", "unreadable", "out of memory"])
def test_a_load_that_fails_leaves_nothing_and_the_next_goes_on(fault: str) -> None:
    table = Table([1] * 3, 3)
    table.store.faults[0] = fault
    table.wishes.wanted = {0: 0.1, 1: 0.2}
    with table.prefetcher:
        table.see()
        assert until(lambda: table.store.loads[0] > 0)
        table.see()
        assert until(lambda: table.resident() == [1])
        table.wishes.wanted = {}
        counters = table.residency.counters()
        assert counters.prefetched == 1 + counters.failed and counters.wasted == counters.failed >= 1
        table.store.faults.clear()
        with table.residency.hold([0]) as held:
            assert bool(held.faults) == (fault == "corrupt")
    table.residency.check()


def test_a_client_that_goes_keeps_nothing() -> None:
    table = Table([1] * 3, 3)
    table.wishes.wanted, table.wishes.standing = {0: 0.0}, [0]
    with table.prefetcher:
        table.see()
        assert until(lambda: table.residency.kept == {0} and table.resident() == [0])
        table.prefetcher.leave_client("client")
        assert until(lambda: not table.residency.kept)
        assert table.wishes.gone == ["client"]


def test_who_comes_from_nowhere_is_told_so_and_idle_time_is_used() -> None:
    left = iter([True, True, False])
    calls: list[bool] = []
    table = Table([1] * 3, 3, idle=lambda: calls.append(True) or next(left))
    with table.prefetcher:
        assert table.prefetcher.record_pose(ANNA, (0.0, 0.0, 0.0), 1e3)
        assert not table.prefetcher.record_pose(ANNA, (0.0, 0.0, 0.0), 1.0)
        assert until(lambda: len(calls) == 3)


def test_after_a_stop_nothing_is_loaded() -> None:
    table = Table([1] * 3, 3)
    table.wishes.wanted = {0: 0.0}
    table.prefetcher.stop()
    table.see()
    with table.residency.hold([1], deadline=0.0) as held:
        assert held.late == (1,)
    time.sleep(0.02)
    assert not table.store.loads
    table.prefetcher.stop()
