"""The voxels around users: where each will be, what that brings within reach, and how soon.

The direction of travel comes first: a quadratic in time fitted to a user's last poses (velocity, acceleration, and so
turning), carried as far ahead as loading takes. Then the ring around where the user stands, for those who turn.
Nothing here loads, pins or evicts, and no clock is read: `now` is the caller's, in seconds, of any one clock.

Safe to call from several threads. One lock guards the poses, held for microseconds; it is taken inside whatever its
callers hold, and nothing is taken inside it. `nearness` takes none.
"""

import math
import threading
from collections import deque
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .kernels.ahead import Motion, distance_to_ways, predict_way, rows_ahead, rows_in_reach
from .kernels.reach import SceneIndex

User = tuple[str, str]

# Farther than this since the last pose is no motion but a teleport: a speed nobody walks, runs or is driven at indoors
# [m/s], over the time passed but no longer than a second, and some slack for poses that come late and all at once [m].
MOST_SPEED, MOST_PAUSE, SLACK = 15.0, 1.0, 1.0
# Without a pose for this long a user is taken to stand where the last one was [s].
STALE = 0.5
# And after this long it is taken to be gone [s].
EXPIRY = 10.0
# The least time between two poses that are remembered [s], and how many are: at 90 poses a second, more than half a
# second. Of poses asked as fast as they are answered, most are passed over.
LEAST_GAP, MOST_POSES = 0.005, 64
# A reach is widened by this share of itself, and a step: by more than the rounding of what is done with it.
WIDER = 1e-6
# Straight pieces of a predicted way.
PIECES = 16
# Rows found before the soonest are taken, as a multiple of those: a piece's rows are found in an order of place.
SPARE = 4


class Ahead(NamedTuple):
    """How far ahead voxels are wanted.

    loads: horizon as a multiple of the time one load takes, between `least` and `most` [s].  ring: wanted around where
    a user stands, beyond reach [m].  settled: but only for who came, or teleported, so long ago [s].  most_wanted: rows
    a user.  motion: what bounds predictions.
    """

    # By scripts/simulate_cache, in a town of 4e7 points (1,215 voxels of 8 m), 8 users for 300 s, a tenth of its bytes;
    # `--ahead` for what is varied; a load takes 2.4 ms unless said. In vain: of bytes loaded ahead (stroll, run, tour).
    #   ring 0 m: in vain 3, 2, 4 %, and the tour has 2 misses; 1: 6, 10, 8 %, none; 2: 12, 18, 11 %; 4: 37, 37, 26 %.
    # For 120 s, counted in voxels, with a ring of 2 m:
    #   least 1.5 s in the place of 0.5 (ring 1): in vain 15, 34, 40 % where it was 10, 13, 14; no misses either way.
    #   loads, of 128 ms each (--load-ms 100 --mb-ms 100): 2 and 4 have one miss more than 8 (run); 8: in vain 18, 26,
    #   23 %; 16: 24, 40, 45 %.
    #   history 1 s in the place of 0.5, ring 0, 3 % of the bytes, loads of 79 ms: 1, 1, 5 late misses for 0, 1, 2;
    #   without acceleration 1, 1, 3; its bound and its fading hardly matter.
    # most_wanted only bounds: 8 were as good.
    loads: float = 8.0
    least: float = 0.5
    most: float = 4.0
    ring: float = 1.0
    # Without it, nine tenths of what was loaded ahead for users who teleport every second were in vain, 1,354 voxels.
    settled: float = 2.0
    most_wanted: int = 128
    motion: Motion = Motion(history=0.5, speed=MOST_SPEED, acceleration=6.0, fade=0.5)

    def horizon(self, load_seconds: float) -> float:
        """How far ahead to look when one load takes so long [s]."""
        return min(max(self.loads * load_seconds, self.least), self.most)


AHEAD = Ahead()


class Wanted(NamedTuple):
    """What a user will need.

    rows: (n,) int64, each once, soonest first.  need: (n,) float64, seconds from now until the avatar could touch
    it, 0: it does now. Of rows around, which the predicted way does not touch, beyond the horizon, nearest first.
    """

    rows: NDArray[np.int64]
    need: NDArray[np.float64]


class _Walk:
    """What is remembered of one user. poses: time [s] and place [m], in order of time.  reach: of the last [m].

    since: when it came, or last teleported [s].
    """

    __slots__ = ("poses", "reach", "since")

    def __init__(self, since: float) -> None:
        self.poses: deque[tuple[float, float, float, float]] = deque(maxlen=MOST_POSES)
        self.reach, self.since = 0.0, since


def merge(plans: Iterable[Wanted]) -> Wanted:
    """What several users want as one list: each row once, when the first of them needs it."""
    every = list(plans)
    if len(every) == 1:
        return every[0]
    rows = np.concatenate([np.empty(0, np.int64), *(plan.rows for plan in every)])
    need = np.concatenate([np.empty(0), *(plan.need for plan in every)])
    order = np.argsort(need, kind="stable")
    first = np.sort(np.unique(rows[order], return_index=True)[1])
    return Wanted(rows[order][first], need[order][first])


class Neighbourhood:
    """The users of one scene and what they will need of it."""

    def __init__(
        self,
        index: SceneIndex,
        voxel_steps: int,
        origin: ArrayLike,
        step: float,
        ahead: Ahead = AHEAD,
    ) -> None:
        """No users yet. voxel_steps: edge of a voxel [steps].  origin (3,), step: of the lattice [m]."""
        self.ahead = ahead
        self._history = ahead.motion.history
        self._index, self._voxel_steps = index, voxel_steps
        self._origin, self._step = np.asarray(origin, np.float64), step
        self._lock = threading.Lock()
        self._walks: dict[User, _Walk] = {}
        self._ways = np.empty((0, PIECES + 1, 3))  # of the last plan [steps]; replaced, never written

    def saw(self, user: User, now: float, center: tuple[float, float, float], reach: float) -> bool:
        """Remember a pose. center: of the avatar's root sphere [m].  reach: its radius with spheres and margin [m].

        Returns whether it is a teleport, after which what was before says nothing. A pose older than the last is
        passed over, unless it is so old that the clock must be another one: then it starts afresh.
        """
        x, y, z = center
        with self._lock:
            walk = self._walks.get(user)
            if walk is None:
                walk = self._walks[user] = _Walk(now)
            poses = walk.poses
            teleport = False
            if poses:
                then, x0, y0, z0 = poses[-1]
                passed = now - then
                if passed < 0.0:
                    if passed > -MOST_PAUSE:
                        return False
                    poses.clear()
                    walk.since = now
                elif math.dist((x, y, z), (x0, y0, z0)) > MOST_SPEED * min(passed, MOST_PAUSE) + SLACK:
                    teleport = True
                    poses.clear()
                    walk.since = now
                elif len(poses) > 1 and now - poses[-2][0] < LEAST_GAP:
                    poses.pop()
                while poses and now - poses[0][0] > self._history:
                    poses.popleft()
            poses.append((now, x, y, z))
            walk.reach = reach
            return teleport

    def leave(self, user: User) -> None:
        """Forget a user, if it is known."""
        with self._lock:
            self._walks.pop(user, None)

    def leave_client(self, client: str) -> None:
        """Forget all users of a client."""
        with self._lock:
            for user in [user for user in self._walks if user[0] == client]:
                del self._walks[user]

    def expire(self, now: float, after: float = EXPIRY) -> None:
        """Forget users whose last pose is more than `after` seconds old."""
        with self._lock:
            for user in [user for user, walk in self._walks.items() if now - walk.poses[-1][0] > after]:
                del self._walks[user]

    def plan(self, now: float, load_seconds: float) -> dict[User, Wanted]:
        """What every user will need.

        load_seconds: what loading one voxel takes now, queueing included: an upper percentile of what was measured.
        """
        with self._lock:
            walks = [(user, list(walk.poses), walk.reach, walk.since) for user, walk in self._walks.items()]
        ahead = self.ahead
        horizon = ahead.horizon(load_seconds)
        ways = np.empty((len(walks), PIECES + 1, 3))
        plans = {}
        for (user, poses, reach, since), way in zip(walks, ways, strict=True):
            ring = ahead.ring if now - since >= ahead.settled else 0.0
            plans[user] = self._look_ahead(np.array(poses), reach, ring, now, horizon, way)
        self._ways = ways
        return plans

    def _look_ahead(
        self,
        poses: NDArray[np.float64],
        reach: float,
        ring: float,
        now: float,
        horizon: float,
        way: NDArray[np.float64],
    ) -> Wanted:
        """What a user of poses (h, 4) needs, around by `ring` [m]; and its way [steps] into `way`."""
        ahead = self.ahead
        late = max(now - poses[-1, 0], 0.0)
        seconds = late + horizon if late <= STALE else 0.0
        predict_way(poses, ahead.motion, seconds, way)
        way -= self._origin
        way /= self._step
        rows = np.empty(SPARE * ahead.most_wanted, np.int64)
        need = np.empty(SPARE * ahead.most_wanted)
        found = rows_ahead(
            way, self._span(reach), ring / self._step, self._index, self._voxel_steps, rows, need
        )
        found = min(found, ahead.most_wanted)
        pieces = need[:found]
        # Around: beyond the horizon, by as much again for what is as far as the ring goes.
        around = pieces > PIECES
        times = np.maximum(pieces * (seconds / PIECES) - late, 0.0)
        times[around] = horizon * (pieces[around] - PIECES)
        return Wanted(rows[:found].copy(), times)

    def _span(self, reach: float) -> float:
        """A reach in steps, widened by more than the rounding of what is done with it."""
        return reach / self._step * (1.0 + WIDER) + 1.0

    def kept(self, now: float, after: float = EXPIRY) -> NDArray[np.int64]:
        """The rows (n,), each once, that users can touch where they stand: by poses at most `after` seconds old."""
        with self._lock:
            last = [
                (*walk.poses[-1][1:], walk.reach)
                for walk in self._walks.values()
                if now - walk.poses[-1][0] <= after
            ]
        balls = np.array(last, np.float64).reshape(-1, 4)
        return np.unique(self.rows_in_reach(balls[:, :3], balls[:, 3])[1])

    def rows_in_reach(
        self, centers: NDArray[np.float64], reaches: NDArray[np.float64]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Starts (k + 1,) and rows: what each of k balls, centers (k, 3) and reaches (k,) [m], can touch."""
        steps = np.ascontiguousarray((centers - self._origin) / self._step)
        spans = np.ascontiguousarray(reaches / self._step * (1.0 + WIDER) + 1.0)
        starts, needed = np.zeros(len(steps) + 1, np.int64), 8 * len(steps) + 8
        while True:
            rows = np.empty(needed, np.int64)
            needed = rows_in_reach(steps, spans, self._index, self._voxel_steps, starts, rows)
            if needed <= len(rows):
                return starts, rows[:needed]

    def nearness(self, rows: Sequence[int]) -> NDArray[np.float64]:
        """How near (n,) the points' boxes of rows are to any user's way in the last plan [m]; inf: no users."""
        far = np.empty(len(rows))
        distance_to_ways(self._ways, np.asarray(rows, np.int64), self._index, far)
        return far * self._step
