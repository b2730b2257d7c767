"""Traces: positions of several users, 30 times a second, in a generated town or on an archive's floor.

The same arguments give the same bits. Kinds: stroll and run from façade to façade, some through the
door; turn on the spot; tour, one long path through every façade, along which users are spread;
crowd, all through one door; teleport, another place every second. An adversary's requests depend on
evictions: its trace exists only after a run, which records it (adversary_user.py).
"""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from .....builder.synthetic.truth import SceneTruth
from ....avatars.avatar_model import AvatarModel
from . import town_paths, walking_motion
from .walking_motion import RATE

Floats = NDArray[np.float64]

SPEEDS = {"stroll": 1.5, "run": 5.0, "tour": 5.0, "crowd": 1.2}  # maximum [m/s]
SLOWEST_TOUR = 1.5
INSIDE = {"stroll": 0.5, "run": 0.1}  # share of the visits that pass the door
KINDS = ("stroll", "run", "turn", "tour", "crowd", "teleport")
ADVERSARY = "adversary"
WALKS = "walk"  # of the user's own
TELEPORT_SECONDS = 1.0
# Maximum speed between poses [m/s], and maximum jitter [m]; anything beyond both is a teleport.
FASTEST, FARTHEST_JITTER = 30.0, 0.05


class Ground(Protocol):
    """Place where users walk: a generated town (town_paths.py) or any archive (archive_floor.py)."""

    def floor(self, xy: Floats) -> Floats:
        """Return the height of the floor [m] (k,) below positions (k, 2)."""
        ...

    def spots(self, count: int, rng: np.random.Generator) -> Floats:
        """Return places to stand (count, 2)."""
        ...

    def wander(self, length: float, inside: float, rng: np.random.Generator, hurried: bool) -> Floats:
        """Return corners (k, 2) of a path of at least `length` metres.

        inside: share of the visits that pass a door, if there are any.  hurried: in wide turns.
        """
        ...

    def tour(self, rng: np.random.Generator) -> Floats:
        """Return corners (k, 2) of a closed loop through the whole place."""
        ...

    def crowded(self) -> "Ground":
        """Return the part where a crowd gathers."""
        ...


class Trace(NamedTuple):
    """n poses of all users.

    user: (n,) int64 from 0.
    time: (n,) float64 [s], ascending.
    pose: (n, 4, 4) float64.
    """

    user: NDArray[np.int64]
    time: Floats
    pose: Floats


class Centers(NamedTuple):
    """Part of a trace that the broad phase needs; rows are those of the trace.

    center: (n, 3), of the avatar's root sphere, world [m].
    reach: (n,), its radius with spheres and margin [m].
    scan: (n,) bool, right after a teleport.
    """

    user: NDArray[np.int64]
    time: Floats
    center: Floats
    reach: Floats
    scan: NDArray[np.bool_]


def traces(
    kind: str,
    place: SceneTruth | Ground,
    users: int,
    seconds: float,
    seed: int,
    speed: float | None = None,
) -> Trace:
    """Return the trace of users of one kind, each with its own places and turns.

    place: where they walk: a generated town by its truth, or any ground.
    seconds: duration of each user's trace, RATE poses a second, with the users' frames spread over
    the period of one.
    speed: maximum [m/s], None: the kind's own.
    Raises ValueError for an unknown kind, or an empty trace.
    """
    if kind not in _MAKERS:
        raise ValueError(f"kind {kind!r}: expected one of {', '.join(KINDS)}")
    frames = round(seconds * RATE)
    if users < 1 or frames < 2:
        raise ValueError(f"{users} users for {seconds:g} s: expected at least one, for two frames")
    town = town_paths.make_town_of(place) if isinstance(place, SceneTruth) else place
    numbers = [seed, KINDS.index(kind)]
    time = np.arange(frames) / RATE
    make = _MAKERS[kind](town, users, time, speed or SPEEDS.get(kind, 0.0), np.random.default_rng(numbers))
    parts = []
    for user in range(users):
        rng = np.random.default_rng([*numbers, user])
        phase = rng.uniform(0.0, 1.0 / RATE)
        parts.append(Trace(np.full(frames, user, np.int64), time + phase, make(user, rng)))
    return merged(parts)


def merged(parts: list[Trace]) -> Trace:
    """Merge traces of different users in order of time; at equal times in order of users."""
    user, time, pose = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.lexsort((user, time))
    return Trace(user[order], time[order], pose[order])


def of_users(trace: Trace, users: NDArray[np.int64] | list[int]) -> Trace:
    """Return the part of a trace that belongs to these users."""
    own = np.isin(trace.user, users)
    return Trace(trace.user[own], trace.time[own], trace.pose[own])


_Make = Callable[[int, np.random.Generator], Floats]


def _wander(town: Ground, inside: float, time: Floats, speed: float, hurried: bool = False) -> _Make:
    """Return users who go from façade to façade; each starts somewhere on its first stretch."""

    def make(user: int, rng: np.random.Generator) -> Floats:
        ahead = float(rng.uniform(0.0, 60.0))
        corners = town.wander(ahead + speed * float(time[-1]) + 10.0, inside, rng, hurried)
        way = walking_motion.make_way(corners, speed)
        begin = float(np.interp(ahead, way.length, way.time))
        return walking_motion.walk(way, begin + time, town.floor, rng)

    return make


def _stroll(town: Ground, users: int, time: Floats, speed: float, rng: np.random.Generator) -> _Make:
    return _wander(town, INSIDE["stroll"], time, speed)


def _run(town: Ground, users: int, time: Floats, speed: float, rng: np.random.Generator) -> _Make:
    return _wander(town, INSIDE["run"], time, speed, hurried=True)


def _crowd(town: Ground, users: int, time: Floats, speed: float, rng: np.random.Generator) -> _Make:
    return _wander(town.crowded(), 1.0, time, speed)


def _tour(town: Ground, users: int, time: Floats, speed: float, rng: np.random.Generator) -> _Make:
    """Return users spread evenly on one loop, fast enough to see all of it together, within the limit."""
    corners = town.tour(rng)
    way, together = walking_motion.make_way(corners, speed, closed=True), users * float(time[-1])
    for _ in range(2):  # at a lower speed, turns slow a user down less
        slower = float(np.clip(speed * way.time[-1] / together, min(SLOWEST_TOUR, speed), speed))
        way, speed = walking_motion.make_way(corners, slower, closed=True), slower

    def make(user: int, rng: np.random.Generator) -> Floats:
        whole = way.time[-1]
        at = whole * user / users + time
        return walking_motion.walk(way, at - np.floor(at / whole) * whole, town.floor, rng)

    return make


def _turn(town: Ground, users: int, time: Floats, speed: float, rng: np.random.Generator) -> _Make:
    def make(user: int, rng: np.random.Generator) -> Floats:
        spot = np.repeat(town.spots(1, rng), len(time), axis=0)
        return walking_motion.stand(spot, walking_motion.turning(time, rng), town.floor, rng)

    return make


def _teleport(town: Ground, users: int, time: Floats, speed: float, rng: np.random.Generator) -> _Make:
    def make(user: int, rng: np.random.Generator) -> Floats:
        # Count frames, not times, because of rounding: a second is RATE frames.
        stay = (np.arange(len(time)) // round(TELEPORT_SECONDS * RATE)).astype(np.int64)
        spots = town.spots(int(stay[-1]) + 1, rng)
        heading = rng.uniform(-np.pi, np.pi, len(spots))
        return walking_motion.stand(spots[stay], heading[stay], town.floor, rng)

    return make


_MAKERS: dict[str, Callable[[Ground, int, Floats, float, np.random.Generator], _Make]] = {
    "stroll": _stroll, "run": _run, "turn": _turn, "tour": _tour, "crowd": _crowd, "teleport": _teleport,
}  # fmt: skip


def save(path: Path, trace: Trace) -> None:
    """Write a trace as .npz, to be replayed bit for bit."""
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, user=trace.user, time=trace.time, pose=trace.pose)


def load(path: Path) -> Trace:
    """Read a trace. Raises ValueError where the file holds none."""
    try:
        with np.load(path, allow_pickle=False) as file:
            trace = Trace(file["user"], file["time"], file["pose"])
    except KeyError as error:
        raise ValueError(
            f"{path}: no trace ({error}): record one with `solidcloud loadtest --record`"
        ) from error
    n = len(trace.user)
    if trace.time.shape != (n,) or trace.pose.shape != (n, 4, 4) or (np.diff(trace.time) < 0).any():
        raise ValueError(f"{path}: no trace: expected users (n,), times (n,) ascending and poses (n, 4, 4)")
    return trace


def centers(trace: Trace, avatar: AvatarModel, margin: float = 0.0) -> Centers:
    """Return the position and the reach of the avatar's root sphere in each pose.

    margin: added to its reach: the radius of the scan's points, and a query's own margin [m].
    """
    local = np.append(avatar.arrays.center[0], 1.0)
    center = trace.pose[:, :3] @ local
    reach = np.full(len(center), avatar.arrays.radius[0] + avatar.radius + margin)
    return Centers(trace.user, trace.time, center, reach, jumps(trace.user, trace.time, center))


def jumps(user: NDArray[np.int64], time: Floats, place: Floats) -> NDArray[np.bool_]:
    """Return which rows (n,) are too far from the same user's last place (n, 3) to be walked.

    First rows are no jumps.
    """
    order = np.lexsort((time, user))
    far = np.linalg.norm(np.diff(place[order], axis=0), axis=1)
    most = FASTEST * np.diff(time[order]) + FARTHEST_JITTER
    jumped = np.zeros(len(user), bool)
    jumped[order[1:]] = (np.diff(user[order]) == 0) & (far > most)
    return jumped
