"""Policies: each against a naive model of lists, in random runs of demands, prefetches, scans, faults and evictions."""

from itertools import islice

import numpy as np
import pytest
from solidcloud.schemas.errors import BadRequestError
from solidcloud.server.residency.eviction import EvictionPolicy

BUDGET = 1000


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
        if sum(self.size[row] for row in scans) > BUDGET // 10:
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
    policy, naive = EvictionPolicy(BUDGET), NaiveLru()
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
    policy = EvictionPolicy(BUDGET)
    assert list(policy.victims()) == []
    policy.added(3, 10, scan=False)
    policy.removed(3)
    assert list(policy.victims()) == []


def test_an_unknown_policy_is_refused() -> None:
    with pytest.raises(BadRequestError, match="policy 'mru': expected one of lru, lru\\+prefetch"):
        EvictionPolicy(BUDGET, "mru")
