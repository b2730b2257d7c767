"""What users asked and got, counted: against plain lists."""

import math
import sys
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from solidcloud.schemas.wire.answers import CollideAnswers
from solidcloud.schemas.wire.key_expressions import public_id
from solidcloud.schemas.wire.stats import TIME_BOUNDS, Times, UserStats
from solidcloud.server.observability import request_stats as stats_module
from solidcloud.server.observability.request_stats import Histogram, RequestStats


class Clock:
    """A clock that stands still until it is set."""

    now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def metrics(clock: Clock) -> RequestStats:
    return RequestStats(clock)


def answers(*verdicts: int, **cost: Any) -> CollideAnswers:
    """What was answered."""
    ones = np.ones(len(verdicts), np.uint32)
    return CollideAnswers(np.array(verdicts, np.uint8), ones > 1, ones, ones, ones, **cost)


def filled(values: Any) -> Histogram:
    histogram = Histogram()
    for value in values:
        histogram.add(float(value))
    return histogram


@pytest.mark.parametrize("seed", range(4))
def test_percentiles_are_those_of_all_up_to_a_tenth(seed: int) -> None:
    rng = np.random.default_rng(seed)
    values = np.sort(10 ** rng.uniform(-6, 2, rng.integers(1, 3000)))
    shares = (0.01, 0.5, 0.9, 0.99, 0.999, 1.0)
    found = filled(rng.permutation(values)).percentiles(*shares)
    for share, seconds in zip(shares, found, strict=True):
        true = values[math.ceil(share * len(values)) - 1]
        assert true <= seconds <= true * 1.105, (seed, share)


def test_the_buckets_of_stats_count_up_to_their_ends() -> None:
    rng = np.random.default_rng(7)
    # The ends themselves, too: they belong to the bucket that they end.
    values = [*(10 ** rng.uniform(-7, 3, 2000)), *TIME_BOUNDS, 0.0]
    times = filled(values).times()
    assert times.count == sum(times.buckets) == len(values)
    for bound, count in times.at_most():
        assert count == sum(value <= bound for value in values), bound
    assert times.at_most()[-1] == (math.inf, len(values))
    assert Times().at_most() == [(bound, 0) for bound in (*TIME_BOUNDS, math.inf)]


def test_a_request_counts_for_its_user_and_in_all(metrics: RequestStats, clock: Clock) -> None:
    metrics.answered("c", "al", answers(0, 2, 2, engine_seconds=0.004, hits=3, misses=1, late=(7, 9)))
    clock.now = 103.0
    metrics.answered("c", "al", answers(1, wait_seconds=0.02, engine_seconds=0.03, hits=2))
    clock.now = 104.0
    metrics.answered("c", "bo", answers(2, hits=1))
    clock.now = 110.0
    total, users = metrics.snapshot()
    al = users[1]
    assert (users[0].avatar, users[0].silent_seconds) == ("bo", 6.0), "heard of last"
    assert al == UserStats(
        public_id("c"), "al", requests=2, answers=4, hits=5, misses=1, late=2, unknown=2, waited=1,
        stall_p99=0.02, stall_max=0.02, silent_seconds=7.0,
    )  # fmt: skip
    counts = total.counts
    assert (counts.requests, counts.answers, counts.hits, counts.misses) == (3, 5, 6, 1)
    assert (counts.late, counts.unknown, counts.waited) == (2, 3, 1)
    assert (counts.stalls.count, counts.stalls.max, total.engine.count) == (3, 0.02, 3)
    assert total.engine.sum == pytest.approx(0.034)


def test_loads_are_timed(metrics: RequestStats) -> None:
    for seconds in (0.001, 0.003):
        metrics.loaded(seconds)
    loads = metrics.snapshot()[0].loads
    assert (loads.count, loads.max, loads.sum) == (2, 0.003, 0.004)


def test_a_client_that_went_is_forgotten_and_counts_in_all(metrics: RequestStats) -> None:
    for client, avatar in (("a", "al"), ("b", "al"), ("a", "bo")):
        metrics.answered(client, avatar, answers(2, wait_seconds=0.5))
    metrics.drop_client("a")
    metrics.drop_client("nobody")
    total, users = metrics.snapshot()
    assert [(user.client, user.avatar) for user in users] == [(public_id("b"), "al")]
    assert (total.counts.requests, total.counts.unknown, total.counts.stalls.count) == (3, 3, 3)
    metrics.answered("a", "al", answers(0))
    assert metrics.snapshot()[1][0].requests == 1, "it begins anew"


def test_the_longest_silent_is_forgotten_for_a_new_one(
    metrics: RequestStats, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stats_module, "MAX_USERS", 3)
    for client in "abcadae":
        metrics.answered(client, "al", answers(0, hits=1))
    total, users = metrics.snapshot()
    assert [user.client for user in users] == [public_id(client) for client in "ead"]
    assert (total.counts.requests, total.counts.hits) == (7, 7)
    assert [user.requests for user in users] == [1, 3, 1]


def run_all(work: Callable[[int], None], count: int) -> None:
    """Run work(0), work(1), ... at the same time."""
    threads = [threading.Thread(target=work, args=(number,)) for number in range(count)]
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(60)
    finally:
        sys.setswitchinterval(before)
    assert not any(thread.is_alive() for thread in threads)


def test_nothing_is_lost_between_threads(metrics: RequestStats, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stats_module, "MAX_USERS", 3)
    torn = []

    def work(number: int) -> None:
        seen = 0
        for turn in range(300):
            metrics.answered(str((number + turn) % 5), "al", answers(0, 2, hits=2, wait_seconds=0.001))
            metrics.loaded(0.001)
            if turn % 10 == 0:
                counts = metrics.snapshot()[0].counts
                whole = (
                    counts.requests * 2 == counts.answers == counts.hits and counts.unknown == counts.waited
                )
                if not whole or not seen <= counts.requests <= 1200:
                    torn.append((seen, counts.requests))
                seen = counts.requests
            if turn % 70 == 0:
                metrics.drop_client("1")

    run_all(work, 4)
    total, users = metrics.snapshot()
    assert not torn
    counts = total.counts
    assert (counts.requests, counts.answers, counts.hits, counts.unknown) == (1200, 2400, 2400, 1200)
    assert (counts.stalls.count, total.engine.count, total.loads.count) == (1200, 1200, 1200)
    assert len(users) <= 3
