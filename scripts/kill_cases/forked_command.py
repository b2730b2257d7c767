"""Command `solidcloud` in a forked process with everything loaded: a build takes a fraction of a second.

The forking process must have no other threads: no progress bars, no cluster.
"""

import os
import signal
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path

from solidcloud.server.cli.main import run

# Far above the duration of a small build, even under strace; a longer run counts as hanging.
PATIENCE = 60.0


class Child:
    """Build that waits for `go`, in a separate process group; its output goes to the file `log`."""

    def __init__(self, arguments: list[str], log: Path, before: Callable[[], None] | None = None) -> None:
        """Fork. before: called in the child as it begins."""
        gate, self._gate = os.pipe()
        self.log, self.status = log, None
        self.pid = os.fork()
        if self.pid == 0:
            _build(arguments, log, gate, before)
        os.setpgid(self.pid, self.pid)  # in parent and child, whichever is first
        os.close(gate)

    status: int | None

    def go(self) -> None:
        """Let the build begin."""
        os.write(self._gate, b"!")
        os.close(self._gate)

    def signal(self, number: int) -> None:
        """Send a signal to all processes of the group."""
        os.killpg(self.pid, number)

    def wait(self, seconds: float = PATIENCE) -> int | None:
        """Return the exit code, or minus the signal that ended it; None at the time limit."""
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
        """Wait for the end; a hanging process is killed and counts as -99."""
        if self.wait() is None:
            self.signal(signal.SIGKILL)
            self.wait()
            self.status = -99
        assert self.status is not None
        return self.status

    def said(self) -> str:
        """Return all output."""
        return self.log.read_text(errors="replace") if self.log.exists() else ""


def build(arguments: list[str], log: Path, before: Callable[[], None] | None = None) -> Child:
    """Run a build to its end, disturbed only by `before`."""
    child = Child(arguments, log, before)
    child.go()
    child.end()
    return child


def _build(arguments: list[str], log: Path, gate: int, before: Callable[[], None] | None) -> None:
    """Run the command in the child and exit with its code. Never returns."""
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
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # as the command itself does
    except SystemExit as error:
        code = error.code if isinstance(error.code, int) else 1
    except BaseException:
        traceback.print_exc()
    finally:
        # Never return: the callers above belong to the forking process and would clean up its
        # folders.
        try:
            sys.stdout.flush()
            sys.stderr.flush()
        finally:
            os._exit(code)


class KillAt:
    """Kills the process at its n-th call that makes files durable and visible, before it or after it.

    Counted calls: os.fsync, os.replace, os.rename, os.unlink, os.rmdir and os.mkdir.
    """

    CALLS = ("fsync", "replace", "rename", "unlink", "rmdir", "mkdir")

    def __init__(self, number: int, after: bool) -> None:
        self.number, self.after, self.count = number, after, 0

    def __call__(self) -> None:
        """Install the hooks, in the child."""
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
    """Counts the calls without killing: the count is printed when the process ends."""

    def __init__(self) -> None:
        super().__init__(0, False)

    def __call__(self) -> None:
        """Install the hooks, and one for the end."""
        leave = os._exit
        super().__call__()

        def exiting(code: int) -> None:
            os.write(1, f"\ncalls {self.count}\n".encode())
            leave(code)

        os._exit = exiting  # type: ignore[assignment]
