"""Progress of compilation, for whoever waits for it.

A burst is a sequence of compilations without a long pause: those that one query needs when nothing
is stored yet. One message follows after the burst's first second, then one every ten seconds. They
are warnings if somebody watches the standard error stream, otherwise information, so that a
program's output does not change. The commands print their own lines, which count all processes
(server/cli/output/compile_notice.py).
"""

import logging
import sys
import threading
import time
from collections.abc import Callable

log = logging.getLogger(__name__)

# A burst's first message comes after FIRST [s], each further one after EVERY [s]. A pause of this
# length ends the burst [s].
FIRST, EVERY, PAUSE = 1.0, 10.0, 5.0


class CompileProgress:
    """Counter of compilations that reports long bursts. Thread-safe."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """Begin without a burst. clock: returns the time [s]."""
        self._clock = clock
        self._lock = threading.Lock()
        self.on_first: Callable[[], object] | None = None  # called once, before a compilation begins
        self.any = False  # whether a compilation has begun
        self._begun = self._last = self._due = 0.0
        self._count = 0

    def begin(self) -> None:
        """Record that the compilation of a function begins; functions may be nested."""
        with self._lock:
            first, self.on_first, self.any = self.on_first, None, True
        if first is not None:
            first()
        with self._lock:
            now = self._clock()
            if not self._count or now >= self._last + PAUSE:
                self._begun, self._count, self._due = now, 0, now + FIRST
            self._count += 1
            self._report(now)

    def end(self) -> None:
        """Record that the compilation of a function has ended."""
        with self._lock:
            self._report(self._clock())

    def _report(self, now: float) -> None:
        """Log a message if one is due."""
        self._last = now
        if now >= self._due:
            self._due = now + EVERY
            log.log(
                logging.WARNING if _is_watched() else logging.INFO,
                "compiling for this computer, which is done once: %d functions in %.0f s so far",
                self._count,
                now - self._begun,
            )


def _is_watched() -> bool:
    """Return whether a person sees the standard error stream: in a terminal or a notebook."""
    return "ipykernel" in sys.modules or (sys.stderr is not None and sys.stderr.isatty())
