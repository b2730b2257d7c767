"""Check a path: the clearance of its poses and of the motions between them, and the clashes.

`distance` is asked for every pose and `sweep` for every motion between two poses, then `contacts`
for the poses in contact, in requests of a few hundred, so that a check shows how far it is and can
be stopped.
"""

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from ...schemas.errors import BadRequestError, BusyError, TooLargeError
from ...schemas.wire.answers import ContactsAnswers, Cost, DistanceAnswers, SweepAnswers, Verdict
from ...schemas.wire.question_table import join_answers
from ...schemas.wire.request_limits import MAX_POSES
from ..scene_interface import QueryMethods
from .clash_list import Clash, list_clashes, runs
from .path_motions import (
    SWEEP_TOLERANCE,
    TOUCH_MARGIN,
    Motions,
    examine_motions,
    least_clearance,
    poses_between,
    unknown_motions,
)

Floats = NDArray[np.float64]

_A = TypeVar("_A", bound=Cost)

# Poses of one request: a fraction of a second, after which a check can be stopped.
BATCH_POSES = 128
# Reasons that a result lists.
MOST_FAULTS = 5
# Poses that are examined from the first contact of a motion to its end, where neither of its ends
# is in contact, and such poses of a whole path.
_POSES_OF_MOTION, _MOST_BETWEEN = 16, 20_000


class Clearances(NamedTuple):
    """Clearance of some poses of a path, and of the motions that end at them.

    first: number of the first.  signed_distance: (n,) [m], inf beyond reach.  verdict: (n,).
    motions: (n,), or (n - 1,) from the path's first pose on, which no motion ends at.
    """

    first: int
    signed_distance: Floats
    verdict: NDArray[np.uint8]
    motions: Motions


class Track(NamedTuple):
    """Places on a path, in order: its poses, and further ones on motions that are in contact.

    number: (r,) of the pose; 4.25 is at a quarter of the motion from pose 4 to pose 5.
    times: (r,) [s].  poses: (r, 4, 4).
    """

    number: Floats
    times: Floats
    poses: Floats


class CheckedPath(NamedTuple):
    """Result of a check.

    times: (k,) [s].  poses: (k, 4, 4).  reach: of the measured clearance [m].
    signed_distance: (k,) [m], inf beyond reach.  verdict: (k,); UNKNOWN for poses that were not
    examined.  motions: (k - 1,), between the poses.
    track: places to which the numbers of a clash refer.
    clashes: deepest first.  complete: False if the check was stopped.
    clearance: lower bound of the signed distance on the whole path, motions included, where it was
    examined [m]; at most `PRECISION` below the true one if nothing is in contact, else minus the
    sum of the radii of two points that touch; None beyond reach.
    faults: why something is unknown, if the server says so.
    """

    times: Floats
    poses: Floats
    reach: float
    signed_distance: Floats
    verdict: NDArray[np.uint8]
    motions: Motions
    track: Track
    clashes: list[Clash]
    complete: bool
    clearance: float | None
    faults: tuple[str, ...] = ()

    def count(self, verdict: Verdict) -> int:
        """Return the number of poses with a verdict."""
        return int((self.verdict == verdict).sum())

    def count_motions(self, verdict: Verdict) -> int:
        """Return the number of motions between two poses with a verdict."""
        return int((self.motions.verdict == verdict).sum())

    @property
    def unknown(self) -> list[tuple[int, int]]:
        """Return the first and last pose of each stretch that is unknown, motions included."""
        steps = np.zeros(max(0, 2 * len(self.verdict) - 1), bool)
        steps[::2], steps[1::2] = self.verdict == Verdict.UNKNOWN, self.motions.verdict == Verdict.UNKNOWN
        return [(first // 2, (last + 1) // 2) for first, last in runs(steps)]

    def fraction(self, clash: Clash) -> float | None:
        """Return where a clash begins on the motion between two poses, 0 to 1; None if at a pose."""
        return float(self.track.number[clash.first] % 1.0) or None

    def poses_of(self, first: int, last: int) -> tuple[int, int]:
        """Return the first and last pose of places of the track; between two poses, these."""
        number = self.track.number
        return math.floor(number[first]), math.ceil(number[last])


class Watcher(NamedTuple):
    """Callbacks of a running check.

    clearances: takes those of poses as they arrive.  progress: takes what is done (0 to 1).
    stopped: returns whether the check is to end.
    """

    clearances: Callable[[Clearances], None] = lambda _: None
    progress: Callable[[float], None] = lambda _: None
    stopped: Callable[[], bool] = lambda: False


def check_path(
    scene: QueryMethods,
    avatar: str,
    times: Floats,
    poses: Floats,
    *,
    reach: float = 1.0,
    watcher: Watcher | None = None,
) -> CheckedPath:
    """Check a path of an avatar that the scene knows.

    scene: a `Client` or a `Scene`.  times: (k,) [s].  poses: (k, 4, 4), avatar to world.
    reach: farthest clearance that is measured [m].
    Raise BadRequestError for no poses, TooLargeError for more than 100,000, BusyError if the server
    does not answer, and the errors of the questions.
    """
    watcher = watcher or Watcher()
    if not len(poses):
        raise BadRequestError("the path has no poses: expected at least one")
    if len(poses) > MAX_POSES:
        raise TooLargeError(f"path of {len(poses)} poses: at most {MAX_POSES}: check it in pieces")
    distance = np.full(len(poses), np.inf)
    verdict = np.full(len(poses), Verdict.UNKNOWN, np.uint8)
    motions = unknown_motions(len(poses) - 1)
    questions = _Questions(scene, avatar, watcher.stopped)
    # How many poses and motions the later questions are about is not known yet.
    for batch in _batches(np.arange(len(poses)), watcher, (0.0, 0.6)):
        found = questions.distance(poses[batch], reach)
        distance[batch], verdict[batch] = found.signed_distance, found.verdict
        begin, end = max(0, int(batch[0]) - 1), int(batch[-1])
        own = slice(begin, end + 1)
        some = examine_motions(questions.sweep, poses[own], distance[own], verdict[own], reach)
        motions.verdict[begin:end], motions.touch[begin:end] = some.verdict, some.touch
        motions.clearance[begin:end] = some.clearance
        watcher.clearances(Clearances(int(batch[0]), found.signed_distance, found.verdict, some))

    def verdicts(numbers: NDArray[np.int64], margin: float) -> NDArray[np.uint8]:
        answered = np.full(len(numbers), Verdict.UNKNOWN, np.uint8)
        for batch in _batches(np.arange(len(numbers)), watcher, (0.6, 0.6)):
            which = numbers[batch]
            answered[batch] = questions.sweep(poses[which], poses[which + 1], margin).verdict
        return answered

    contact = verdict == Verdict.CONTACT
    track = _track(times, poses, verdict, motions)
    clashes: list[Clash] = []
    at_poses = np.searchsorted(track.number, np.flatnonzero(contact))
    between = np.flatnonzero(track.number % 1.0)
    for touching, margin, share in (
        (at_poses, 0.0, (0.6, 0.8)),
        (between, TOUCH_MARGIN, (0.8, 1.0)),
    ):
        parts = [
            questions.contacts(track.poses[batch], margin) for batch in _batches(touching, watcher, share)
        ]
        done = touching[: sum(map(len, parts))]
        clashes += list_clashes(done, join_answers(parts)) if parts else []
    clashes.sort(key=lambda each: (-each.depth, each.first))
    if contact.any() or (motions.verdict == Verdict.CONTACT).any():
        clearance = -questions.radii
    else:
        known = distance[verdict != Verdict.UNKNOWN]
        clearance = least_clearance(verdicts, motions, float(known.min(initial=reach)))
    watcher.progress(1.0)
    return CheckedPath(
        times, poses, reach, distance, verdict, motions, track, clashes, not watcher.stopped(),
        clearance if clearance < reach else None, tuple(questions.faults),
    )  # fmt: skip


def _track(times: Floats, poses: Floats, verdict: NDArray[np.uint8], motions: Motions) -> Track:
    """Return the poses of a path and further ones on motions in contact whose ends are not."""
    free = verdict != Verdict.CONTACT
    which = np.flatnonzero((motions.verdict == Verdict.CONTACT) & free[:-1] & free[1:])
    numbers = np.arange(len(poses), dtype=np.float64)
    if not len(which):
        return Track(numbers, times, poses)
    each = max(1, min(_POSES_OF_MOTION, _MOST_BETWEEN // len(which)))
    # Neither end is in contact: both are excluded, so that a number tells on which motion it is.
    touch = np.clip(motions.touch[which], 2.0**-30, 1 - 2.0**-30)[:, None]
    fractions = touch + (1 - touch) * np.arange(each) / each
    more = poses_between(poses[which], poses[which + 1], fractions).reshape(-1, 4, 4)
    added = (which[:, None] + fractions).ravel()
    order = np.argsort(np.concatenate([numbers, added]), kind="stable")
    number = np.concatenate([numbers, added])[order]
    return Track(number, np.interp(number, numbers, times), np.concatenate([poses, more])[order])


def _batches(
    items: NDArray[np.int64], watcher: Watcher, share: tuple[float, float]
) -> Iterator[NDArray[np.int64]]:
    """Yield items in batches until the check is stopped. share: progress at the first and the last."""
    begin, end = share
    for start in range(0, len(items), BATCH_POSES):
        if watcher.stopped():
            return
        yield items[start : start + BATCH_POSES]
        watcher.progress(begin + (end - begin) * min(1.0, (start + BATCH_POSES) / len(items)))


class _Questions:
    """Questions about an avatar to a scene, whose answers are whole.

    faults: reasons why something is unknown, each once.
    radii: largest sum of the radii of an avatar's and a scan's point that were nearest [m].
    """

    def __init__(self, scene: QueryMethods, avatar: str, stopped: Callable[[], bool]) -> None:
        self._scene, self._avatar, self._stopped = scene, avatar, stopped
        self._before = getattr(scene, "unanswered", 0)
        self.faults: dict[str, None] = {}
        self.radii = 0.0

    def distance(self, poses: Floats, reach: float) -> DistanceAnswers:
        """Ask for the distance at poses."""
        found = self._ask(lambda some: self._scene.distance(self._avatar, some, reach), poses)
        self._measure(found.witness_avatar, found.witness_cloud, found.signed_distance)
        return found

    def sweep(self, first: Floats, last: Floats, margin: float) -> SweepAnswers:
        """Ask for the first contact of motions."""
        found = self._ask(lambda begin, end: self._scene.sweep(self._avatar, begin, end, margin), first, last)
        # The spheres at the first contact are `margin` apart, or nearer by the query's tolerance.
        self._measure(found.witness_avatar, found.witness_cloud, margin - SWEEP_TOLERANCE)
        return found

    def contacts(self, poses: Floats, margin: float) -> ContactsAnswers:
        """Ask for the contacts at poses."""
        return self._ask(lambda some: self._scene.contacts(self._avatar, some, limit=0, margin=margin), poses)

    def _measure(self, avatar: Floats, cloud: Floats, apart: Floats | float) -> None:
        """Take the radii of pairs of points. apart: distance of their spheres [m]."""
        sums = np.linalg.norm(avatar - cloud, axis=1) - apart
        self.radii = max(self.radii, float(np.nanmax(sums, initial=0.0)))

    def _ask(self, question: Callable[..., _A], *poses: Floats) -> _A:
        """Return the answers for poses. Raise BusyError if no server gave them.

        poses: arrays (n, 4, 4), of which the question takes as many. A server ends a request that
        takes too long, such as the first one, for which it reads much of the archive. The poses are
        then asked for again, in halves.
        """
        answers = question(*poses)
        # A client makes up answers that no server gave, and counts them.
        if getattr(self._scene, "unanswered", 0) > self._before:
            silence: Callable[[str], str] = getattr(self._scene, "silence", lambda _: "")
            raise BusyError(f"the check ended early: {silence('distance')}")
        half = len(poses[0]) // 2
        if answers.stopped and half and not self._stopped():
            parts = [
                self._ask(question, *(each[part] for each in poses))
                for part in (slice(half), slice(half, None))
            ]
            joined: _A = join_answers(parts)
            return joined
        for fault in (*answers.faults, answers.stopped):
            if fault and len(self.faults) < MOST_FAULTS:
                self.faults[fault] = None
        return answers
