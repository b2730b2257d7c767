"""Offline replay of traces against the server's policies and prediction.

It uses no clock and no threads, and reads no data. Loading is modelled: one loader, with a time per
load and per byte, demands first and in their order; a load that has begun is finished. A demand
whose voxel is absent or still loading is a miss, and waits for it. The trace continues meanwhile,
as the users of an open loop do. Fragmentation of the arena is not modelled.
"""

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import islice, pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from solidcloud.server.residency.prefetch import PREFETCH_OPTIONS, SILENCE, PrefetchOptions
from solidcloud.server.residency.voxel_cache import EvictionPolicy, prefetches

from .replay_requests import NOBODY, Requests, Town

# Quantile of the load times that predictions assume.
USUAL = 0.9


class Loading(NamedTuple):
    """Model of load times: per_load + per_byte * bytes [s].

    plan_seconds: interval of plans.
    """

    per_load: float = 1e-3
    per_byte: float = 5e-9
    plan_seconds: float = 0.05


LOADING = Loading()


@dataclass
class Outcome:
    """Result of a replay.

    misses: references to absent voxels, each load counted once; `misses_later` after the users'
    first second.
    late: misses whose load was already running as a prefetch.
    frames_missed, frames_missed_later: requests that waited.
    waits: of each request [s].
    prefetched, vain: prefetches, and wasted ones, which were evicted or left at the end without a
    demand; the same in bytes.
    evictions: all.
    misses_swept: of sweeps, also included in `misses`. Sweeps count neither waits nor frames, and
    do not use prefetches.
    """

    requests: int = 0
    references: int = 0
    misses: int = 0
    misses_later: int = 0
    late: int = 0
    frames_missed: int = 0
    frames_missed_later: int = 0
    prefetched: int = 0
    prefetched_bytes: int = 0
    vain: int = 0
    vain_bytes: int = 0
    evictions: int = 0
    misses_swept: int = 0
    waits: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))

    def row(self) -> dict[str, float]:
        """Return the figures for tables.

        Waits are percentiles [ms], over the frames that waited and over all.
        """
        figures = {name: value for name, value in vars(self).items() if name != "waits"}
        missed = self.waits[self.waits > 0] * 1e3
        figures["wait_p50_ms"] = float(np.percentile(missed, 50)) if len(missed) else 0.0
        figures["wait_p99_ms"] = float(np.percentile(missed, 99)) if len(missed) else 0.0
        figures["frame_p99_ms"] = float(np.percentile(self.waits, 99) * 1e3) if len(self.waits) else 0.0
        figures["vain_share"] = self.vain_bytes / self.prefetched_bytes if self.prefetched_bytes else 0.0
        return figures


# One request: its number, its rows, its user, its time [s], and whether it is in the user's first
# second.
Each = tuple[int, list[int], int, float, bool]


def plan_turns(times: list[float], seconds: float) -> list[int]:
    """Return the requests at which a plan is made: the first, then one after each interval."""
    turns: list[int] = []
    due = -math.inf
    for number, time in enumerate(times):
        if time >= due:
            turns.append(number)
            due = time + seconds
    return turns


class Replay:
    """One replay with one policy.

    Demands pin what they need; with prefetching, users' positions are pinned.
    """

    def __init__(
        self,
        town: Town,
        budget_bytes: int,
        name: str,
        *,
        loading: Loading = LOADING,
        ahead: PrefetchOptions = PREFETCH_OPTIONS,
    ) -> None:
        """Prepare an empty cache. name: of the policy."""
        self.budget_bytes, self.prefetch, self.loading = budget_bytes, prefetches(name), loading
        self.tracks = town.user_tracks(ahead)
        self.policy = EvictionPolicy(budget_bytes, name)
        self.sizes = town.sizes.tolist()
        self.costs = (loading.per_load + town.sizes * loading.per_byte).tolist()
        self.usual = float(np.quantile(self.costs, USUAL)) if self.costs else 0.0
        self.resident: set[int] = set()  # loaded or being loaded: rows with allocated room
        self.bytes = 0
        self.ready: dict[int, float] = {}  # completion time of rows being loaded
        self.unused: set[int] = set()  # prefetched and not demanded yet
        self.kept: frozenset[int] = frozenset()
        self.need: dict[int, float] = {}
        self.queue: deque[tuple[int, float]] = deque()
        self.free = self.planned = -math.inf
        self.found = Outcome()

    def run(self, requests: Requests) -> Outcome:
        """Replay all requests from an empty cache.

        Raises ValueError where a single request exceeds the budget.
        """
        found, asked = self.found, requests.asked
        most = max((sum(self.sizes[row] for row in rows) for rows in requests.rows), default=0)
        if most > self.budget_bytes:
            raise ValueError(f"a request needs {most} bytes, the budget is {self.budget_bytes}: give more")
        waits = np.zeros(len(requests.rows))
        each = zip(
            range(len(waits)), requests.rows, asked.user.tolist(), asked.time.tolist(), requests.first.tolist(),
            strict=True,
        )  # fmt: skip
        if self.prefetch:
            self.run_planned(requests, each, waits)
        else:
            self.run_some(each, asked.scan.tolist(), waits, -1)
        found.requests, found.references = len(requests.rows), len(requests.flat)
        found.waits = waits[asked.user != NOBODY]
        for row in self.unused:
            found.vain += 1
            found.vain_bytes += self.sizes[row]
        return found

    def run_planned(self, requests: Requests, each: Iterator[Each], waits: NDArray[np.float64]) -> None:
        """Replay with users' positions known, from one plan to the next.

        A plan is made at a request, when its pose is known. All poses until the next plan are
        registered at once, because nothing reads them before.
        """
        asked = requests.asked
        somebody = np.flatnonzero(asked.user != NOBODY)
        users = [("", str(user)) for user in asked.user[somebody].tolist()]
        places = [tuple(place) for place in asked.center[somebody].tolist()]
        poses = list(
            zip(users, asked.time[somebody].tolist(), places, asked.reach[somebody].tolist(), strict=True)
        )
        scans, every = asked.scan.copy(), asked.time.tolist()
        plans = plan_turns(every, self.loading.plan_seconds)
        seen = 0
        for begin, end in pairwise([-1, *plans, len(every)]):
            if begin >= 0:
                now = every[begin]
                self.run_until(now)
                self.plan(now)
            upto = int(np.searchsorted(somebody, end, side="right"))
            some = slice(seen, upto)
            scans[somebody[some]] |= np.array(
                [self.tracks.record_pose(*pose) for pose in poses[some]], np.bool_
            )
            seen = upto
            if begin >= 0:
                self.run_some(islice(each, end - begin), scans[begin:end].tolist(), waits, begin)

    def run_some(
        self, each: Iterator[Each], scans: list[bool], waits: NDArray[np.float64], planned: int
    ) -> None:
        """Answer requests in turn, prefetch meanwhile, and fill in their waits.

        planned: the request at which a plan was made; its prefetches begin with the next request.
        """
        resident, ready, unused, queue = self.resident, self.ready, self.unused, self.queue
        used = self.policy.used
        for scan, (number, rows, user, time, first) in zip(scans, each, strict=True):
            if (ready or queue) and number != planned:
                self.run_until(time)
            if not ready and resident.issuperset(rows):
                for row in rows:
                    used(row, scan=scan)
                if unused and user != NOBODY:
                    unused.difference_update(rows)
                continue
            self.answer(number, rows, user, time, first, scan, waits)

    def answer(
        self, number: int, rows: list[int], user: int, time: float, first: bool, scan: bool, waits: NDArray[np.float64]
    ) -> None:  # fmt: skip
        """Answer one request that may have to wait, and count it."""
        found = self.found
        missed = found.misses
        wait = self.demand(rows, time, scan)
        if user == NOBODY:
            found.misses_swept += found.misses - missed
            return
        self.unused.difference_update(rows)
        waits[number] = wait
        found.frames_missed += wait > 0
        if not first:
            found.misses_later += found.misses - missed
            found.frames_missed_later += wait > 0

    def demand(self, rows: list[int], now: float, scan: bool) -> float:
        """Make rows resident; return the wait of their request [s]."""
        self.settle(now)
        until = now
        absent = []
        for row in rows:
            if row not in self.resident:
                absent.append(row)
                continue
            self.policy.used(row, scan=scan)
            if row in self.ready:
                until = max(until, self.ready[row])
                self.found.late += row in self.unused
                self.found.misses += row in self.unused
        for row in absent:
            self.make_room(row, rows)
            until = max(until, self.load(row, now, scan))
            self.found.misses += 1
        return until - now

    def settle(self, now: float) -> None:
        """Forget loads that have ended."""
        for row in [row for row, there in self.ready.items() if there <= now]:
            del self.ready[row]

    def load(self, row: int, now: float, scan: bool) -> float:
        """Begin a load that has room, when the loader is free; return when it ends."""
        self.free = self.ready[row] = max(self.free, now) + self.costs[row]
        self.resident.add(row)
        self.bytes += self.sizes[row]
        self.policy.added(row, self.sizes[row], scan=scan)
        return self.free

    def make_room(self, row: int, own: list[int]) -> None:
        """Make room for a demand: evict rows where no user stands, else any but the request's own."""
        while self.bytes + self.sizes[row] > self.budget_bytes:
            spare = None
            for victim in self.policy.victims():
                if victim in own:
                    continue
                if victim not in self.kept and victim not in self.ready:
                    spare = victim
                    break
                spare = victim if spare is None else spare
            assert spare is not None, "run() has seen that every request fits"
            self.evict(spare)

    def evict(self, row: int) -> None:
        """Evict a row."""
        self.policy.removed(row)
        self.resident.remove(row)
        self.ready.pop(row, None)
        self.bytes -= self.sizes[row]
        self.found.evictions += 1
        if row in self.unused:
            self.unused.remove(row)
            self.found.vain += 1
            self.found.vain_bytes += self.sizes[row]

    def run_until(self, now: float) -> None:
        """Let the loader prefetch until now."""
        if self.ready:
            self.settle(now)
        while self.queue and self.free <= now:
            row, at = self.queue.popleft()
            if row not in self.resident and not self.load_ahead(row, at):
                self.queue.clear()  # later entries would have no room either

    def plan(self, now: float) -> None:
        """Update the prefetch queue and the users' positions."""
        self.planned = now
        self.tracks.expire(now, SILENCE)
        self.need = self.tracks.plan(now, self.usual)
        self.kept = frozenset(self.tracks.kept().tolist())
        resident = self.resident
        self.queue.clear()
        self.queue.extend(each for each in self.need.items() if each[0] not in resident)

    def load_ahead(self, row: int, at: float) -> bool:
        """Begin a prefetch; return False where there is no room.

        It evicts no row at a user's position, and none wanted as soon.
        """
        short = self.bytes + self.sizes[row] - self.budget_bytes
        if short > 0:
            given: list[int] = []
            for victim in self.policy.victims():
                if victim in self.kept or victim in self.ready or self.need.get(victim, math.inf) <= at:
                    continue
                given.append(victim)
                short -= self.sizes[victim]
                if short <= 0:
                    break
            if short > 0:
                return False
            for victim in given:
                self.evict(victim)
        self.load(row, max(self.free, self.planned), scan=False)
        self.unused.add(row)
        self.found.prefetched += 1
        self.found.prefetched_bytes += self.sizes[row]
        return True
