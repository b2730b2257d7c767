"""Check a path: the clearance of each pose, and the clashes.

`distance` is asked for every pose, then `contacts` for those in contact, in requests of a few
hundred poses, so that a check shows how far it is and can be stopped.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from ...schemas.errors import BadRequestError, BusyError, TooLargeError
from ...schemas.wire.answers import ContactsAnswers, Cost, Verdict
from ...schemas.wire.question_table import join_answers
from ...schemas.wire.request_limits import MAX_POSES
from ..scene_interface import QueryMethods
from .clash_list import Clash, list_clashes, runs

Floats = NDArray[np.float64]

_A = TypeVar("_A", bound=Cost)

# Poses of one request: a fraction of a second, after which a check can be stopped.
BATCH_POSES = 128
# Reasons that a result lists.
MOST_FAULTS = 5


class Clearances(NamedTuple):
    """Clearance of some poses of a path.

    first: number of the first.  signed_distance: (n,) [m], inf beyond reach.  verdict: (n,).
    """

    first: int
    signed_distance: Floats
    verdict: NDArray[np.uint8]


class CheckedPath(NamedTuple):
    """Result of a check.

    times: (k,) [s].  poses: (k, 4, 4).  reach: of the measured clearance [m].
    signed_distance: (k,) [m], inf beyond reach.  verdict: (k,); UNKNOWN for poses that were not
    examined.
    clashes: deepest first.  complete: False if the check was stopped.
    faults: why poses are unknown, if the server says so.
    """

    times: Floats
    poses: Floats
    reach: float
    signed_distance: Floats
    verdict: NDArray[np.uint8]
    clashes: list[Clash]
    complete: bool
    faults: tuple[str, ...] = ()

    def count(self, verdict: Verdict) -> int:
        """Return the number of poses with a verdict."""
        return int((self.verdict == verdict).sum())

    @property
    def clearance(self) -> float | None:
        """Return the least signed distance of a pose that was examined [m]; None beyond reach."""
        known = self.signed_distance[self.verdict != Verdict.UNKNOWN]
        least = float(known.min(initial=np.inf))
        return least if np.isfinite(least) else None

    @property
    def unknown(self) -> list[tuple[int, int]]:
        """Return the first and last pose of each run of poses that are unknown."""
        return runs(self.verdict == Verdict.UNKNOWN)


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
    questions = _Questions(scene, watcher.stopped)
    # `contacts` takes about as long as `distance`; how many poses it is asked for is not known yet.
    for batch in _batches(np.arange(len(poses)), watcher, 0.0):
        found = questions.ask(lambda some: scene.distance(avatar, some, reach), poses[batch])
        distance[batch], verdict[batch] = found.signed_distance, found.verdict
        watcher.clearances(Clearances(int(batch[0]), found.signed_distance, found.verdict))
    touching = np.flatnonzero(verdict == Verdict.CONTACT)
    parts: list[ContactsAnswers] = []
    for batch in _batches(touching, watcher, 0.5):
        parts.append(questions.ask(lambda some: scene.contacts(avatar, some, limit=0), poses[batch]))
    done = touching[: sum(map(len, parts))]
    clashes = list_clashes(done, join_answers(parts)) if parts else []
    watcher.progress(1.0)
    return CheckedPath(
        times, poses, reach, distance, verdict, clashes, not watcher.stopped(), tuple(questions.faults)
    )


def _batches(items: NDArray[np.int64], watcher: Watcher, begin: float) -> Iterator[NDArray[np.int64]]:
    """Yield items in batches until the check is stopped. begin: progress at the first."""
    for start in range(0, len(items), BATCH_POSES):
        if watcher.stopped():
            return
        yield items[start : start + BATCH_POSES]
        done = min(1.0, (start + BATCH_POSES) / len(items))
        watcher.progress(begin + 0.5 * done)


class _Questions:
    """Questions to a scene whose answers are whole.

    faults: reasons why poses are unknown, each once.
    """

    def __init__(self, scene: QueryMethods, stopped: Callable[[], bool]) -> None:
        self._scene, self._stopped = scene, stopped
        self._before = getattr(scene, "unanswered", 0)
        self.faults: dict[str, None] = {}

    def ask(self, question: Callable[[Floats], _A], poses: Floats) -> _A:
        """Return the answers for poses. Raise BusyError if no server gave them.

        A server ends a request that takes too long, such as the first one, for which it reads much
        of the archive. The poses are then asked for again, in halves.
        """
        answers = question(poses)
        # A client makes up answers that no server gave, and counts them.
        if getattr(self._scene, "unanswered", 0) > self._before:
            silence: Callable[[str], str] = getattr(self._scene, "silence", lambda _: "")
            raise BusyError(f"the check ended early: {silence('distance')}")
        half = len(poses) // 2
        if answers.stopped and half and not self._stopped():
            parts = [self.ask(question, poses[:half]), self.ask(question, poses[half:])]
            joined: _A = join_answers(parts)
            return joined
        for fault in (*answers.faults, answers.stopped):
            if fault and len(self.faults) < MOST_FAULTS:
                self.faults[fault] = None
        return answers
