"""The machine that is measured: one core or all, what else runs on it, and how long a section may take."""

import os
import platform
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

# Above this load other work disturbs the figures.
BUSY = 0.5
# Until a process that has answered waits for its next question, and the threads of a library stop spinning [s].
SETTLE = 0.005


def say(message: str) -> None:
    """Progress, on standard error."""
    print(message, file=sys.stderr, flush=True)


def load_average() -> float:
    """What else runs here, as the system counts it; says so where it disturbs."""
    load = os.getloadavg()[0]
    if load > BUSY:
        say(f"load average {load:.1f}: other work runs here, so figures scatter; the best less")
    return load


def pin() -> int | None:
    """Keep this process, and those it starts, on one core. None where the system cannot."""
    if not hasattr(os, "sched_setaffinity"):
        say("this system cannot keep a process on one core: figures will scatter more")
        return None
    core = max(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {core})
    return core


@contextmanager
def cores(wanted: int | None) -> Iterator[int]:
    """Inside, this process and those it starts then may use so many cores, None: all there are. Gives how many."""
    if not hasattr(os, "sched_setaffinity"):
        yield os.cpu_count() or 1
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, range(os.cpu_count() or 1))  # the system leaves out those that are not ours
    try:
        allowed = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, set(allowed[-wanted:] if wanted else allowed))
        yield len(os.sched_getaffinity(0))
    finally:
        os.sched_setaffinity(0, before)


def cpu_name() -> str:
    """What the processor calls itself."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next(
        (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine()
    )


def others_running() -> int | None:
    """How many processes or threads but this one want a core at this moment; None where the system does not say."""
    try:
        running = Path("/proc/loadavg").read_text().split()[3]
    except OSError:
        return None
    return int(running.split("/")[0]) - 1


class Clock:
    """How long a section may take [s]: it repeats while there is time, and once in any case.

    others: how many others wanted a core, each time it was looked at; what we started waits at these moments.
    """

    def __init__(self, seconds: float, others: list[int] | None = None) -> None:
        self.seconds = seconds
        self.others: list[int] = [] if others is None else others
        self._start = time.perf_counter()

    def restart(self) -> None:
        """Begin now: what came before was preparing."""
        self._start = time.perf_counter()

    def look_around(self) -> None:
        """Count who else wants a core, once the side that had its turn has gone to sleep."""
        time.sleep(SETTLE)
        found = others_running()
        if found is not None:
            self.others.append(found)

    @property
    def busy(self) -> float:
        """How many others wanted a core, on average; 0 where it is not known."""
        return sum(self.others) / len(self.others) if self.others else 0.0

    @property
    def spent(self) -> float:
        """Since the section began [s]."""
        return time.perf_counter() - self._start

    @property
    def left(self) -> float:
        """Until the section should end [s]; negative when it is late."""
        return self.seconds - self.spent

    def loops(self, most: int, share: float = 1.0) -> Iterator[int]:
        """0, 1, ... below `most`, ending early when another one would not fit into this share of what is left now."""
        begin, limit = time.perf_counter(), self.left * share
        for k in range(most):
            passed = time.perf_counter() - begin
            if k and passed * (k + 1) / k > limit:
                say(f"no time for more than {k} of {most} loops")
                return
            self.look_around()
            yield k
