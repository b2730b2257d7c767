"""Walks of the user's own: files of poses with times, one walk each, as a trace."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from .....schemas.errors import BadRequestError
from ....cli.input.pose_file import read_path
from .user_traces import Trace, merged
from .walking_motion import RATE


def read_walk(path: Path) -> Trace:
    """Read a walk: the trace of one user, from time 0 on.

    Poses without times that ascend come RATE times a second.
    Raises ScanError and BadRequestError as `read_path` does, and for fewer than two poses.
    """
    time, pose = read_path(path)
    if len(time) < 2:
        raise BadRequestError(f"{path}: {len(time)} poses, expected a walk of at least two")
    if not (np.diff(time) > 0).all():
        time = np.arange(len(time)) / RATE
    return Trace(np.zeros(len(time), np.int64), time - time[0], pose)


def repeat_walks(walks: Sequence[Trace], users: int, seconds: float) -> Trace:
    """Return the trace of users who follow the walks in turn, for `seconds`.

    A walk that is shorter is walked back, then again. Users of one walk start at different places
    of it.
    """
    parts = []
    for user in range(users):
        walk = walks[user % len(walks)]
        begin = (user // len(walks)) / -(-users // len(walks))
        parts.append(_repeated(walk, user, begin, seconds))
    return merged(parts)


def _repeated(walk: Trace, user: int, begin: float, seconds: float) -> Trace:
    """Return a walk from its share `begin` on, there and back, for `seconds`."""
    back = walk.time[-1] - walk.time[-2::-1]
    loop_time = np.concatenate([walk.time, walk.time[-1] + back])
    loop_pose = np.concatenate([walk.pose, walk.pose[-2::-1]])
    whole = float(loop_time[-1])
    loops = int(np.ceil(seconds / whole)) + 1
    # The last pose of a loop is the first of the next.
    time = np.concatenate([loop_time[:-1] + whole * k for k in range(loops)])
    pose = np.concatenate([loop_pose[:-1]] * loops)
    start = begin * float(walk.time[-1])
    kept = (time >= start) & (time < start + seconds)
    return Trace(np.full(int(kept.sum()), user, np.int64), time[kept] - start, pose[kept])
