"""The command `solidcloud` in a forked process: all is loaded already, so a build takes a fraction of a second.

The process that forks must have no other threads: no bars, no cluster.
"""

import os
import signal
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path

from solidcloud.server.cli import run

# Far above what a small build takes, even while it is traced; then it hangs.
PATIENCE = 60.0


class Child:
    """A build that waits for `go`. A process group of its own; what it prints goes to the file `log`."""

    def __init__(self, arguments: list[str], log: Path, before: Callable[[], None] | None = None) -> None:
        """Fork. before: called in the child as it begins."""
        gate, self._gate = os.pipe()
        self.log, self.status = log, None
        self.pid = os.fork()
        if self.pid == 0:
            _build(arguments, log, gate, before)
        os.setpgid(self.pid, self.pid)  # here as well as there: whoever comes first
        os.close(gate)

    status: int | None

    def go(self) -> None:
        """Let it begin."""
        os.write(self._gate, b"!")
        os.close(self._gate)

    def signal(self, number: int) -> None:
        """Send a signal to all of its processes."""
        os.killpg(self.pid, number)

    def wait(self, seconds: float = PATIENCE) -> int | None:
        """Its exit code, or minus the signal that ended it; None where it still runs after so long."""
        deadline = time.monotonic() + seconds
        while self.status is None:
            done, status = os.waitpid(self.pid, os.WNOHANG)
            if done:
                self.status = os.waitstatus_to_exitcode(status)
            elif time.monotonic() > deadline:
                return None
            else:
                time.sleep(0.001)
        return self.status

    def end(self) -> int:
        """Wait for its end; one that hangs is killed, and counts as -99."""
        if self.wait() is None:
            self.signal(signal.SIGKILL)
            self.wait()
            self.status = -99
        assert self.status is not None
        return self.status

    def said(self) -> str:
        """All that it printed."""
        return self.log.read_text(errors="replace") if self.log.exists() else ""


def build(arguments: list[str], log: Path, before: Callable[[], None] | None = None) -> Child:
    """Run a build to its end, undisturbed but by what `before` does."""
    child = Child(arguments, log, before)
    child.go()
    child.end()
    return child


def _build(arguments: list[str], log: Path, gate: int, before: Callable[[], None] | None) -> None:
    """In the child: run the command, exit as it says. Never returns."""
    code = 1
    try:
        os.setpgid(0, 0)
        output = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND, 0o644)
        os.dup2(output, 1)
        os.dup2(output, 2)
        sys.stdout = open(1, "w", closefd=False)  # noqa: SIM115  as long as the process
        sys.stderr = open(2, "w", closefd=False)  # noqa: SIM115
        os.read(gate, 1)
        if before is not None:
            before()
        code = run(arguments)
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # as the command does
    except SystemExit as error:
        code = error.code if isinstance(error.code, int) else 1
    except BaseException:
        traceback.print_exc()
    finally:
        # Whatever happens: above this are the callers of the process that forked, and their folders to be tidied.
        try:
            sys.stdout.flush()
            sys.stderr.flush()
        finally:
            os._exit(code)


class KillAt:
    """Kills the process at its n-th call of what makes files durable and visible, before it or right after it.

    What is counted: os.fsync, os.replace, os.rename, os.unlink, os.rmdir and os.mkdir.
    """

    CALLS = ("fsync", "replace", "rename", "unlink", "rmdir", "mkdir")

    def __init__(self, number: int, after: bool) -> None:
        self.number, self.after, self.count = number, after, 0

    def __call__(self) -> None:
        """Set the traps; in the child."""
        for name in self.CALLS:
            setattr(os, name, self._trapped(getattr(os, name)))

    def _trapped(self, call: Callable[..., object]) -> Callable[..., object]:
        def trapped(*arguments: object, **named: object) -> object:
            self.count += 1
            if self.count == self.number and not self.after:
                os.kill(os.getpid(), signal.SIGKILL)
            result = call(*arguments, **named)
            if self.count == self.number and self.after:
                os.kill(os.getpid(), signal.SIGKILL)
            return result

        return trapped


class CountCalls(KillAt):
    """Counts the calls and kills nobody: the count is printed when the process ends."""

    def __init__(self) -> None:
        super().__init__(0, False)

    def __call__(self) -> None:
        """Set the traps, and one for the end."""
        leave = os._exit
        super().__call__()

        def exiting(code: int) -> None:
            os.write(1, f"\ncalls {self.count}\n".encode())
            leave(code)

        os._exit = exiting  # type: ignore[assignment]
