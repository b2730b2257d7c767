"""What users asked and got: counts and times, a user and in all.

Every request passes here, so what is done for one is a few additions under a lock; percentiles are worked out when
somebody wants to see them.
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

from ..schemas.answers import Cost, Verdict
from ..schemas.keys import public_id
from ..schemas.stats import TIME_BOUNDS, Times, UserStats

# Users remembered, a client's avatar each: 2 kB apiece, and as many lines of an answer of `stats`.
MOST_USERS = 256
# Buckets between two of TIME_BOUNDS, 2 or 2.5 times apart: each is a tenth wide.
_STEPS = {2.0: 7, 2.5: 10}
_UNKNOWN = int(Verdict.UNKNOWN)


def _bounds() -> list[float]:
    """Upper ends of a histogram's buckets [s]: TIME_BOUNDS, and others in between."""
    found = [TIME_BOUNDS[0]]
    for low, high in pairwise(TIME_BOUNDS):
        steps = _STEPS[round(high / low, 6)]
        found += [low * (high / low) ** (step / steps) for step in range(1, steps)]
        found.append(high)
    return found


BOUNDS = _bounds()
# The place in BOUNDS of each of TIME_BOUNDS.
_COARSE = [BOUNDS.index(bound) for bound in TIME_BOUNDS]


class Histogram:
    """Times [s] in buckets a tenth wide, from 1 µs to 100 s; what is shorter or longer is in the first or the last.

    sum, max: of all [s].  Not thread-safe.
    """

    __slots__ = ("_buckets", "max", "sum")

    def __init__(self) -> None:
        """Empty."""
        self._buckets = [0] * (len(BOUNDS) + 1)
        self.sum = self.max = 0.0

    def add(self, seconds: float) -> None:
        """One more."""
        self._buckets[bisect_left(BOUNDS, seconds)] += 1
        self.sum += seconds
        if seconds > self.max:
            self.max = seconds

    @property
    def count(self) -> int:
        """How many there are."""
        return sum(self._buckets)

    def copy(self) -> "Histogram":
        """The same, to be read while this one goes on."""
        other = Histogram()
        other._buckets, other.sum, other.max = self._buckets[:], self.sum, self.max
        return other

    def merge(self, other: "Histogram") -> None:
        """All of another's more."""
        self._buckets = list(map(add, self._buckets, other._buckets))
        self.sum += other.sum
        self.max = max(self.max, other.max)

    def percentiles(self, *shares: float) -> list[float]:
        """For each share, rising from 0 to 1, what so many took no longer than [s]: up to a tenth more than is true.

        0 where that is a microsecond or less, and where there are none.
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
        """As `stats` says it."""
        p50, p90, p99 = self.percentiles(0.5, 0.9, 0.99)
        begins = [0, *(place + 1 for place in _COARSE)]
        buckets = np.add.reduceat(np.array(self._buckets, np.int64), begins).tolist()
        return Times(self.count, self.sum, p50, p90, p99, self.max, buckets)


def times_of(seconds: Iterable[float], of_all: Times) -> Times:
    """Percentiles of the times of late [s], with the count, sum and buckets of all."""
    ordered = sorted(seconds)
    if not ordered:
        return of_all
    p50, p90, p99 = (ordered[max(0, ceil(share * len(ordered)) - 1)] for share in (0.5, 0.9, 0.99))
    return Times(of_all.count, of_all.sum, p50, p90, p99, ordered[-1], of_all.buckets)


class Counts:
    """What some requests asked and got; see `StatsAnswer`. stalls: what each waited for voxels [s]. Not thread-safe."""

    __slots__ = ("answers", "hits", "late", "misses", "requests", "stalls", "unknown", "waited")

    def __init__(self) -> None:
        """None yet."""
        self.requests = self.answers = self.hits = self.misses = self.late = self.unknown = self.waited = 0
        self.stalls = Histogram()

    def add(self, cost: Cost, answers: int, unknown: int) -> None:
        """One request more."""
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
        """The same, to be read while this one goes on."""
        other = type(self)()
        for name in (name for kind in type(self).__mro__ for name in getattr(kind, "__slots__", ())):
            setattr(other, name, getattr(self, name))
        other.stalls = self.stalls.copy()
        return other

    def merge(self, other: "Counts") -> None:
        """All of another's requests more."""
        self.requests += other.requests
        self.answers += other.answers
        self.hits += other.hits
        self.misses += other.misses
        self.late += other.late
        self.unknown += other.unknown
        self.waited += other.waited
        self.stalls.merge(other.stalls)


class User(Counts):
    """The same of one user. seen: when it was answered last, by the clock of its `Metrics` [s]."""

    __slots__ = ("seen",)

    def __init__(self) -> None:
        """None yet."""
        super().__init__()
        self.seen = 0.0


class Total(NamedTuple):
    """What all requests came to. engine: their seconds in the engine; loads: those of the loads."""

    counts: Counts
    engine: Histogram
    loads: Histogram


class Metrics:
    """The counts of one scene. Thread-safe.

    MOST_USERS users are remembered one by one; the longest silent is forgotten for a new one. In all they still count.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """Nothing was asked yet. clock: seconds, from anywhere."""
        self._clock = clock
        self._lock = threading.Lock()
        self._users: OrderedDict[tuple[str, str], User] = OrderedDict()  # the longest silent first
        self._gone = Counts()  # of users that are not remembered
        self._engine, self._loads = Histogram(), Histogram()

    def answered(self, client: str, avatar: str, answers: Cost) -> None:
        """A request of a client about an avatar was answered; avatar "": about none, or several."""
        verdict: Any = getattr(answers, "verdict", None)
        count = unknown = 0
        if verdict is not None:
            count, unknown = len(verdict), verdict.tobytes().count(_UNKNOWN)
        key = (client, avatar)
        with self._lock:
            user = self._users.get(key)
            if user is None:
                user = self._users[key] = User()
                if len(self._users) > MOST_USERS:
                    self._gone.merge(self._users.popitem(last=False)[1])
            else:
                self._users.move_to_end(key)
            user.seen = self._clock()
            user.add(answers, count, unknown)
            self._engine.add(answers.engine_seconds)

    def loaded(self, seconds: float) -> None:
        """A voxel was loaded, which took so long."""
        with self._lock:
            self._loads.add(seconds)

    def drop_client(self, client: str) -> None:
        """A client is gone."""
        with self._lock:
            for key in [key for key in self._users if key[0] == client]:
                self._gone.merge(self._users.pop(key))

    def snapshot(self) -> tuple[Total, list[UserStats]]:
        """What it came to in all, and for each user that is remembered, those heard of last first."""
        with self._lock:
            total = Total(self._gone.copy(), self._engine.copy(), self._loads.copy())
            known = list(reversed(self._users.items()))
        users = []
        # One by one, for requests wait meanwhile. One that is forgotten now is counted all the same: it was not before.
        for key, user in known:
            with self._lock:
                users.append((key, user.copy()))
        now = self._clock()
        for _, user in users:
            total.counts.merge(user)
        return total, [_user_stats(key, max(0.0, now - user.seen), user) for key, user in users]


def _user_stats(key: tuple[str, str], silent: float, user: Counts) -> UserStats:
    """What is said of one user."""
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
