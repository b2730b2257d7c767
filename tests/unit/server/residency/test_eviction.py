"""Policies: each against a naive model of lists, in random runs of demands, prefetches, scans, faults and evictions."""

from collections.abc import Sequence
from itertools import islice

import numpy as np
import pytest
from numpy.typing import NDArray
from solidcloud.schemas.errors import BadRequestError
from solidcloud.server.residency.eviction import POLICIES, EvictionPolicy, make_policy, prefetches

BUDGET = 1000


def near(rows: Sequence[int]) -> NDArray[np.float64]:
    """How near rows are, with many as near as others."""
    return np.array([(row * 7) % 5 + (np.inf if row % 11 == 0 else 0.0) for row in rows])


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

    def removed(self, row: int, evicted: bool) -> None:
        self.order.remove(row)
        if row in self.scans:
            self.scans.remove(row)

    def next_after(self, named: list[int]) -> int | None:
        """Who goes next when those named have gone."""
        scans = [row for row in self.scans if row not in named]
        if sum(self.size[row] for row in scans) > BUDGET // 10:
            return scans[0]
        return next((row for row in self.order if row not in named), None)


class NaiveDistance(NaiveLru):
    """Farthest first, then least recently used."""

    def next_after(self, named: list[int]) -> int | None:
        left = [row for row in self.order if row not in named]
        return max(left, key=lambda row: near([row])[0]) if left else None  # of equals the first


class NaiveS3Fifo:
    """Algorithm 1 of the paper, in lists of [row, size, uses]."""

    def __init__(self) -> None:
        self.small: list[list[int]] = []
        self.main: list[list[int]] = []
        self.ghost: list[tuple[int, int]] = []

    def added(self, row: int, size: int, scan: bool) -> None:
        known = [entry for entry in self.ghost if entry[0] == row]
        if known and not scan:
            self.ghost.remove(known[0])
            self.main.append([row, size, 0])
        else:
            self.small.append([row, size, 0])

    def used(self, row: int, scan: bool) -> None:
        for entry in self.small + self.main:
            if entry[0] == row and not scan:
                entry[2] = min(entry[2] + 1, 3)

    def removed(self, row: int, evicted: bool) -> None:
        for entry in [entry for entry in self.small if entry[0] == row and evicted]:
            self.ghost = [(old, size) for old, size in self.ghost if old != row] + [(row, entry[1])]
        while sum(size for _, size in self.ghost) > BUDGET - BUDGET // 10:
            self.ghost.pop(0)
        self.small = [entry for entry in self.small if entry[0] != row]
        self.main = [entry for entry in self.main if entry[0] != row]

    def next_after(self, named: list[int]) -> int | None:
        if not named:
            return self.evict_next()
        looked_up = NaiveS3Fifo()
        looked_up.small = [list(entry) for entry in self.small]
        looked_up.main = [list(entry) for entry in self.main]
        for row in named:
            assert looked_up.evict_next() == row
            looked_up.removed(row, False)
        return looked_up.evict_next()

    def evict_next(self) -> int | None:
        """Who goes next; others move on the way."""
        while self.small or self.main:
            if self.small and (sum(size for _, size, _ in self.small) >= BUDGET // 10 or not self.main):
                row, size, uses = self.small[0]
                if uses <= 1:
                    return row
                self.small.pop(0)
                self.main.append([row, size, 0])
            else:
                row, size, uses = self.main[0]
                if uses == 0:
                    return row
                self.main.pop(0)
                self.main.append([row, size, uses - 1])
        return None


Naive = NaiveLru | NaiveDistance | NaiveS3Fifo
NAIVE: dict[str, type[Naive]] = {
    "lru": NaiveLru,
    "lru+prefetch": NaiveLru,
    "distance": NaiveDistance,
    "s3fifo": NaiveS3Fifo,
}


def named(policy: EvictionPolicy, naive: Naive, most: int) -> list[int]:
    """The first victims of a policy, which are the naive one's."""
    found = list(islice(policy.victims(), most))
    expected: list[int] = []
    while len(expected) < most and (row := naive.next_after(expected)) is not None:
        expected.append(row)
    assert found == expected
    return found


def test_every_policy_has_a_name_and_a_model() -> None:
    assert set(NAIVE) == set(POLICIES)
    assert [make_policy(name, BUDGET, near).name for name in POLICIES] == list(POLICIES)
    assert [prefetches(name) for name in POLICIES] == [False, True, True, True]


@pytest.mark.parametrize("seed", range(30))
@pytest.mark.parametrize("name", POLICIES)
def test_a_policy_does_as_its_model(name: str, seed: int) -> None:
    rng = np.random.default_rng([seed, len(name)])
    policy, naive = make_policy(name, BUDGET, near), NAIVE[name]()
    resident: dict[int, int] = {}
    evictions = scans = 0
    for _ in range(400):
        row, scan = int(rng.integers(60)), bool(rng.random() < 0.3)
        if row in resident:
            policy.used(row, scan=scan)
            naive.used(row, scan)
        else:
            size = int(rng.integers(1, 150))
            while sum(resident.values()) + size > BUDGET:
                # The first few are in use, now and then.
                skipped = int(rng.integers(3)) if rng.random() < 0.2 else 0
                victims = named(policy, naive, skipped + 1)
                policy.removed(victims[-1], evicted=True)
                naive.removed(victims[-1], True)
                del resident[victims[-1]]
                evictions += 1
            resident[row] = size
            policy.added(row, size, scan=scan)
            naive.added(row, size, scan)
            scans += scan
            if rng.random() < 0.1:  # the record was corrupt
                policy.removed(row, evicted=False)
                naive.removed(row, False)
                del resident[row]
        if rng.random() < 0.1:
            assert sorted(named(policy, naive, 100)) == sorted(resident)
    assert evictions > 20 and scans > 20


@pytest.mark.parametrize("name", POLICIES)
def test_nothing_resident_has_no_victims(name: str) -> None:
    policy = make_policy(name, BUDGET, near)
    assert list(policy.victims()) == []
    policy.added(3, 10, scan=False)
    policy.removed(3, evicted=True)
    assert list(policy.victims()) == []


@pytest.mark.parametrize("name", ["lru", "lru+prefetch"])
def test_a_scan_does_not_wash_out_what_users_stand_in(name: str) -> None:
    policy = make_policy(name, BUDGET)
    for row in range(9):
        policy.added(row, 100, scan=False)
    room = BUDGET - 900
    for row in range(100, 200):
        while room < 40:
            victim = next(policy.victims())
            policy.removed(victim, evicted=True)
            room += 100 if victim < 100 else 40
        policy.added(row, 40, scan=True)
        room -= 40
    left = list(policy.victims())
    assert {row for row in left if row < 100} == set(range(1, 9)), (
        "one made room for the scans' share, no more"
    )
    assert {row for row in left if row >= 100} <= set(range(195, 200))


def test_what_somebody_else_uses_is_a_scan_s_no_more() -> None:
    policy = make_policy("lru", BUDGET)
    policy.added(1, 100, scan=False)
    policy.added(2, 80, scan=True)
    policy.added(3, 80, scan=True)
    assert list(policy.victims()) == [2, 1, 3], "over their share, until the first has gone"
    policy.used(2, scan=True)
    assert list(policy.victims()) == [3, 1, 2]
    policy.used(3, scan=False)
    assert list(policy.victims()) == [1, 2, 3]


def test_what_was_used_twice_outlives_what_was_new_once() -> None:
    """And what the ghost knows comes back into the main queue; a scan learns nothing from it."""
    policy = make_policy("s3fifo", BUDGET)
    for row in (1, 2, 3):
        policy.added(row, 100, scan=False)
    for _ in range(2):
        policy.used(1, scan=False)
        policy.used(2, scan=True)
    assert list(policy.victims()) == [2, 3, 1]
    for row in (2, 3):
        policy.removed(row, evicted=True)
    policy.added(2, 100, scan=False)
    policy.added(3, 100, scan=True)
    policy.added(4, 100, scan=False)
    assert list(policy.victims()) == [3, 4, 1, 2]


@pytest.mark.parametrize("name", POLICIES)
def test_to_look_at_all_victims_changes_nothing(name: str) -> None:
    """Whoever checks, or asks what is resident, walks all of them."""
    rng = np.random.default_rng(4)
    looked_at, left_alone = make_policy(name, BUDGET, near), make_policy(name, BUDGET, near)
    for policy in (looked_at, left_alone):
        for row in range(20):
            policy.added(row, 40, scan=False)
    for row in rng.integers(0, 20, 60).tolist():
        looked_at.used(row, scan=False)
        left_alone.used(row, scan=False)
    first = next(looked_at.victims())
    assert next(left_alone.victims()) == first
    order = list(looked_at.victims())
    assert list(looked_at.victims()) == order == list(left_alone.victims()) and order[0] == first
    for victim in order:
        assert next(left_alone.victims()) == victim
        left_alone.removed(victim, evicted=True)


@pytest.mark.parametrize("some", [1, 3, 39, 40, 41])
def test_distance_puts_some_in_order_before_the_rest(some: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """In whatever parts, the order is the model's; and rows that go leave the others as they were."""
    monkeypatch.setattr("solidcloud.server.residency.eviction.SORTED_ROWS", some)
    rng = np.random.default_rng(some)
    policy, naive = make_policy("distance", BUDGET, near), NaiveDistance()
    for row in rng.permutation(200)[:100].tolist():  # more than there is room for at first
        policy.added(row, 1, scan=False)
        naive.added(row, 1, False)
    for row in rng.choice(naive.order, 300).tolist():
        policy.used(row, scan=False)
        naive.used(row, False)
    for row in rng.permutation(naive.order)[:60].tolist():
        policy.removed(row, evicted=True)
        naive.removed(row, True)
    assert len(named(policy, naive, 100)) == 40


def test_without_users_distance_is_lru() -> None:
    policy = make_policy("distance", BUDGET, lambda rows: np.full(len(rows), np.inf))
    for row in (5, 2, 9):
        policy.added(row, 1, scan=False)
    policy.used(5, scan=False)
    assert list(policy.victims()) == [2, 9, 5]


def test_an_unknown_policy_is_refused() -> None:
    with pytest.raises(
        BadRequestError, match="policy 'mru': expected one of lru, lru\\+prefetch, distance, s3fifo"
    ):
        make_policy("mru", BUDGET)
    with pytest.raises(ValueError, match="expected path_distances"):
        make_policy("distance", BUDGET)
