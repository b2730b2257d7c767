"""Tracks of all users in one array, and the voxels they need, found in one call for all of them.

walks: (u, WALK) float64, one user a row: COUNT of poses stored, NEWEST of them, SINCE, the time of
the first pose or the last teleport [s], REACH of the last pose [m], LAST, its time [s]; from POSES
on a ring buffer of MOST_POSES poses, POSE words each: time [s] and position [m].
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.kernels import compiling as nb
from ..core.borrowing_kernels import borrowing
from .track_prediction import Motion, predict_way, rows_ahead, rows_in_reach

# A displacement since the last pose beyond this limit is a teleport, not a motion: a speed at which
# nobody walks, runs or drives indoors [m/s], over the time passed but at most one second, plus some
# slack for poses that arrive late and all at once [m].
MOST_SPEED, MOST_PAUSE, SLACK = 15.0, 1.0, 1.0
# Without a pose for this long, a user is assumed to stand at the last one [s].
STALE = 0.5
# The least time between two stored poses [s], and the number of stored poses: at 90 poses a second,
# more than half a second. If a client sends poses as fast as they are answered, most are dropped.
LEAST_GAP, MOST_POSES = 0.005, 64
# A reach is widened by this share of itself, and by one step: by more than the rounding of the
# computations with it.
WIDER = 1e-6
# Straight pieces of a predicted way.
PIECES = 16
# Rows to find before the soonest are selected, as a multiple of those: the rows of a piece are
# found in spatial order.
SPARE = 4

COUNT, NEWEST, SINCE, REACH, LAST, POSES, POSE = 0, 1, 2, 3, 4, 5, 4
WALK = POSES + POSE * MOST_POSES
# At most one in SPARSE places of a hash table is taken; rows are spread over it by 2^32 over the
# golden ratio.
SPARSE, SPREAD = 4, 2654435769


class Look(NamedTuple):
    """Parameters of the prediction.

    horizon: [s].  ring: [m], for users who have been present for at least `settled` [s].
    most_wanted: rows a user.
    origin: (3,), step: of the lattice [m].  voxel_steps: edge of a voxel.  motion: limits of
    predictions.
    """

    horizon: float
    ring: float
    settled: float
    most_wanted: int
    origin: NDArray[np.float64]
    step: float
    voxel_steps: int
    motion: Motion


# This holds the interpreter lock: after releasing it for a microsecond, the thread would wait for
# whichever thread takes it.
@nb.njit(cache=True)
def note_pose(walks, user, now, x, y, z, reach):
    """Store a pose [s, m] of row `user`; return whether it is a teleport.

    A teleport discards earlier poses. A pose older than the last is ignored, unless it is so old
    that it must come from another clock; the track then starts afresh.
    """
    walk = walks[user]
    count, newest = int(walk[COUNT]), int(walk[NEWEST])
    teleport = False
    if count == 0:
        walk[SINCE] = now
    else:
        last = POSES + POSE * newest
        passed = now - walk[last]
        if passed < 0.0:
            if passed > -MOST_PAUSE:
                return False
            count, walk[SINCE] = 0, now
        else:
            dx, dy, dz = x - walk[last + 1], y - walk[last + 2], z - walk[last + 3]
            if math.sqrt(dx * dx + dy * dy + dz * dz) > MOST_SPEED * min(passed, MOST_PAUSE) + SLACK:
                teleport = True
                count, walk[SINCE] = 0, now
            elif count > 1 and now - walk[POSES + POSE * ((newest - 1) % MOST_POSES)] < LEAST_GAP:
                count, newest = count - 1, (newest - 1) % MOST_POSES
    newest = (newest + 1) % MOST_POSES
    at = POSES + POSE * newest
    walk[at], walk[at + 1], walk[at + 2], walk[at + 3] = now, x, y, z
    walk[COUNT], walk[NEWEST] = min(count + 1, MOST_POSES), newest
    walk[REACH], walk[LAST] = reach, now
    return teleport


@nb.njit(cache=True)
def note_poses(walks, users, times, centers, reaches, teleports):
    """Call `note_pose` for n poses, one after another.

    users: (n,) int64.  times: (n,).  centers: (n, 3).  reaches: (n,). Fills teleports (n,) bool.
    """
    for i in range(users.shape[0]):
        teleports[i] = note_pose(
            walks, users[i], times[i], centers[i, 0], centers[i, 1], centers[i, 2], reaches[i]
        )


@borrowing
def _poses_of(walk, poses):
    """Copy the poses of a track to the first of poses (MOST_POSES, 4), by time; return how many."""
    count, newest = int(walk[COUNT]), int(walk[NEWEST])
    for i in range(count):
        at = POSES + POSE * ((newest - count + 1 + i) % MOST_POSES)
        for k in range(POSE):
            poses[i, k] = walk[at + k]
    return count


@borrowing
def _span(reach, step):
    """Convert a reach [m] to steps, widened by more than the rounding of its uses."""
    return reach / step * (1.0 + WIDER) + 1.0


@borrowing
def _place_of(row, table, mask):
    """Return the place of a row in a hash table of rows, or the free place where it belongs.

    A free place holds -1.
    """
    at = (row * SPREAD >> 16) & mask
    while table[at] >= 0 and table[at] != row:
        at = (at + 1) & mask
    return at


@nb.njit(nogil=True, cache=True)
def plan_walks(walks, now, look, index):
    """Plan the rows that all users need: each row once, soonest first, ties in the order of users.

    Returns rows (n,) int64, need (n,) float64 [s from now], see `Wanted`; and the predicted ways
    (u, PIECES + 1, 3) [steps].
    """
    users, step = walks.shape[0], look.step
    ways = np.empty((users, PIECES + 1, 3))
    rows, need = np.empty(users * look.most_wanted, np.int64), np.empty(users * look.most_wanted)
    own_rows, own_need = np.empty(SPARE * look.most_wanted, np.int64), np.empty(SPARE * look.most_wanted)
    poses = np.empty((MOST_POSES, POSE))
    wanted = 0
    for user in range(users):
        walk, way = walks[user], ways[user]
        count = _poses_of(walk, poses)
        late = max(now - walk[LAST], 0.0)
        seconds = late + look.horizon if late <= STALE else 0.0
        predict_way(poses[:count], look.motion, seconds, way)
        for i in range(PIECES + 1):
            for k in range(3):
                way[i, k] = (way[i, k] - look.origin[k]) / step
        ring = look.ring if now - walk[SINCE] >= look.settled else 0.0
        reach = _span(walk[REACH], step)
        found = rows_ahead(way, reach, ring / step, index, look.voxel_steps, own_rows, own_need)
        for i in range(min(found, look.most_wanted)):
            # For voxels around the start: beyond the horizon, up to twice the horizon at the outer
            # edge of the ring.
            pieces = own_need[i]
            around = pieces > PIECES
            rows[wanted] = own_rows[i]
            need[wanted] = (
                look.horizon * (pieces - PIECES) if around else max(pieces * (seconds / PIECES) - late, 0.0)
            )
            wanted += 1
    rows, need = merge_wanted(rows[:wanted], need[:wanted])
    return rows, need, ways


@nb.njit(nogil=True, cache=True)
def merge_wanted(rows, need):
    """Merge rows (n,), need (n,): each row once with its earliest need, soonest first.

    Ties keep their order.
    """
    size = 1
    while size < SPARSE * rows.shape[0]:
        size *= 2
    table, first = np.full(size, -1), np.empty(size, np.int64)
    for i in range(rows.shape[0]):
        at = _place_of(rows[i], table, size - 1)
        if table[at] < 0:
            table[at], first[at] = rows[i], i
        elif need[i] < need[first[at]]:
            first[at] = i
    count = 0
    chosen = np.empty(rows.shape[0], np.int64)
    for i in range(rows.shape[0]):
        if first[_place_of(rows[i], table, size - 1)] == i:
            chosen[count] = i
            count += 1
    chosen = chosen[:count]
    order = chosen[np.argsort(need[chosen], kind="mergesort")]
    return rows[order], need[order]


@nb.njit(nogil=True, cache=True)
def rows_kept(walks, now, after, look, index):
    """Return the rows that users touch whose last pose is at most `after` old [s].

    (n,) int64, each once, ascending.
    """
    users, step = 0, look.step
    centers, reaches = np.empty((walks.shape[0], 3)), np.empty(walks.shape[0])
    for user in range(walks.shape[0]):
        walk = walks[user]
        if now - walk[LAST] > after:
            continue
        last = POSES + POSE * int(walk[NEWEST])
        for k in range(3):
            centers[users, k] = (walk[last + 1 + k] - look.origin[k]) / step
        reaches[users] = _span(walk[REACH], step)
        users += 1
    centers, reaches = centers[:users], reaches[:users]
    starts, needed = np.zeros(users + 1, np.int64), 8 * users + 8
    while True:
        rows = np.empty(needed, np.int64)
        needed = rows_in_reach(centers, reaches, index, look.voxel_steps, starts, rows)
        if needed <= rows.shape[0]:
            break
    rows = np.sort(rows[:needed])
    count = 0
    for i in range(needed):
        if count == 0 or rows[i] != rows[count - 1]:
            rows[count] = rows[i]
            count += 1
    return rows[:count]
