"""Prediction of users' motion: which voxels will come within reach, and when.

Voxels in the direction of travel come first. A quadratic in time is fitted to a user's last poses
(velocity and acceleration, and therefore turning) and extrapolated for as long as loading takes.
The voxels in a ring around the user's position follow, in case the user turns. This module loads,
pins and evicts nothing, and reads no clock: callers pass `now` in seconds, all from the same clock.

Thread-safe. One lock guards the poses and is held for microseconds. Callers may hold other locks
when they take it; no lock is taken while it is held. `path_distances` takes no lock: the caller
that evicts holds its own.
"""

import math
import threading
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..kernels.core.reach import Items, VoxelTree, find_lists
from ..runtime.stop_flag import NO_STOP

User = tuple[str, str]
Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

# At most this many users, 2 KB each; a new user replaces the one whose last pose is the oldest.
MAX_USERS = 4096
# A displacement since the last pose of more than MAX_SPEED times the time passed (at most
# MAX_PAUSE), plus SLACK, is a teleport. Nobody walks, runs or drives indoors at MAX_SPEED [m/s].
# SLACK allows for poses that arrive late and all at once [m].
MAX_SPEED, MAX_PAUSE, SLACK = 15.0, 1.0, 1.0
# Without a pose for this long, a user is assumed to stand at the last one [s].
STALE = 0.5
# The least time between two stored poses [s], and the number of stored poses: at 90 poses a second,
# more than half a second. If a client sends poses as fast as they are answered, most are dropped.
LEAST_GAP, MAX_POSES = 0.005, 64
# Typical values of poses that look like a walk: scatter of clock and position together [m], and
# speeds [m/s] and accelerations [m/s²] of people. The fit relies on them where poses are few or
# close in time, and needs no special cases.
SCATTER, USUAL_SPEED, USUAL_ACCELERATION = 0.02, 3.0, 2.0
# Straight pieces of a predicted path, and how many of them one box of grid cells encloses.
PIECES, PIECES_OF_BOX = 16, 4
# A voxel counts as touched when the distance is this much more than the reach [m]; steps of a search
# for the moment of touching, which needs one a piece and few more.
GRAZE, MAX_TOUCH_STEPS = 0.001, 3 * PIECES
# Largest number of grid cells one call looks up: some 0.1 s, reached only with voxels far smaller
# than the reach or hundreds of fast users. The last cells of each box are then omitted.
MAX_CELLS = 1 << 19
# A reach is widened by this share of itself, and by one step: by more than the rounding of the
# computations with it.
RELATIVE_SLACK = 1e-6


class PrefetchOptions(NamedTuple):
    """Parameters of prefetching: how far ahead to look.

    loads: horizon as a multiple of the time one load takes, clamped to `least` and `most` [s].
    ring: width of the ring around a user's position, beyond reach, whose voxels are wanted [m].
    settled: time a user must have been present without a teleport before the ring counts [s].
    most_wanted: rows a user.
    history: poses older than this before the last are ignored [s].  speed: at most [m/s].
    acceleration: at most [m/s²].  fade: the acceleration falls to 1/e in this time [s], which makes
    the far part of the path straight.
    """

    # Measured with scripts/simulate_cache in a town of 4e7 points (1,215 voxels of 8 m), 8 users
    # for 300 s, a cache of a tenth of the bytes; `--ahead` sets the varied parameter; a load takes
    # 2.4 ms unless stated. Percentages are wasted prefetches, of the bytes prefetched (stroll, run,
    # tour).
    #   ring 0 m: 3, 2, 4 %, and the tour has 2 misses; 1: 6, 10, 8 %, no misses;
    #   2: 12, 18, 11 %; 4: 37, 37, 26 %.
    # For 120 s, counted in voxels, with a ring of 2 m:
    #   least 1.5 s instead of 0.5 (ring 1): 15, 34, 40 % instead of 10, 13, 14; no misses in
    #   either case.
    #   loads, of 128 ms each (--load-ms 100 --mb-ms 100): 2 and 4 have one miss more than 8 (run);
    #   8: 18, 26, 23 %; 16: 24, 40, 45 %.
    #   history 1 s instead of 0.5, ring 0, 3 % of the bytes, loads of 79 ms: 1, 1, 5 late misses
    #   instead of 0, 1, 2; without acceleration 1, 1, 3; its bound and fading hardly matter.
    # most_wanted is only a bound: 8 was as good.
    loads: float = 8.0
    least: float = 0.5
    most: float = 4.0
    ring: float = 1.0
    # Without it, nine tenths of the prefetches for users who teleport every second were wasted,
    # 1,354 voxels.
    settled: float = 2.0
    most_wanted: int = 128
    history: float = 0.5
    speed: float = MAX_SPEED
    acceleration: float = 6.0
    fade: float = 0.5

    def horizon(self, load_seconds: float) -> float:
        """Return how far ahead to look when one load takes `load_seconds` [s]."""
        return min(max(self.loads * load_seconds, self.least), self.most)


PREFETCH_OPTIONS = PrefetchOptions()


class PredictedVoxels(NamedTuple):
    """Voxels that users will need.

    rows: (n,) int64, each once, soonest first.
    need: (n,) float64, seconds from now until the avatar could touch the voxel; 0: it does now.
    Rows of the ring that the predicted path does not touch have a need beyond the horizon, nearest
    first.
    """

    rows: Integers
    need: Floats


class _Track:
    """Last poses of a user.

    poses: (MAX_POSES, 4), time [s] and position [m], a ring buffer; time -inf: none.
    last, before: times of the last pose and of that before it.  center: the last position.
    since: time of the first pose or the last teleport.  reach: of the last pose [m].
    """

    __slots__ = ("at", "before", "center", "last", "poses", "reach", "since")

    def __init__(self) -> None:
        self.poses = np.zeros((MAX_POSES, 4))
        self.center, self.reach, self.at = (0.0, 0.0, 0.0), 0.0, 0
        self.restart(-math.inf)

    def restart(self, now: float) -> None:
        """Drop all poses."""
        self.poses[:, 0] = self.last = self.before = -math.inf
        self.since = now

    def record(self, now: float, center: tuple[float, float, float], reach: float) -> bool:
        """Store a pose; see `UserTracks.record_pose`."""
        passed, teleport = now - self.last, False
        if passed == math.inf:
            self.since = now
        elif passed < 0.0:
            if passed > -MAX_PAUSE:
                return False
            self.restart(now)
        elif math.dist(center, self.center) > MAX_SPEED * min(passed, MAX_PAUSE) + SLACK:
            teleport = True
            self.restart(now)
        if now - self.before >= LEAST_GAP:
            self.at, self.before = (self.at + 1) % MAX_POSES, self.last
        self.poses[self.at] = now, *center
        self.last, self.center, self.reach = now, center, reach
        return teleport


class _Users(NamedTuple):
    """Tracks of u users at one time: poses (u, MAX_POSES, 4), others (u,), as in `_Track`."""

    poses: Floats
    centers: Floats
    reaches: Floats
    last: Floats
    since: Floats


class UserTracks:
    """Users of one scene and the voxels they will need."""

    def __init__(
        self,
        tree: VoxelTree,
        origin: ArrayLike,
        step: float,
        ahead: PrefetchOptions = PREFETCH_OPTIONS,
    ) -> None:
        """Begin without users.

        tree: boxes around the points of the scene's voxels.  origin (3,), step: of the lattice [m].
        """
        self.ahead = ahead
        self._tree, self._step = tree, step
        self._origin = np.array(origin, np.float64)
        self._lock = threading.Lock()
        self._users: dict[User, _Track] = {}

    @property
    def users(self) -> list[User]:
        """Return the known users, in order of arrival."""
        return list(self._users)

    def record_pose(self, user: User, now: float, center: tuple[float, float, float], reach: float) -> bool:
        """Record a pose and return whether it is a teleport, which discards the poses before it.

        center: of the avatar's root sphere [m].  reach: its radius with spheres and margin [m].
        A pose older than the last one is ignored, unless it is so old that its time must come from
        another clock: then the track of the user restarts.
        """
        with self._lock:
            track = self._users.get(user)
            if track is None:
                if len(self._users) == MAX_USERS:
                    del self._users[min(self._users, key=lambda each: self._users[each].last)]
                track = self._users[user] = _Track()
            return track.record(now, center, reach)

    def _drop(self, gone: Callable[[User, _Track], bool]) -> None:
        """Remove the users that satisfy `gone`."""
        with self._lock:
            self._users = {user: track for user, track in self._users.items() if not gone(user, track)}

    def leave_client(self, client: str) -> None:
        """Remove all users of a client."""
        self._drop(lambda each, _: each[0] == client)

    def expire(self, now: float, after: float) -> None:
        """Remove users whose last pose is more than `after` seconds old."""
        self._drop(lambda _, track: now - track.last > after)

    def _snapshot(self) -> _Users:
        """Return a copy of the tracks."""
        with self._lock:
            tracks = list(self._users.values())
            return _Users(
                np.array([each.poses for each in tracks]).reshape(-1, MAX_POSES, 4),
                np.array([each.center for each in tracks]).reshape(-1, 3),
                *(np.array([getattr(each, name) for each in tracks]) for name in ("reach", "last", "since")),
            )

    def plan(self, now: float, load_seconds: float) -> PredictedVoxels:
        """Predict the voxels that users will need.

        Each row is listed once, with the earliest need of all users; equal needs are in order of
        the users' arrival.
        load_seconds: current time to load one voxel including queueing, an upper percentile of the
        measured times.
        """
        ahead, users, voxels = self.ahead, self._snapshot(), max(self._tree.voxels, 1)
        horizon, late = ahead.horizon(load_seconds), np.maximum(now - users.last, 0.0)
        seconds = np.where(late <= STALE, late + horizon, 0.0)
        paths = (_predict_paths(users, ahead, seconds) - self._origin) / self._step
        reaches = self._spans(users.reaches)
        rings = np.where(now - users.since >= ahead.settled, ahead.ring / self._step, 0.0)
        # Boxes of four pieces each, and one around the start.
        parts = [paths[:, at : at + PIECES_OF_BOX + 1] for at in range(0, PIECES, PIECES_OF_BOX)]
        wide = np.stack([reaches] * len(parts) + [reaches + rings], axis=1)[:, :, None]
        low = np.stack([part.min(axis=1) for part in [*parts, paths[:, :1]]], axis=1) - wide
        high = np.stack([part.max(axis=1) for part in [*parts, paths[:, :1]]], axis=1) + wide
        box, row = self._voxels_in(low.reshape(-1, 3), high.reshape(-1, 3))
        user, row = np.divmod(np.unique(box // (len(parts) + 1) * voxels + row), voxels)
        touch = self._first_touch(paths, reaches, user, row)
        need = np.maximum(np.minimum(touch, PIECES) * (seconds / PIECES)[user] - late[user], 0.0)
        need[touch == np.inf] = np.inf
        # Voxels of the ring: beyond the horizon, up to twice the horizon at its outer edge.
        beyond = self._gaps(paths[user, 0], row)[1] - reaches[user]
        ring = rings[user]
        around = (touch == np.inf) & (beyond <= ring) & (ring > 0.0)
        need[around] = horizon * (1.0 + np.maximum(beyond[around], 0.0) / ring[around])
        order = np.lexsort((row, need, user))
        order = order[need[order] < np.inf]
        count = np.bincount(user[order], minlength=len(paths))
        rank = np.arange(len(order)) - np.repeat(np.cumsum(count) - count, count)
        order = order[rank < ahead.most_wanted]
        order = order[np.argsort(need[order], kind="stable")]
        first = np.sort(np.unique(row[order], return_index=True)[1])
        return PredictedVoxels(row[order[first]], need[order[first]])

    def kept(self, now: float, after: float) -> Integers:
        """Return the rows (n,), ascending, that users can touch at their current positions.

        Users whose last pose is more than `after` seconds old are ignored.
        """
        users = self._snapshot()
        present = now - users.last <= after
        return np.unique(self.rows_in_reach(users.centers[present], users.reaches[present])[1])

    def rows_in_reach(self, centers: Floats, reaches: Floats) -> tuple[Integers, Integers]:
        """Return the voxels that balls can touch: (n,) numbers of balls, ascending, and (n,) rows.

        centers: (k, 3) [m].  reaches: the radii (k,) [m].
        """
        places, spans = (centers - self._origin) / self._step, self._spans(reaches)
        ball, row = self._voxels_in(places - spans[:, None], places + spans[:, None])
        near = self._gaps(places[ball], row)[1] <= spans[ball]
        return ball[near], row[near]

    def _spans(self, reaches: Floats) -> Floats:
        """Convert reaches [m] to steps, widened by more than the rounding of their uses."""
        return reaches / self._step * (1.0 + RELATIVE_SLACK) + 1.0

    def _gaps(self, places: Floats, row: Integers) -> tuple[Floats, Floats]:
        """Return the vectors (n, 3) to places from the boxes of rows (n,), and their lengths [steps]."""
        low, high = self._tree.low[row], self._tree.high[row]
        away: Floats = np.minimum(places - low, 0.0) + np.maximum(places - high, 0.0)
        return away, np.sqrt((away * away).sum(axis=-1))

    def _voxels_in(self, low: Floats, high: Floats) -> tuple[Integers, Integers]:
        """Return the voxels near boxes (k, 3) [steps]: (n,) numbers of boxes, ascending, and (n,) rows."""
        center, span = 0.5 * (low + high), 0.5 * np.sqrt(((high - low) ** 2).sum(axis=1))
        lists = find_lists(self._tree, Items(center, center, span, span), NO_STOP.flag)
        return np.repeat(np.arange(len(low)), np.diff(lists.starts)), lists.rows[: lists.starts[-1]]

    def _first_touch(self, paths: Floats, reaches: Floats, user: Integers, row: Integers) -> Floats:
        """Return when users' balls first touch voxels: (n,) number of pieces, 0 to PIECES; inf: never.

        The moment is never late. user, row: (n,), pairs. The distance is convex along a piece, so
        that Newton's step from before the moment does not pass it.
        """
        at, touch, left = np.zeros(len(row)), np.full(len(row), np.inf), np.arange(len(row))
        for _ in range(MAX_TOUCH_STEPS):
            if not len(left):
                return touch
            now, who = at[left], user[left]
            piece = np.minimum(now.astype(np.int64), PIECES - 1)
            begin = paths[who, piece]
            way = paths[who, piece + 1] - begin
            away, gap = self._gaps(begin + (now - piece)[:, None] * way, row[left])
            more, nearing = gap - reaches[who], -(away * way).sum(axis=1)
            touches = more <= GRAZE / self._step
            touch[left[touches]] = now[touches]
            with np.errstate(divide="ignore", invalid="ignore"):
                after = np.where(nearing > 0.0, now + more * gap / nearing, np.inf)
            at[left] = np.minimum(after, piece + 1)
            left = left[~touches & (now < PIECES)]
        touch[left] = at[left]  # it comes nearer so slowly that it may as well touch
        return touch


def _limit(vectors: Floats, most: float) -> Floats:
    """Return vectors (..., 3), shortened to a length of at most `most`."""
    lengths = np.sqrt((vectors * vectors).sum(axis=-1, keepdims=True))
    limited: Floats = vectors * np.minimum(1.0, most / np.maximum(lengths, 1e-300))
    return limited


def _predict_paths(users: _Users, ahead: PrefetchOptions, seconds: Floats) -> Floats:
    """Return predicted positions (u, PIECES + 1, 3) [m], from the last pose to `seconds` (u,) after it.

    The times are evenly spaced. The motion is a least-squares fit of p + v t + a t²/2 over the last
    `history` seconds, with v and a drawn towards 0 by SCATTER over USUAL_*. For one pose, or poses
    at one time, both are 0. The acceleration fades and never makes the user faster than `speed`. The
    speed at the middle of a piece represents the whole piece.
    """
    t = users.poses[:, :, 0] - users.last[:, None]
    used = t >= -ahead.history
    t = np.where(used, t, 0.0)
    terms: Any = np.stack([used, t, t * t / 2], axis=1)  # (u, 3, MAX_POSES)
    # Relative to the last position: no precision is lost far from the origin.
    away = users.poses[:, :, 1:] - users.centers[:, None]
    normal = terms @ terms.transpose(0, 2, 1)
    normal += np.diag([0.0, (SCATTER / USUAL_SPEED) ** 2, (SCATTER / USUAL_ACCELERATION) ** 2])
    fit = np.linalg.solve(normal, terms @ away)
    velocity, acceleration = _limit(fit[:, 1], ahead.speed), _limit(fit[:, 2], ahead.acceleration)
    step = seconds / PIECES
    middle = (np.arange(PIECES) + 0.5) * step[:, None]
    gained = ahead.fade * (1.0 - np.exp(-middle / ahead.fade))
    speed = _limit(velocity[:, None] + acceleration[:, None] * gained[:, :, None], ahead.speed)
    return np.cumsum(np.concatenate([users.centers[:, None], speed * step[:, None, None]], axis=1), axis=1)
