"""The voxels around users: where each will be, what that brings within reach, and how soon.

The direction of travel comes first: a quadratic in time fitted to a user's last poses (velocity, acceleration, and so
turning), carried as far ahead as loading takes. Then the ring around where the user stands, for those who turn.
Nothing here loads, pins or evicts, and no clock is read: `now` is the caller's, in seconds, of any one clock.

Safe to call from several threads. One lock guards the poses, held for microseconds; it is taken inside whatever its
callers hold, and nothing is taken inside it. `nearness` takes none: whoever evicts holds one that is its own.
"""

import threading
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..kernels.core.voxels_in_reach import SceneIndex
from ..kernels.prediction.track_prediction import Motion, distance_to_ways, rows_in_reach
from ..kernels.prediction.user_tracks import (
    COUNT,
    LAST,
    MOST_SPEED,
    PIECES,
    WALK,
    WIDER,
    Look,
    note_pose,
    note_poses,
    plan_walks,
    rows_kept,
)

User = tuple[str, str]

# After this long without a pose a user is taken to be gone [s].
EXPIRY = 10.0
# Users remembered at first, twice as many each time there is no room, and at most: 2 KB each. A new one takes the place
# of the one not heard of for longest.
FEW_USERS, MOST_USERS = 16, 4096


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
    """What users will need.

    rows: (n,) int64, each once, soonest first.  need: (n,) float64, seconds from now until the avatar could touch
    it, 0: it does now. Of rows around, which the predicted way does not touch, beyond the horizon, nearest first.
    """

    rows: NDArray[np.int64]
    need: NDArray[np.float64]


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
        self._index, self._step = index, step
        self._look = Look(
            0.0, ahead.ring, ahead.settled, ahead.most_wanted, np.array(origin, np.float64), step, voxel_steps,
            ahead.motion,
        )  # fmt: skip
        self._lock = threading.Lock()
        self._users: dict[User, int] = {}  # the row of each in `_walks`, in their order
        self._walks = np.zeros((FEW_USERS, WALK))
        # Of the last plan, the ways [steps] and its number; replaced, never written. And how far each row is from them
        # [m], where it was asked since `_asked`, the number of a plan: committed by the system as rows are asked for.
        self._planned = np.empty((0, PIECES + 1, 3)), 1
        self._asked, self._far = np.zeros(len(index.keys), np.int64), np.zeros(len(index.keys))

    @property
    def users(self) -> list[User]:
        """Who is known, those first who came first."""
        return list(self._users)

    def saw(self, user: User, now: float, center: tuple[float, float, float], reach: float) -> bool:
        """Remember a pose. center: of the avatar's root sphere [m].  reach: its radius with spheres and margin [m].

        Returns whether it is a teleport, after which what was before says nothing. A pose older than the last is
        passed over, unless it is so old that the clock must be another one: then it starts afresh.
        """
        x, y, z = center
        with self._lock:
            row = self._users.get(user)
            if row is None:
                row = self._add(user)
            return bool(note_pose(self._walks, row, now, x, y, z, reach))

    def saw_each(
        self,
        users: Sequence[User],
        times: NDArray[np.float64],
        centers: NDArray[np.float64],
        reaches: NDArray[np.float64],
    ) -> NDArray[np.bool_]:
        """`saw` of n poses, one after another, of MOST_USERS at most: whether each is a teleport (n,)."""
        teleports = np.empty(len(users), np.bool_)
        with self._lock:
            known = self._users
            rows = [known[user] if user in known else self._add(user) for user in users]
            note_poses(self._walks, np.array(rows, np.int64), times, centers, reaches, teleports)
        return teleports

    def _add(self, user: User) -> int:
        """A row for a user not seen before."""
        count = len(self._users)
        if count == MOST_USERS:
            silent = int(np.argmin(self._walks[:count, LAST]))
            self._drop(lambda row: row == silent)
            count -= 1
        if count == len(self._walks):
            grown = np.zeros((2 * count, WALK))
            grown[:count] = self._walks
            self._walks = grown
        self._walks[count, COUNT] = 0
        self._users[user] = count
        return count

    def _drop(self, gone: Callable[[int], bool]) -> None:
        """Forget the users of rows that are gone; the others move up, in their order."""
        left = [(user, row) for user, row in self._users.items() if not gone(row)]
        if len(left) < len(self._users):
            self._walks[: len(left)] = self._walks[[row for _, row in left]]
            self._users = {user: row for row, (user, _) in enumerate(left)}

    def leave(self, user: User) -> None:
        """Forget a user, if it is known."""
        with self._lock:
            row = self._users.get(user)
            self._drop(lambda other: other == row)

    def leave_client(self, client: str) -> None:
        """Forget all users of a client."""
        with self._lock:
            rows = {row for user, row in self._users.items() if user[0] == client}
            self._drop(rows.__contains__)

    def expire(self, now: float, after: float = EXPIRY) -> None:
        """Forget users whose last pose is more than `after` seconds old."""
        with self._lock:
            silent = now - self._walks[: len(self._users), LAST] > after
            if silent.any():
                self._drop(lambda row: bool(silent[row]))

    def _snapshot(self) -> NDArray[np.float64]:
        """The walks as they are: kernels read them without the lock."""
        with self._lock:
            return self._walks[: len(self._users)].copy()

    def plan(self, now: float, load_seconds: float) -> Wanted:
        """What users will need: each row once, when the first of them needs it; of equals, first who came first.

        load_seconds: what loading one voxel takes now, queueing included: an upper percentile of what was measured.
        """
        look = self._look._replace(horizon=self.ahead.horizon(load_seconds))
        rows, need, ways = plan_walks(self._snapshot(), now, look, self._index)
        self._planned = ways, self._planned[1] + 1
        return Wanted(rows, need)

    def kept(self, now: float, after: float = EXPIRY) -> NDArray[np.int64]:
        """The rows (n,), each once, that users can touch where they stand: by poses at most `after` seconds old."""
        rows: NDArray[np.int64] = rows_kept(self._snapshot(), now, after, self._look, self._index)
        return rows

    def rows_in_reach(
        self, centers: NDArray[np.float64], reaches: NDArray[np.float64]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Starts (k + 1,) and rows: what each of k balls, centers (k, 3) and reaches (k,) [m], can touch."""
        look = self._look
        steps = np.ascontiguousarray((centers - look.origin) / look.step)
        spans = np.ascontiguousarray(reaches / look.step * (1.0 + WIDER) + 1.0)
        starts, needed = np.zeros(len(steps) + 1, np.int64), 8 * len(steps) + 8
        while True:
            rows = np.empty(needed, np.int64)
            needed = rows_in_reach(steps, spans, self._index, look.voxel_steps, starts, rows)
            if needed <= len(rows):
                return starts, rows[:needed]

    def nearness(self, rows: ArrayLike) -> NDArray[np.float64]:
        """How near (n,) the points' boxes of rows are to any user's way in the last plan [m]; inf: no users.

        One call at a time. What was found since that plan is remembered: of 10,000 rows and 8 users finding it takes a
        millisecond, and looking it up some 20 us (scripts/bench_cache).
        """
        each = np.asarray(rows, np.int64)
        ways, number = self._planned
        new = each[self._asked[each] != number]
        if len(new):
            far = np.empty(len(new))
            distance_to_ways(ways, new, self._index, far)
            self._far[new], self._asked[new] = far * self._step, number
        return self._far[each]
