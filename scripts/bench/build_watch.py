"""A command, watched from outside: memory of all its processes together, processor time, and who else had a core.

Memory is PSS, of which a page that k processes share counts 1/k in each: summed over a tree of processes it is what
they take together. Anonymous memory alone leaves out what is mapped from files, which the system can take back.
"""

import json
import os
import subprocess
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

PROC = Path("/proc")
# Between two looks [s]: an array that lives shorter is missed, and the kernel frees none of ours in less.
PERIOD = 0.05
# The mappings, and who belongs to the tree (5 ms for all processes of a machine), are looked up this often [s]; the
# mappings (2 to 5 ms a process) also whenever the peak has risen by a hundredth, as the cheap count of pages says.
FULL_PERIOD = 0.5
PEAK_STEP = 1.01


class Sample(NamedTuple):
    """One look. at: since the start [s].  pss, anonymous: of the tree [bytes].  processes: in it."""

    at: float
    pss: int
    anonymous: int
    processes: int


@dataclass
class Watched:
    """What a command took. seconds: on the clock.  cpu: of all its processes [s].

    others: cores that other work had meanwhile, on average; None where the system does not say.
    samples: looks, in order.  looking: share of a core that looking took.  out, err, code: of the command.
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
        """Most memory at one moment, sum of PSS [bytes]; None where it could not be seen."""
        return max((s.pss for s in self.samples), default=None)

    @property
    def peak_anonymous(self) -> int | None:
        """Most anonymous memory at one moment [bytes]."""
        return max((s.anonymous for s in self.samples), default=None)


def parse_rollup(text: str) -> tuple[int, int]:
    """PSS and anonymous memory [bytes] of a process's smaps_rollup."""
    found = {"Pss": 0, "Anonymous": 0}
    for line in text.splitlines():
        name, _, rest = line.partition(":")
        if name in found:
            found[name] = int(rest.split()[0]) * 1024
    return found["Pss"], found["Anonymous"]


def parse_parent(text: str) -> int:
    """The parent named in a process's stat; its own name, in brackets, may hold anything."""
    return int(text[text.rindex(")") + 1 :].split()[1])


def family(root: int, parents: dict[int, int]) -> list[int]:
    """`root` and all that descend from it, of process -> parent."""
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
                continue  # it ended while we looked
    return found


def _resident(process: int) -> int:
    """Resident memory [bytes], shared pages in full: never less than PSS, and cheap."""
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
    """Processor time that anyone had since the machine started [s]."""
    try:
        fields = (PROC / "stat").read_text().split("\n", 1)[0].split()[1:]
    except OSError:
        return None
    user, nice, system, _, _, irq, soft = (int(v) for v in fields[:7])
    return (user + nice + system + irq + soft) / os.sysconf("SC_CLK_TCK")


class _Looker(threading.Thread):
    """Looks at a tree of processes until told to stop."""

    def __init__(self, root: int, begin: float) -> None:
        super().__init__(daemon=True)
        self.root, self.begin = root, begin
        self.samples: list[Sample] = []
        self.cost = 0.0
        self.done = threading.Event()

    def run(self) -> None:
        # shared: by how much resident memory, in which shared pages count in full, was above PSS at the last full look.
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
    """Run a command to its end and say what it took; it is for the caller to look at the exit code."""
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
    """The JSON object that a command printed, whatever lines stand before it."""
    at = 0 if text.startswith("{") else text.index("\n{") + 1
    return json.loads(text[at:])
