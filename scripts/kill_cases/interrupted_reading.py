"""Builds interrupted (SIGINT) at random moments while they read scans of one format, then finished.

A build has two scans, one of the format and a small text scan: the loss of one by --skip-bad would
be noticed.
"""

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests" / "support"))

from broken_scans import SEEDS
from solidcloud.server.cli.main import run

from .forked_command import PATIENCE, Child, build
from .stopped_build import NAME, Case, Tally, content

# Format -> seed file, points per point of --points (text takes longer to read), options of the
# build.
FORMATS: dict[str, tuple[Any, ...]] = {
    "las": ("new.las", 8),
    "laz": ("old.laz", 8),
    "laz layered": ("layered.laz", 8),
    "copc": ("variable.laz", 8),
    "e57": ("two.e57", 4),
    "ply": ("little.ply", 8),
    "ply ascii": ("text.ply", 1),
    "ptx": ("two.ptx", 1),
    "pts": ("two.pts", 1),
    "xyz": ("blanks.xyz", 1),
    "csv": ("header.csv", 1),
    "pcd": ("binary.pcd", 8),
    "pcd ascii": ("text.pcd", 1),
    "pcd packed": ("packed.pcd", 0.5),
    "obj": ("mesh.obj", 1),
    "stl": ("binary.stl", 4),
    "stl ascii": ("ascii.stl", 1),
    "glb": ("mesh.glb", 4),
    "obj sampled": ("mesh.obj", 1, "--spacing", "0.5"),
    "stl sampled": ("binary.stl", 4, "--spacing", "20"),
    "ply sampled": ("little.ply", 4, "--spacing", "0.5"),
    "glb sampled": ("mesh.glb", 4, "--spacing", "0.5"),
}
# Maximum time from an interrupt to the end of a build of any size, on an otherwise idle machine
# [s].
PROMPT = 1.0
VOXEL = 4.0  # [m]; of scans of 10 m
FORBIDDEN = ("Traceback", "check the file", "error:", "left out", "Exception ignored")


class Interrupts(Tally):
    """Counts of interrupted builds. waits: from the signal to the end of each [s]."""

    def __init__(self) -> None:
        super().__init__()
        self.waits: list[float] = []


class ReadingCase(Case):
    """One build of a scan of some format. options: additional arguments of the command."""

    def __init__(
        self, folder: Path, scans: Path, reference: dict[str, str], options: tuple[str, ...]
    ) -> None:
        super().__init__(folder, scans, reference)
        self.options = options

    def _valid(self) -> list[str]:
        """Return no faults: the archive equals the undisturbed one, byte for byte."""
        return []

    def arguments(self) -> list[str]:
        """Return the command's arguments."""
        return words(self.scans, self.target, self.options)


def words(scans: Path, target: Path, options: tuple[str, ...]) -> list[str]:
    """Return the arguments of the command that builds all scans of a folder."""
    files = sorted(str(path) for path in scans.iterdir())
    return [
        "build",
        *files,
        "-o",
        str(target),
        "--jobs",
        "1",
        "--voxel",
        str(VOXEL),
        *options,
    ]  # the last --jobs takes effect


def _usual_interrupt() -> None:
    """Let SIGINT interrupt the child even where its parent ignores the signal (nohup)."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


class Command(Child):
    """Command as a user starts it: a process that loads all it needs. See `Child`."""

    def __init__(self, arguments: list[str], log: Path) -> None:
        """Start the command in a new session."""
        self.log, self.status = log, None
        with open(log, "w") as output:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "solidcloud.server.cli.main", *arguments],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                start_new_session=True,
                restore_signals=True,
                preexec_fn=_usual_interrupt,
            )
        self.pid = self._process.pid

    def go(self) -> None:
        """Do nothing: the command has begun."""

    def wait(self, seconds: float = PATIENCE) -> int | None:
        """Return the exit code, or None where it still runs after the limit."""
        try:
            self.status = self._process.wait(seconds)
        except subprocess.TimeoutExpired:
            return None
        return self.status

    def end(self) -> int:
        """Wait for the end of the command and of all processes that it started."""
        code = super().end()
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline:
            try:
                os.killpg(self.pid, 0)
            except ProcessLookupError:
                return code
            time.sleep(0.01)
        return -98


def wait_for_handlers(child: Child) -> None:
    """Wait until a command handles signals or has ended: Python is loaded, and its work begins."""
    deadline = time.monotonic() + PATIENCE
    while child.wait(0) is None and not _handles(child.pid, signal.SIGTERM):
        if time.monotonic() > deadline:
            raise RuntimeError("a command did not begin")
        time.sleep(0.001)


def _handles(pid: int, number: int) -> bool:
    """Return whether a process has a custom handler for a signal."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    caught = next((line.split()[1] for line in lines if line.startswith("SigCgt")), "0")
    return bool(int(caught, 16) >> (number - 1) & 1)


class Format:
    """Scans of one format, the archive of an undisturbed build, and the duration of that build."""

    def __init__(self, folder: Path, name: str, points: int) -> None:
        """Write the scans and build them once. Raises RuntimeError where that fails."""
        seed, share, *options = FORMATS[name]
        self.name, self.options, self.folder = name, tuple(options), folder
        self.scans = folder / "scans"
        self.scans.mkdir(parents=True)
        count = max(6, int(points * share) // 6 * 6)
        rng = np.random.default_rng(count)
        SEEDS[seed](self.scans / seed, rng.uniform(-5, 5, (count, 3)).round(3))
        np.savetxt(self.scans / "few.xyz", rng.uniform(-5, 5, (50, 3)), fmt="%.3f")
        target = folder / "reference" / NAME
        target.parent.mkdir()
        self.seconds = 0.0
        with open(folder / "warm.log", "w") as log, redirect_stdout(log), redirect_stderr(log):
            run(words(self.scans, folder / "warm", self.options))  # load everything that builds in forks need
        begin = time.perf_counter()
        child = build(words(self.scans, target, self.options), folder / "reference.log")
        self.seconds = time.perf_counter() - begin
        if child.status != 0:
            raise RuntimeError(f"{name}: an undisturbed build exited with {child.status}: {child.said()}")
        self.reference = content(target)
        self.cases = 0

    def interrupted(self, moment: float, skip_bad: bool, tally: Interrupts, *more: str) -> None:
        """Interrupt one build after `moment` [s] and finish it; adds faults to the tally.

        more: options; with any, the command is started as a separate process and may start others.
        """
        self.cases += 1
        options = (*self.options, *(("--skip-bad",) if skip_bad else ()), *more)
        case = ReadingCase(self.folder / f"case-{self.cases}", self.scans, self.reference, options)
        log = case.folder.with_suffix(".log")
        how: dict[str, Any] = {"format": self.name, "moment": round(moment, 4), "options": options}
        child = Command(case.arguments(), log) if more else Child(case.arguments(), log, _usual_interrupt)
        child.go()
        wait_for_handlers(child)
        if child.wait(moment) is None:
            child.signal(signal.SIGINT)
        begin = time.perf_counter()
        status, said = child.end(), child.said()
        seconds = time.perf_counter() - begin
        faults = case.visible()
        if status == 0:
            if not case.whole():
                faults.append(f"it said it was done, and the archive is not whole: {said[-500:]}")
            tally.add("ended before", faults, **how)
        else:
            faults += judged(status, said)
            tally.stages[case.stage()] += 1
            tally.add("interrupted", faults, **how)
            tally.waits.append(seconds)
        again = build(case.arguments(), log)
        faults = (
            [] if again.status == 0 else [f"the same command again: {again.status}: {again.said()[-500:]}"]
        )
        tally.add("finished", faults + case.finished(), **how)
        shutil.rmtree(case.folder)


def judged(status: int, said: str) -> list[str]:
    """Return the faults of the end of an interrupted command."""
    faults = [] if status == 130 else [f"exit code {status}, expected 130: {said[-500:]}"]
    faults += [f"it said {word!r}: {said[-1500:]}" for word in FORBIDDEN if word in said]
    if said.count("interrupted") != 1:
        faults.append(f"'interrupted' {said.count('interrupted')} times, expected once: {said[-500:]}")
    return faults


def moments(seconds: float, count: int, rng: random.Random) -> list[float]:
    """Return random moments of a build, half of them in its first half, where scans are read."""
    return [rng.uniform(0, seconds * (0.5 if k % 2 else 1.0)) for k in range(count)]


def interrupt_reading(
    folder: Path, name: str, points: int, count: int, seed: int, say: Callable[[str], None], *more: str
) -> Interrupts:
    """Interrupt `count` builds of scans of one format, half of them with --skip-bad.

    more: see `Format.interrupted`.
    """
    tally = Interrupts()
    begin = time.perf_counter()
    plain = Format(folder / name.replace(" ", "-"), name, points)
    rng = random.Random(f"{seed} {name}")
    seconds = plain.seconds
    if more:
        begun = Command(
            words(plain.scans, plain.folder / "timed", (*plain.options, *more)), plain.folder / "timed.log"
        )
        wait_for_handlers(begun)
        begin = time.perf_counter()
        begun.end()
        seconds = time.perf_counter() - begin
    for k, moment in enumerate(moments(seconds, count, rng)):
        plain.interrupted(moment, k % 4 in (0, 3), tally, *more)
    shutil.rmtree(plain.folder)
    say(
        f"{name}: {tally.counts['interrupted']} interrupted, {len(tally.bad)} bad, "
        f"{time.perf_counter() - begin:.0f} s, a build {seconds:.2f} s"
    )
    return tally
