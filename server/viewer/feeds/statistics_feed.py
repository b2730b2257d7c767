"""Statistics of the scene over the last minute, asked once a second for all browsers."""

import logging
import time
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

from ....schemas.errors import SolidcloudError
from ....schemas.wire.stats import StatsAnswer
from ..page.page_messages import text_message
from .browser_feed import BrowserFeed
from .scene_link import OpenScene

log = logging.getLogger(__name__)

# Interval of the questions [s], and how many samples a new browser is given: a minute.
_INTERVAL, _KEPT = 1.0, 60
# Counters of the cache whose rates are shown.
_COUNTERS = ("hits", "misses", "prefetched", "used", "wasted", "evicted")


class Reading(NamedTuple):
    """Statistics at a time of the viewer's clock [s]. round_trip: of the question [s]."""

    time: float
    round_trip: float
    stats: StatsAnswer


class StatisticsFeed(BrowserFeed[str]):
    """Samples that browsers follow; a context manager, thread-safe."""

    def __init__(self, scene: Callable[[], OpenScene | None], interval: float = _INTERVAL) -> None:
        """Make a feed. scene: returns the scene that is shown.  interval: of the samples [s]."""
        super().__init__("viewer-statistics")
        self._scene, self._interval = scene, interval
        self._samples: deque[dict[str, Any]] = deque(maxlen=_KEPT)

    def follow(self, number: int, listener: Callable[[str], None]) -> None:
        """Call a function with the samples so far, and with each later one."""
        with self._lock:
            super().follow(number, listener)
            listener(text_message("statistics", all=True, samples=list(self._samples)))

    def _run(self) -> None:
        """Ask once in each interval, while browsers follow. Runs in a thread."""
        before: Reading | None = None
        while not self._stop.wait(self._interval):
            if not self._listeners:
                before = None
                continue
            now = self._read()
            if now is not None and before is not None:
                self._keep(sample(before, now))
            before = now

    def _read(self) -> Reading | None:
        """Return the statistics now; None without a server."""
        scene = self._scene()
        if scene is None:
            return None
        begin = time.monotonic()
        try:
            stats = scene.reader.stats()
        except SolidcloudError as error:
            log.debug("no statistics: %s", error)
            return None
        end = time.monotonic()
        return Reading(end, end - begin, stats)

    def _keep(self, made: dict[str, Any] | None) -> None:
        """Keep a sample, and give it to all browsers."""
        if made is None:
            return
        with self._lock:
            self._samples.append(made)
            self._tell(text_message("statistics", all=False, samples=[made]))


def sample(before: Reading, now: Reading) -> dict[str, Any] | None:
    """Return what happened between two readings; None if the server began anew between them.

    time: of the second reading [s].  effects: [name, mean seconds in a frame, frames in which it ran
    a second].  frames: of all users, a second.  rates: of each counter of the cache, a second.  totals: the counters.
    """
    seconds = now.time - before.time
    old, new = before.stats, now.stats
    counts = {name: getattr(new, name) - getattr(old, name) for name in _COUNTERS}
    known = {each.effect: each for each in old.effects}
    ran = [(each, known.get(each.effect)) for each in new.effects]
    began_anew = (
        old.generation != new.generation
        or min(counts.values()) < 0
        or any(was is None or now.frames < was.frames for now, was in ran)
    )
    if began_anew or seconds <= 0:
        return None
    changes = [
        (each.effect, each.seconds - was.seconds, each.frames - was.frames)
        for each, was in ran
        if was is not None
    ]
    frames = max((ran for _, _, ran in changes), default=0)
    return {
        "time": now.time,
        "roundTrip": now.round_trip,
        "frames": frames / seconds,
        "effects": [
            [name, spent / frames if frames else 0.0, count / seconds] for name, spent, count in changes
        ],
        "rates": {name: count / seconds for name, count in counts.items()},
        "totals": {name: getattr(new, name) for name in _COUNTERS},
        "memory": {
            "voxels": new.resident_bytes,
            "levels": new.level_bytes,
            "budget": new.budget_bytes,
            "resident": new.resident,
            "total": new.voxels,
        },
    }
