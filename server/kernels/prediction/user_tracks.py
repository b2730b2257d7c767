"""Tracks of all users in one array, and the voxels they need, found in one call for all of them.

tracks: (u, TRACK_WORDS) float64, one user a row: COUNT of poses stored, NEWEST of them, SINCE, the
time of the first pose or the last teleport [s], REACH of the last pose [m], LAST, its time [s];
from POSES
on a ring buffer of MAX_POSES poses, POSE words each: time [s] and position [m].
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.kernels import compiling as nb
from ..core.kernel_decorators import njit_no_refcount
from .track_prediction import PredictionLimits, predict_path, rows_ahead, rows_in_reach

# A displacement since the last pose of more than MAX_SPEED times the time passed (at most
# MAX_PAUSE), plus SLACK, is a teleport. Nobody walks, runs or drives indoors at MAX_SPEED [m/s].
# SLACK allows for poses that arrive late and all at once [m].
MAX_SPEED, MAX_PAUSE, SLACK = 15.0, 1.0, 1.0
# Without a pose for this long, a user is assumed to stand at the last one [s].
STALE = 0.5
# The least time between two stored poses [s], and the number of stored poses: at 90 poses a second,
# more than half a second. If a client sends poses as fast as they are answered, most are dropped.
LEAST_GAP, MAX_POSES = 0.005, 64
# A reach is widened by this share of itself, and by one step: by more than the rounding of the
# computations with it.
RELATIVE_SLACK = 1e-6
# Straight pieces of a predicted path.
PIECES = 16
# Number of rows to find, as a multiple of those to select. More are needed because the rows of a
# piece are found in spatial order and not by need.
SPARE = 4

COUNT, NEWEST, SINCE, REACH, LAST, POSES, POSE = 0, 1, 2, 3, 4, 5, 4
TRACK_WORDS = POSES + POSE * MAX_POSES
# At most one in TABLE_SLACK places of a hash table is taken. The multiplier, 2^32 over the golden
# ratio, spreads rows over the table.
TABLE_SLACK, HASH_MULTIPLIER = 4, 2654435769


class PredictionOptions(NamedTuple):
    """Parameters of the prediction.

    horizon: [s].  ring: [m], for users who have been present for at least `settled` [s].
    most_wanted: rows a user.
    origin: (3,), step: of the lattice [m].  voxel_steps: edge of a voxel.  limits: limits of
    predictions.
    """

    horizon: float
    ring: float
    settled: float
    most_wanted: int
    origin: NDArray[np.float64]
    step: float
    voxel_steps: int
    limits: PredictionLimits


# The interpreter's lock is kept: after releasing it for a microsecond, this thread would wait for
# the thread that takes it.
@nb.njit(cache=True)
def record_pose(tracks, user, now, x, y, z, reach):
    """Store a pose [s, m] of row `user`; return whether it is a teleport.

    A teleport discards earlier poses. A pose older than the last is ignored, unless it is so old
    that it must come from another clock; the track then starts afresh.
    """
    track = tracks[user]
    count, newest = int(track[COUNT]), int(track[NEWEST])
    teleport = False
    if count == 0:
        track[SINCE] = now
    else:
        last = POSES + POSE * newest
        passed = now - track[last]
        if passed < 0.0:
            if passed > -MAX_PAUSE:
                return False
            count, track[SINCE] = 0, now
        else:
            dx, dy, dz = x - track[last + 1], y - track[last + 2], z - track[last + 3]
            if math.sqrt(dx * dx + dy * dy + dz * dz) > MAX_SPEED * min(passed, MAX_PAUSE) + SLACK:
                teleport = True
                count, track[SINCE] = 0, now
            elif count > 1 and now - track[POSES + POSE * ((newest - 1) % MAX_POSES)] < LEAST_GAP:
                count, newest = count - 1, (newest - 1) % MAX_POSES
    newest = (newest + 1) % MAX_POSES
    at = POSES + POSE * newest
    track[at], track[at + 1], track[at + 2], track[at + 3] = now, x, y, z
    track[COUNT], track[NEWEST] = min(count + 1, MAX_POSES), newest
    track[REACH], track[LAST] = reach, now
    return teleport


@nb.njit(cache=True)
def record_poses(tracks, users, times, centers, reaches, teleports):
    """Call `record_pose` for n poses, one after another.

    users: (n,) int64.  times: (n,).  centers: (n, 3).  reaches: (n,). Fills teleports (n,) bool.
    """
    for i in range(users.shape[0]):
        teleports[i] = record_pose(
            tracks, users[i], times[i], centers[i, 0], centers[i, 1], centers[i, 2], reaches[i]
        )


@njit_no_refcount
def _poses_of(track, poses):
    """Copy the poses of a track to the first of poses (MAX_POSES, 4), by time; return how many."""
    count, newest = int(track[COUNT]), int(track[NEWEST])
    for i in range(count):
        at = POSES + POSE * ((newest - count + 1 + i) % MAX_POSES)
        for k in range(POSE):
            poses[i, k] = track[at + k]
    return count


@njit_no_refcount
def _span(reach, step):
    """Convert a reach [m] to steps, widened by more than the rounding of its uses."""
    return reach / step * (1.0 + RELATIVE_SLACK) + 1.0


@njit_no_refcount
def _table_place(row, table, mask):
    """Return the place of a row in a hash table of rows, or the free place where it belongs.

    A free place holds -1.
    """
    at = (row * HASH_MULTIPLIER >> 16) & mask
    while table[at] >= 0 and table[at] != row:
        at = (at + 1) & mask
    return at


@nb.njit(nogil=True, cache=True)
def plan_tracks(tracks, now, options, index):
    """Plan the rows that all users need: each row once, in the order of users.

    Returns rows (n,) int64, need (n,) float64 [s from now]; and the predicted paths
    (u, PIECES + 1, 3) [steps]. Sorting is left to the caller: numba takes 2 s to compile a sort.
    """
    users, step = tracks.shape[0], options.step
    paths = np.empty((users, PIECES + 1, 3))
    rows, need = np.empty(users * options.most_wanted, np.int64), np.empty(users * options.most_wanted)
    own_rows, own_need = (
        np.empty(SPARE * options.most_wanted, np.int64),
        np.empty(SPARE * options.most_wanted),
    )
    poses = np.empty((MAX_POSES, POSE))
    wanted = 0
    for user in range(users):
        track, path = tracks[user], paths[user]
        count = _poses_of(track, poses)
        late = max(now - track[LAST], 0.0)
        seconds = late + options.horizon if late <= STALE else 0.0
        predict_path(poses[:count], options.limits, seconds, path)
        for i in range(PIECES + 1):
            for k in range(3):
                path[i, k] = (path[i, k] - options.origin[k]) / step
        ring = options.ring if now - track[SINCE] >= options.settled else 0.0
        reach = _span(track[REACH], step)
        found = rows_ahead(path, reach, ring / step, index, options.voxel_steps, own_rows, own_need)
        for i in range(min(found, options.most_wanted)):
            # For voxels around the start: beyond the horizon, up to twice the horizon at the outer
            # edge of the ring.
            pieces = own_need[i]
            around = pieces > PIECES
            rows[wanted] = own_rows[i]
            need[wanted] = (
                options.horizon * (pieces - PIECES)
                if around
                else max(pieces * (seconds / PIECES) - late, 0.0)
            )
            wanted += 1
    rows, need = merge_wanted(rows[:wanted], need[:wanted])
    return rows, need, paths


@nb.njit(nogil=True, cache=True)
def merge_wanted(rows, need):
    """Merge rows (n,), need (n,): each row once with its earliest need, in their order."""
    size = 1
    while size < TABLE_SLACK * rows.shape[0]:
        size *= 2
    table, first = np.full(size, -1), np.empty(size, np.int64)
    for i in range(rows.shape[0]):
        at = _table_place(rows[i], table, size - 1)
        if table[at] < 0:
            table[at], first[at] = rows[i], i
        elif need[i] < need[first[at]]:
            first[at] = i
    count = 0
    chosen = np.empty(rows.shape[0], np.int64)
    for i in range(rows.shape[0]):
        if first[_table_place(rows[i], table, size - 1)] == i:
            chosen[count] = i
            count += 1
    chosen = chosen[:count]
    return rows[chosen], need[chosen]


@nb.njit(nogil=True, cache=True)
def rows_kept(tracks, now, after, options, index):
    """Return the rows that users touch whose last pose is at most `after` old [s].

    (n,) int64, a row once for each user that touches it.
    """
    users, step = 0, options.step
    centers, reaches = np.empty((tracks.shape[0], 3)), np.empty(tracks.shape[0])
    for user in range(tracks.shape[0]):
        track = tracks[user]
        if now - track[LAST] > after:
            continue
        last = POSES + POSE * int(track[NEWEST])
        for k in range(3):
            centers[users, k] = (track[last + 1 + k] - options.origin[k]) / step
        reaches[users] = _span(track[REACH], step)
        users += 1
    centers, reaches = centers[:users], reaches[:users]
    starts, needed = np.zeros(users + 1, np.int64), 8 * users + 8
    while True:
        rows = np.empty(needed, np.int64)
        needed = rows_in_reach(centers, reaches, index, options.voxel_steps, starts, rows)
        if needed <= rows.shape[0]:
            break
    return rows[:needed]
