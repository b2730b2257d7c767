"""Policies: each against a naive model of lists, in random runs of demands, prefetches, scans, faults and evictions."""

from collections.abc import Sequence
from itertools import islice

import numpy as np
import pytest
from numpy.typing import NDArray
from solidcloud.schemas.errors import BadRequestError
from solidcloud.server.residency.eviction import POLICIES, EvictionPolicy, make_policy

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


LRU = ("lru", "lru+prefetch")


def named(policy: EvictionPolicy, naive: NaiveLru, most: int) -> list[int]:
    """The first victims of a policy, which are the naive one's."""
    found = list(islice(policy.victims(), most))
    expected: list[int] = []
    while len(expected) < most and (row := naive.next_after(expected)) is not None:
        expected.append(row)
    assert found == expected
    return found


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("name", LRU)
def test_a_policy_does_as_its_model(name: str, seed: int) -> None:
    rng = np.random.default_rng([seed, len(name)])
    policy, naive = make_policy(name, BUDGET, near), NaiveLru()
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


def test_an_unknown_policy_is_refused() -> None:
    with pytest.raises(
        BadRequestError, match="policy 'mru': expected one of lru, lru\\+prefetch, distance, s3fifo"
    ):
        make_policy("mru", BUDGET)
    with pytest.raises(ValueError, match="expected path_distances"):
        make_policy("distance", BUDGET)
