"""Observation of a command from outside: memory and processor time of all its processes, other load.

Memory is PSS, in which a page shared by k processes counts 1/k in each; the sum over a process tree
is its total memory. Anonymous memory alone excludes pages mapped from files, which the system can
reclaim.
"""

import json
import os
import subprocess
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from solidcloud.server.report.common.machine import parse_rollup

PROC = Path("/proc")
# Sampling period [s]: a shorter-lived array is missed; the builder frees no array that fast.
PERIOD = 0.05
# Period of reading the mappings and the process tree [s]; finding the tree takes 5 ms for all
# processes of a machine. The mappings (2 to 5 ms per process) are also read whenever the
# inexpensive resident page count indicates a peak higher by a hundredth.
FULL_PERIOD = 0.5
PEAK_STEP = 1.01


class Sample(NamedTuple):
    """One sample.

    at: since the start [s].
    pss, anonymous: of the process tree [bytes].
    processes: number of processes in the tree.
    """

    at: float
    pss: int
    anonymous: int
    processes: int


@dataclass
class Watched:
    """Resources of a command.

    seconds: wall time.
    cpu: of all its processes [s].
    others: mean number of cores that other work used meanwhile; None where the system does not
    report it.
    samples: in order.
    looking: share of a core that the sampling took.
    out, err, code: of the command.
    """

    seconds: float
    cpu: float
    others: float | None
    samples: list[Sample] = field(default_factory=list)
    looking: float = 0.0
    out: str = ""
    err: str = ""
    code: int = 0

    @property
    def peak(self) -> int | None:
        """Return the maximum memory at one moment, sum of PSS [bytes]; None where it is unknown."""
        return max((s.pss for s in self.samples), default=None)

    @property
    def peak_anonymous(self) -> int | None:
        """Return the maximum anonymous memory at one moment [bytes]."""
        return max((s.anonymous for s in self.samples), default=None)


def parse_parent(text: str) -> int:
    """Return the parent process from a process's stat; the name in brackets there may hold anything."""
    return int(text[text.rindex(")") + 1 :].split()[1])


def family(root: int, parents: dict[int, int]) -> list[int]:
    """Return `root` and all its descendants, from process -> parent."""
    children: dict[int, list[int]] = {}
    for child, parent in parents.items():
        children.setdefault(parent, []).append(child)
    found = [root]
    for process in found:
        found += children.get(process, ())
    return found


def _parents() -> dict[int, int]:
    found = {}
    for entry in os.listdir(PROC):
        if entry.isdigit():
            try:
                found[int(entry)] = parse_parent((PROC / entry / "stat").read_text())
            except (OSError, ValueError, IndexError):
                continue  # the process has ended meanwhile
    return found


def _resident(process: int) -> int:
    """Return resident memory [bytes] with shared pages in full: at least PSS, and inexpensive."""
    try:
        return int((PROC / str(process) / "statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, IndexError):
        return 0


def _proportional(process: int) -> tuple[int, int]:
    try:
        return parse_rollup((PROC / str(process) / "smaps_rollup").read_text())
    except OSError:
        return 0, 0


def _machine_busy() -> float | None:
    """Return the total processor time used since the machine started [s]."""
    try:
        fields = (PROC / "stat").read_text().split("\n", 1)[0].split()[1:]
    except OSError:
        return None
    user, nice, system, _, _, irq, soft = (int(v) for v in fields[:7])
    return (user + nice + system + irq + soft) / os.sysconf("SC_CLK_TCK")


class _Looker(threading.Thread):
    """Thread that samples a process tree until it is stopped."""

    def __init__(self, root: int, begin: float) -> None:
        super().__init__(daemon=True)
        self.root, self.begin = root, begin
        self.samples: list[Sample] = []
        self.cost = 0.0
        self.done = threading.Event()

    def run(self) -> None:
        # shared: difference of resident memory, in which shared pages count in full, and PSS at the
        # last full sample.
        peak, last, tree, shared = 0, -FULL_PERIOD, [self.root], 0
        while not self.done.is_set():
            begin, cost = time.perf_counter(), time.thread_time()
            at = begin - self.begin
            due = at - last >= FULL_PERIOD
            if due:
                tree = family(self.root, _parents())
            resident = sum(map(_resident, tree))
            if due or resident - shared > peak * PEAK_STEP:
                found = [_proportional(process) for process in tree]
                pss, anonymous = sum(f[0] for f in found), sum(f[1] for f in found)
                if pss:
                    self.samples.append(Sample(at, pss, anonymous, len(tree)))
                peak, last, shared = max(peak, pss), at if due else last, max(0, resident - pss)
            self.cost += time.thread_time() - cost
            self.done.wait(max(0.0, PERIOD - (time.perf_counter() - begin)))


def watch(command: list[str], cwd: Path | None = None) -> Watched:
    """Run a command to its end and return its resources; the caller checks the exit code."""
    busy, own = _machine_busy(), sum(os.times()[:2])
    begin = time.perf_counter()
    with subprocess.Popen(
        command, cwd=cwd, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, errors="replace"
    ) as process:
        looker = _Looker(process.pid, begin)
        if (PROC / "self" / "smaps_rollup").exists():
            looker.start()
        before = os.times()
        out, err = process.communicate()
        seconds = time.perf_counter() - begin
        after = os.times()
        looker.done.set()
        if looker.ident is not None:
            looker.join()
    cpu = (after.children_user + after.children_system) - (before.children_user + before.children_system)
    busy_after, others = _machine_busy(), None
    if busy is not None and busy_after is not None:
        ours = cpu + sum(os.times()[:2]) - own
        others = max(0.0, (busy_after - busy - ours) / seconds)
    return Watched(seconds, cpu, others, looker.samples, looker.cost / seconds, out, err, process.returncode)


def last_json(text: str) -> dict[str, Any]:
    """Return the JSON object that a command printed after any other lines."""
    at = 0 if text.startswith("{") else text.index("\n{") + 1
    return json.loads(text[at:])
