"""Builds killed at random moments, some several times in a row, then finished and compared.

The finished archive must be that of an undisturbed build.
"""

import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

from solidcloud.server.cli.main import run

from .forked_command import Child, CountCalls, KillAt, build
from .stopped_build import Case, Change, Tally, arguments, content, make_small, write_scans

# Kills of one build before it is left to finish: usually one, sometimes more.
ROW = (1, 1, 2, 4)
SCRIPTS = Path(__file__).resolve().parent.parent


class ReferenceBuild:
    """Scans, the archive that an undisturbed build makes of them, and the duration of that build."""

    def __init__(self, folder: Path) -> None:
        """Build the archive, first here to load the kernels, then to measure it.

        Raises RuntimeError where a build fails.
        """
        make_small()
        self.folder, self.scans = folder, folder / "scans"
        write_scans(self.scans)
        with open(folder / "warm.log", "w") as log, redirect_stdout(log), redirect_stderr(log):
            code = run(arguments(self.scans, folder / "warm", 1))
        if code != 0:
            raise RuntimeError(f"a build here exited with {code}: {(folder / 'warm.log').read_text()}")
        begin = time.perf_counter()
        self.files = content(self._undisturbed("reference"))
        self.seconds = time.perf_counter() - begin
        log = self._built("counted", CountCalls())
        self.calls = int(log.rpartition("calls ")[2])
        # The archive that --overwrite replaces: the same scans with other options.
        self.old = self._undisturbed("old", ".", "--voxel", "1.5")
        self._cases = 0
        self._changed: dict[str, str] = {}

    def _undisturbed(self, name: str, scan: str = ".", *more: str) -> Path:
        self._built(name, None, scan, *more)
        return self.folder / name / "hall"

    def _built(self, name: str, before: CountCalls | None, scan: str = ".", *more: str) -> str:
        (self.folder / name).mkdir()
        target = self.folder / name / "hall"
        words = [*arguments(self.scans / scan, target, 1), *more]
        child = build(words, self.folder / f"{name}.log", before)
        if child.status != 0:
            raise RuntimeError(f"an undisturbed build exited with {child.status}: {child.said()}")
        return child.said()

    def change(self) -> Change:
        """Return an archive of the first scan, to which the second is to be added."""
        if not self._changed:
            self._first = self._undisturbed("first", "a.las")
            undisturbed = Change(self.folder / "changed", self.scans / "b.xyz", self._first, {})
            child = build(undisturbed.arguments(), self.folder / "changed.log")
            if child.status != 0:
                raise RuntimeError(f"an undisturbed add exited with {child.status}: {child.said()}")
            self._changed = content(undisturbed.target)
        self._cases += 1
        return Change(self.folder / f"case-{self._cases}", self.scans / "b.xyz", self._first, self._changed)

    def case(self, jobs: int = 1, overwrite: bool = False) -> Case:
        """Return a new target."""
        self._cases += 1
        case = Case(self.folder / f"case-{self._cases}", self.scans, self.files, jobs)
        if overwrite:
            case.put_old(self.old)
        return case


def check_finish(case: Case, tally: Tally, what: str, **how: object) -> None:
    """Run the same command to its end and check that the archive is the undisturbed one, byte for byte."""
    done = case.whole()
    child = build(case.arguments(), case.folder.with_suffix(".log"))
    faults = case.finished()
    if child.status != 0 and not (done and isinstance(case, Change)):  # a second addition is refused
        faults.append(f"the same command again exited with {child.status}: {child.said()[-2000:]}")
    tally.add(what, faults, **how)


def forked_kills(reference: ReferenceBuild, kills: int, seed: int, tally: Tally) -> None:
    """Kill builds of one process in forks.

    Half of them are killed at a random moment, half at a random call of CALLS.
    """
    rng = random.Random(seed)
    done = 0
    while done < kills:
        case = reference.case(overwrite=rng.random() < 0.2)
        hows: list[str] = []
        how = {"seed": seed, "kills": hows, "overwrite": bool(case.old)}
        for turn in range(min(rng.choice(ROW), kills - done)):
            # Finished work is not repeated: each repetition is shorter.
            by_call, span = rng.random() < 0.5, 1 / (turn + 1)
            if by_call:
                trap = KillAt(rng.randint(1, round(reference.calls * span)), rng.random() < 0.5)
                hows.append(f"call {trap.number}{' after' if trap.after else ''}")
                child = build(case.arguments(), case.folder.with_suffix(".log"), trap)
            else:
                delay = rng.uniform(0, reference.seconds * span)
                hows.append(f"{delay:.3f} s")
                child = Child(case.arguments(), case.folder.with_suffix(".log"))
                child.go()
                if child.wait(delay) is None:
                    child.signal(signal.SIGKILL)
                child.end()
            _after_kill(case, child.status, child.said(), tally, **how)
            if child.status == 0:
                break
            done += 1
        check_finish(case, tally, "finished after kills", **how)


def _after_kill(case: Case, status: int | None, said: str, tally: Tally, **how: object) -> None:
    """Check the state after a build was killed, or ended before the kill."""
    faults = case.visible()
    if status == 0:
        if not case.whole():
            faults.append("it said it was done, and the archive is not whole")
        tally.add("ended before the kill", faults, **how)
        return
    if status != -signal.SIGKILL:
        faults.append(f"it exited with {status} by itself: {said[-2000:]}")
    tally.stages[case.stage()] += 1
    tally.add("killed", faults, **how)


def real_kills(reference: ReferenceBuild, kills: int, seed: int, tally: Tally) -> None:
    """Kill real commands, each in a separate process group, with one job and with two."""
    rng = random.Random(seed)
    spans = {jobs: _span(reference, jobs) for jobs in (1, 2)}
    tally.counts["milliseconds of an undisturbed command, one job"] = round(spans[1] * 1e3)
    tally.counts["milliseconds of an undisturbed command, two jobs"] = round(spans[2] * 1e3)
    done = 0
    while done < kills:
        jobs = rng.choice((1, 2))
        case = reference.case(jobs, rng.random() < 0.2)
        hows: list[str] = []
        how = {"seed": seed, "kills": hows, "jobs": jobs, "overwrite": bool(case.old)}
        for turn in range(min(rng.choice(ROW), kills - done)):
            delay = rng.uniform(0, spans[jobs] / (turn + 1))
            hows.append(f"{delay:.3f} s")
            with tempfile.TemporaryFile() as log:
                process = _start(case, log)
                time.sleep(delay)
                # Kill the whole group at once, workers included; no-op for a command that has ended
                # by itself.
                os.killpg(process.pid, signal.SIGKILL)
                status = process.wait()
                _wait_for_group(process.pid)
                log.seek(0)
                said = log.read().decode(errors="replace")
            _after_kill(case, status, said, tally, **how)
            if status == 0:
                break
            done += 1
        case.jobs = rng.choice((1, 2))  # the finishing command may use another number of jobs
        check_finish(case, tally, "finished after kills", **how)


def _start(case: Case, log: object) -> "subprocess.Popen[bytes]":
    """Start the command in a new process group; return when it is about to begin."""
    ready, told = os.pipe()
    code = f"import os; from kill_cases.random_kills import command; command({told}, {case.arguments()!r})"
    process = subprocess.Popen(
        [sys.executable, "-c", code],
        env={
            **os.environ,
            "PYTHONPATH": os.pathsep.join(filter(None, (str(SCRIPTS), os.environ.get("PYTHONPATH")))),
        },
        stdin=subprocess.DEVNULL,
        stdout=log,  # type: ignore[arg-type]
        stderr=log,  # type: ignore[arg-type]
        pass_fds=(told,),
        start_new_session=True,
    )
    os.close(told)
    os.read(ready, 1)
    os.close(ready)
    return process


def command(told: int, words: list[str]) -> None:
    """Act as a real command: load everything, report it, run."""
    make_small()
    os.write(told, b"!")
    os.close(told)
    sys.exit(run(words))


def _span(reference: ReferenceBuild, jobs: int) -> float:
    """Return the duration of an undisturbed command from its beginning [s]."""
    case = reference.case(jobs)
    with tempfile.TemporaryFile() as log:
        process = _start(case, log)
        begin = time.perf_counter()
        if process.wait() != 0:
            log.seek(0)
            raise RuntimeError(f"an undisturbed command failed: {log.read().decode(errors='replace')}")
    if faults := case.finished():
        raise RuntimeError(f"an undisturbed command with {jobs} jobs: {faults}")
    return time.perf_counter() - begin


def _wait_for_group(group: int) -> None:
    """Wait until the group has no process left: a worker dies shortly after its builder."""
    deadline = time.monotonic() + 10
    while time.monotonic() < deadline:
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return
        time.sleep(0.01)
    raise RuntimeError(f"processes of group {group} outlived their kill")
