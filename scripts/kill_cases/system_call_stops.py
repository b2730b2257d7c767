"""Every system call by which a build writes, stopped in turn by strace.

The faults are: killed, interrupted, no space, I/O error.
"""

import os
import re
import shutil
import signal
import subprocess
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from .forked_command import Child
from .random_kills import ReferenceBuild, check_finish
from .stopped_build import Case, Tally

# System calls by which a build makes, fills, syncs, names and removes files.
CALLS = (
    "write", "pwrite64", "fsync", "fdatasync", "ftruncate", "openat", "rename", "renameat", "renameat2", "mkdir",
    "mkdirat", "unlink", "unlinkat", "rmdir",
)  # fmt: skip
# Only these calls can fail for lack of space; an I/O error is injected into writing, syncing and
# naming only.
FULL = ("write", "pwrite64", "fsync", "fdatasync", "ftruncate", "openat", "rename", "mkdir")
FAULTS = {"KILL": "signal=KILL", "INT": "signal=INT", "ENOSPC": "error=ENOSPC", "EIO": "error=EIO"}
SAID = {"INT": "interrupted", "ENOSPC": "no space left", "EIO": "input/output error"}
EXITS = {"INT": 130, "ENOSPC": 1, "EIO": 1}


class Call(NamedTuple):
    """One system call of a build.

    number: among all calls of its name, from 1.
    text: as strace shows it.
    """

    name: str
    number: int
    text: str


def has_strace() -> bool:
    """Return whether strace is installed and permitted; containers forbid it by default."""
    program = shutil.which("strace")
    return program is not None and subprocess.run(
        [program, "-o", os.devnull, "true"], stderr=subprocess.DEVNULL, check=False
    ).returncode == 0  # fmt: skip


def calls_of(case: Case) -> list[Call]:
    """Return the calls of an undisturbed command that write or name its own files."""
    trace = case.folder.with_suffix(".trace")
    child = _traced(case, trace, ["-y"])
    if child.end() != 0 or case.finished():
        raise RuntimeError(f"a traced build exited with {child.status}: {child.said()} {case.finished()}")
    counts: Counter[str] = Counter()
    found = []
    for line in trace.read_text(errors="replace").splitlines():
        match = re.match(r"\d+ +(\w+)\(", line)
        if not match or match[1] not in CALLS:
            continue
        counts[match[1]] += 1
        own = str(case.folder) + "/" in line or f"{case.folder}>" in line
        if own and (match[1] != "openat" or re.search(r"O_WRONLY|O_RDWR|O_CREAT", line)):
            found.append(Call(match[1], counts[match[1]], line.replace(str(case.folder), "")))
    if not found:
        raise RuntimeError(f"a traced command touches nothing in {case.folder}: is that how it names it?")
    return found


def inject(case: Case, call: Call, fault: str, tally: Tally, **how: object) -> None:
    """Stop a command at one call, check the files, and let the same command finish.

    A full disk stays full until the build has ended, except for `write`, which also writes the
    error message; an I/O error occurs once.
    """
    when = f"{call.number}+" if fault == "ENOSPC" and call.name != "write" else str(call.number)
    trace = case.folder.with_suffix(".trace")
    child = _traced(case, trace, ["-e", f"inject={call.name}:{FAULTS[fault]}:when={when}"])
    status = child.end()
    how |= {"call": f"{call.name} {call.number}", "text": call.text[:200], "fault": fault}
    faults = case.visible()
    said = child.said()
    if status == 0:
        # Only the cleanup may fail without the build failing.
        tally.counts[f"{fault}: done all the same"] += 1
        faults += [] if fault == "KILL" else case.finished()[:1] if not case.whole() else []
        if fault == "KILL":
            faults.append("it was not killed: the calls are not those of the build before")
    elif fault == "KILL":
        if status != -signal.SIGKILL:
            faults.append(f"exit code {status} after a kill: {said[-1000:]}")
    else:
        if status != EXITS[fault]:
            faults.append(f"exit code {status}, expected {EXITS[fault]}")
        if SAID[fault] not in said.lower():
            faults.append(f"the message does not say {SAID[fault]!r}")
        if "Traceback" in said or "HDF5-DIAG" in said:
            faults.append("a traceback")
        opening = "interrupted" if fault == "INT" else "error: "
        if sum(line.startswith(opening) for line in said.splitlines()) != 1:
            faults.append(f"expected one line that begins with {opening!r}")
        if faults:
            faults.append(said[-3000:])
    tally.stages[case.stage()] += 1
    tally.add(fault, faults, **how)
    check_finish(case, tally, "finished after an injection", **how)
    shutil.rmtree(case.folder)


def one_of_each(calls: list[Call]) -> list[Call]:
    """Return the middle call of each name."""
    names = dict.fromkeys(call.name for call in calls)
    alike = [[call for call in calls if call.name == name] for name in names]
    return [found[len(found) // 2] for found in alike]


def all_calls(
    reference: ReferenceBuild,
    tally: Tally,
    every: int | None = 1,
    say: Callable[[str], None] | None = None,
    one_in: int = 2,
) -> int:
    """Inject each fault at each call of a build, of one that overwrites, and of `add`.

    every: only each K-th call; None: one call of each name of `build` and `add`.
    one_in: without `every`, each command has one in so many of the faults at each name, `add` another
        one than `build`. With 2, each fault occurs at each name that both commands call.
    Returns the number of calls.
    """
    points = 0
    commands: dict[str, Callable[[], Case]] = {
        "build": reference.case,
        "build --overwrite": lambda: reference.case(overwrite=True),
        "add": reference.change,
    }
    if not every:
        del commands["build --overwrite"]
    for turn, (name, make) in enumerate(commands.items()):
        calls = calls_of(make())
        if name == "build --overwrite":
            # The calls equal those of the first build until names are changed; only the later ones
            # are new.
            calls = calls[-12:]
        calls = calls[::every] if every else one_of_each(calls)
        for index, call in enumerate(calls):
            for number, fault in enumerate(FAULTS):
                if fault == "ENOSPC" and call.name not in FULL:
                    continue
                if not every and (turn + CALLS.index(call.name) + number) % one_in:
                    continue
                points += 1
                inject(make(), call, fault, tally, command=name)
            if say and index % 20 == 0:
                say(f"{name}: {index + 1} of {len(calls)} calls; {len(tally.bad)} bad")
    return points


def _traced(case: Case, trace: Path, options: list[str]) -> Child:
    """Start a build under strace."""
    child = Child(case.arguments(), case.folder.with_suffix(".log"))
    command = [
        "strace",
        "-f",
        "-qq",
        "-o",
        str(trace),
        "-e",
        f"trace={','.join(CALLS)}",
        *options,
        "-p",
        str(child.pid),
    ]
    tracer = subprocess.Popen(command, stdin=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    status = Path(f"/proc/{child.pid}/status")
    deadline = time.monotonic() + 10
    while "TracerPid:\t0" in status.read_text():
        if time.monotonic() > deadline or tracer.poll() is not None:
            child.signal(signal.SIGKILL)
            raise RuntimeError("strace does not attach: may it trace here?")
        time.sleep(0.002)
    child.go()
    child.end()
    tracer.wait()
    return child
