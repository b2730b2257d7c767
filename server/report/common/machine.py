"""Machine under measurement: its cores, other load, memory of processes, and the time limits of sections."""

import os
import platform
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

# Load average above which other work disturbs the figures.
BUSY = 0.5
# Time for a process that has answered to become idle, and for a library's threads to stop spinning
# [s].
SETTLE = 0.005


def say(message: str) -> None:
    """Print progress on standard error."""
    print(message, file=sys.stderr, flush=True)


def load_average() -> float:
    """Return the system's load average; print a warning where it disturbs the figures."""
    load = os.getloadavg()[0]
    if load > BUSY:
        say(f"load average {load:.1f}: other work runs here, so figures scatter; the best less")
    return load


def pin() -> int | None:
    """Pin this process and its children to one core; return the core, None where the system cannot."""
    if not hasattr(os, "sched_setaffinity"):
        say("this system cannot keep a process on one core: figures will scatter more")
        return None
    core = max(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {core})
    return core


@contextmanager
def cores(wanted: int | None) -> Iterator[int]:
    """Allow this process and its children this many cores, None: all; yield the number."""
    if not hasattr(os, "sched_setaffinity"):
        yield os.cpu_count() or 1
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, range(os.cpu_count() or 1))  # the system ignores cores that are not available
    try:
        allowed = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, set(allowed[-wanted:] if wanted else allowed))
        yield len(os.sched_getaffinity(0))
    finally:
        os.sched_setaffinity(0, before)


def cpu_name() -> str:
    """Return the processor's name."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next(
        (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine()
    )


def others_running() -> int | None:
    """Return how many other processes or threads want a core now; None where this is unknown."""
    try:
        running = Path("/proc/loadavg").read_text().split()[3]
    except OSError:
        return None
    return int(running.split("/")[0]) - 1


def parse_rollup(text: str) -> tuple[int, int]:
    """Return PSS and anonymous memory [bytes] from a process's smaps_rollup."""
    found = {"Pss": 0, "Anonymous": 0}
    for line in text.splitlines():
        name, _, rest = line.partition(":")
        if name in found:
            found[name] = int(rest.split()[0]) * 1024
    return found["Pss"], found["Anonymous"]


def drop_from_page_cache(path: Path) -> bool:
    """Drop a file from the page cache to force reading from disk; return whether this is possible."""
    if not hasattr(os, "posix_fadvise"):
        return False
    with open(path, "rb") as file:
        os.fsync(file.fileno())  # only clean pages can be dropped
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
    return True


class Clock:
    """Time limit of a section [s]: repeats while there is time, but at least once.

    others: number of other processes that wanted a core, at each check; our own processes are idle
    at these moments.
    """

    def __init__(self, seconds: float, others: list[int] | None = None) -> None:
        self.seconds = seconds
        self.others: list[int] = [] if others is None else others
        self._start = time.perf_counter()

    def restart(self) -> None:
        """Restart the clock after preparation."""
        self._start = time.perf_counter()

    def look_around(self) -> None:
        """Count the other processes that want a core, once the last side has become idle."""
        time.sleep(SETTLE)
        found = others_running()
        if found is not None:
            self.others.append(found)

    @property
    def busy(self) -> float:
        """Return the mean number of others that wanted a core; 0 where it is unknown."""
        return sum(self.others) / len(self.others) if self.others else 0.0

    @property
    def spent(self) -> float:
        """Return the time since the section began [s]."""
        return time.perf_counter() - self._start

    @property
    def left(self) -> float:
        """Return the time until the section should end [s]; negative when it is over."""
        return self.seconds - self.spent

    def loops(self, most: int, share: float = 1.0) -> Iterator[int]:
        """Yield 0, 1, ... below `most`; end early when another loop would exceed the time.

        share: of the time left now.
        """
        begin, limit = time.perf_counter(), self.left * share
        for k in range(most):
            passed = time.perf_counter() - begin
            if k and passed * (k + 1) / k > limit:
                say(f"no time for more than {k} of {most} loops")
                return
            self.look_around()
            yield k
