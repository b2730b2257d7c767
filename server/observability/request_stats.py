"""Request statistics: counts and times, per user and in total.

Every request is counted here. Counting is therefore a few additions under a lock, and percentiles
are computed only when statistics are read.
"""

import threading
import time
from bisect import bisect_left
from collections import OrderedDict
from collections.abc import Callable, Iterable
from itertools import pairwise
from math import ceil
from operator import add
from typing import Any, NamedTuple, Self

import numpy as np

from ...schemas.wire.answers import Cost, Verdict
from ...schemas.wire.key_expressions import public_id
from ...schemas.wire.stats import TIME_BOUNDS, Times, UserStats

# Maximum number of users (pairs of client and avatar) kept: 2 kB each, and one row each in the
# answer of `stats`.
MAX_USERS = 256
# Number of buckets between two consecutive TIME_BOUNDS, by their ratio (2 or 2.5), so that each
# bucket is 10 % wide.
_STEPS = {2.0: 7, 2.5: 10}
_UNKNOWN = int(Verdict.UNKNOWN)


def _bounds() -> list[float]:
    """Return the upper bounds of a histogram's buckets [s]: TIME_BOUNDS and intermediate ones."""
    found = [TIME_BOUNDS[0]]
    for low, high in pairwise(TIME_BOUNDS):
        steps = _STEPS[round(high / low, 6)]
        found += [low * (high / low) ** (step / steps) for step in range(1, steps)]
        found.append(high)
    return found


BOUNDS = _bounds()
# Index in BOUNDS of each of TIME_BOUNDS.
_COARSE = [BOUNDS.index(bound) for bound in TIME_BOUNDS]


class Histogram:
    """Histogram of times [s] with buckets 10 % wide, from 1 µs to 100 s.

    Shorter times are in the first bucket, longer ones in the last.
    sum, max: of all times [s].  Not thread-safe.
    """

    __slots__ = ("_buckets", "max", "sum")

    def __init__(self) -> None:
        """Create an empty histogram."""
        self._buckets = [0] * (len(BOUNDS) + 1)
        self.sum = self.max = 0.0

    def add(self, seconds: float) -> None:
        """Add one time."""
        self._buckets[bisect_left(BOUNDS, seconds)] += 1
        self.sum += seconds
        if seconds > self.max:
            self.max = seconds

    @property
    def count(self) -> int:
        """Return the number of times."""
        return sum(self._buckets)

    def copy(self) -> "Histogram":
        """Return a copy, to be read while this object continues to change."""
        other = Histogram()
        other._buckets, other.sum, other.max = self._buckets[:], self.sum, self.max
        return other

    def merge(self, other: "Histogram") -> None:
        """Add all times of another histogram."""
        self._buckets = list(map(add, self._buckets, other._buckets))
        self.sum += other.sum
        self.max = max(self.max, other.max)

    def percentiles(self, *shares: float) -> list[float]:
        """Return the percentiles [s] for shares from 0 to 1 in ascending order.

        A percentile is at most 10 % above the true one. It is 0 if it is at most a microsecond, or
        if the histogram is empty.
        """
        found: list[float] = []
        count, passed, place = self.count, 0, -1
        for share in shares:
            while passed < max(1, ceil(share * count)) and place < len(BOUNDS):
                place += 1
                passed += self._buckets[place]
            found.append(min(BOUNDS[place], self.max) if 0 < place < len(BOUNDS) else self.max * (place > 0))
        return found

    def times(self) -> Times:
        """Return the distribution as a message of `stats`."""
        p50, p90, p99 = self.percentiles(0.5, 0.9, 0.99)
        begins = [0, *(place + 1 for place in _COARSE)]
        buckets = np.add.reduceat(np.array(self._buckets, np.int64), begins).tolist()
        return Times(self.count, self.sum, p50, p90, p99, self.max, buckets)


def times_of(seconds: Iterable[float], of_all: Times) -> Times:
    """Return the percentiles of recent times [s], with the count, sum and buckets of all times."""
    ordered = sorted(seconds)
    if not ordered:
        return of_all
    p50, p90, p99 = (ordered[max(0, ceil(share * len(ordered)) - 1)] for share in (0.5, 0.9, 0.99))
    return Times(of_all.count, of_all.sum, p50, p90, p99, ordered[-1], of_all.buckets)


class Counts:
    """Counters of requests; see `StatsAnswer`. Not thread-safe.

    stalls: time that each request waited for voxels [s].
    """

    __slots__ = ("answers", "hits", "late", "misses", "requests", "stalls", "unknown", "waited")

    def __init__(self) -> None:
        """Start all counters at 0."""
        self.requests = self.answers = self.hits = self.misses = self.late = self.unknown = self.waited = 0
        self.stalls = Histogram()

    def add(self, cost: Cost, answers: int, unknown: int) -> None:
        """Count one request with this number of answers, some of them unknown."""
        self.requests += 1
        self.answers += answers
        self.hits += cost.hits
        self.misses += cost.misses
        self.late += len(cost.late)
        self.unknown += unknown
        if cost.wait_seconds > 0.0:
            self.waited += 1
        self.stalls.add(cost.wait_seconds)

    def copy(self) -> Self:
        """Return a copy, to be read while this object continues to change."""
        other = type(self)()
        for name in (name for kind in type(self).__mro__ for name in getattr(kind, "__slots__", ())):
            setattr(other, name, getattr(self, name))
        other.stalls = self.stalls.copy()
        return other

    def merge(self, other: "Counts") -> None:
        """Add the counters of another object."""
        self.requests += other.requests
        self.answers += other.answers
        self.hits += other.hits
        self.misses += other.misses
        self.late += other.late
        self.unknown += other.unknown
        self.waited += other.waited
        self.stalls.merge(other.stalls)


class _UserCounts(Counts):
    """Counters of one user. seen: time of its last answer, on the clock of `RequestStats` [s]."""

    __slots__ = ("seen",)

    def __init__(self) -> None:
        """Start all counters at 0."""
        super().__init__()
        self.seen = 0.0


class StatsTotals(NamedTuple):
    """Totals. engine: time of each request in the engine.  loads: time of each voxel load."""

    counts: Counts
    engine: Histogram
    loads: Histogram


class RequestStats:
    """Counters of one scene. Thread-safe.

    At most MAX_USERS users have separate counters. A new user replaces the least recently active
    one, whose counts remain in the total.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """Start without any requests. clock: seconds since any epoch."""
        self._clock = clock
        self._lock = threading.Lock()
        self._users: OrderedDict[tuple[str, str], _UserCounts] = OrderedDict()  # least recently active first
        self._gone = Counts()  # of users without separate counters
        self._engine, self._loads = Histogram(), Histogram()

    def answered(self, client: str, avatar: str, answers: Cost) -> None:
        """Count an answered request of a client about an avatar; "" for no avatar or several."""
        verdict: Any = getattr(answers, "verdict", None)
        count = unknown = 0
        if verdict is not None:
            count, unknown = len(verdict), verdict.tobytes().count(_UNKNOWN)
        key = (client, avatar)
        with self._lock:
            user = self._users.get(key)
            if user is None:
                user = self._users[key] = _UserCounts()
                if len(self._users) > MAX_USERS:
                    self._gone.merge(self._users.popitem(last=False)[1])
            else:
                self._users.move_to_end(key)
            user.seen = self._clock()
            user.add(answers, count, unknown)
            self._engine.add(answers.engine_seconds)

    def loaded(self, seconds: float) -> None:
        """Record the duration of a voxel load."""
        with self._lock:
            self._loads.add(seconds)

    def drop_client(self, client: str) -> None:
        """Remove the users of a client that is gone; their counts remain in the total."""
        with self._lock:
            for key in [key for key in self._users if key[0] == client]:
                self._gone.merge(self._users.pop(key))

    def snapshot(self) -> tuple[StatsTotals, list[UserStats]]:
        """Return the total, and the statistics of each user, most recently active first."""
        with self._lock:
            total = StatsTotals(self._gone.copy(), self._engine.copy(), self._loads.copy())
            known = list(reversed(self._users.items()))
        users = []
        # Copied one at a time, because requests wait for the lock. A user that is dropped meanwhile
        # is still counted once: the copied total does not include it.
        for key, user in known:
            with self._lock:
                users.append((key, user.copy()))
        now = self._clock()
        for _, user in users:
            total.counts.merge(user)
        return total, [_user_stats(key, max(0.0, now - user.seen), user) for key, user in users]


def _user_stats(key: tuple[str, str], silent: float, user: Counts) -> UserStats:
    """Return the statistics of one user."""
    client, avatar = key
    p50, p99 = user.stalls.percentiles(0.5, 0.99)
    return UserStats(
        public_id(client),
        avatar,
        user.requests,
        user.answers,
        user.hits,
        user.misses,
        user.late,
        user.unknown,
        user.waited,
        p50,
        p99,
        user.stalls.max,
        silent,
    )
