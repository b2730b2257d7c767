"""Lines on standard error while kernels are compiled, which happens once on a machine.

The folder of compiled kernels is watched, because worker processes compile too: a process marks
there what it compiles, and other processes wait for it (schemas/runtime/kernel_files.py). Nothing
is printed if all kernels are there, or within the first second.
"""

import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

# Suffixes of a mark and of a compiled kernel.
_MARK, _KERNEL = ".compiling", ".kernel"
# Time between two looks at the folder, and the longest gap between two compilations [s].
_LOOK_SECONDS, _GAP_SECONDS = 0.3, 2.0
# A compilation is reported after _QUIET_SECONDS, then every _LINE_SECONDS.
_QUIET_SECONDS, _LINE_SECONDS = 1.0, 10.0


class CompileNotice:
    """Reporter of the compilations in a folder of compiled kernels.

    folder: need not exist.  say: prints a line.  clock: seconds since any epoch.
    """

    def __init__(
        self, folder: Path, say: Callable[[str], None], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._folder, self._say, self._clock = folder, say, clock
        self._begin = time.time()
        self._known = self._kernels()
        # Of the present compilation: its start, the last sign of it, the last line, kernels before.
        self._since: float | None = None
        self._seen = self._said = 0.0
        self._before = len(self._known)

    def look(self) -> None:
        """Look at the folder once, and print a line if one is due."""
        now, kernels = self._clock(), self._kernels()
        working = bool(kernels - self._known) or self._marked()
        if working:
            if self._since is None:
                self._since, self._said, self._before = now, 0.0, len(self._known)
            self._seen = now
        self._known = kernels
        if self._since is None:
            return
        if not working and now - self._seen > _GAP_SECONDS:
            self.end()
        elif working and now - max(self._said, self._since) >= (
            _LINE_SECONDS if self._said else _QUIET_SECONDS
        ):
            first = not self._said
            self._said = now
            done = f"{self._done()} done in {now - self._since:.0f} s"
            self._say(f"compiling kernels, once on this machine: {'please wait' if first else done}")

    def end(self) -> None:
        """Print the last line of a compilation that was reported."""
        if self._since is not None and self._said:
            seconds = self._seen - self._since
            self._say(f"compiled {self._done()} kernels in {seconds:.0f} s; they are kept for the next start")
        self._since = None

    def _done(self) -> int:
        return max(0, len(self._known) - self._before)

    def _kernels(self) -> set[str]:
        try:
            return {name for name in os.listdir(self._folder) if name.endswith(_KERNEL)}
        except OSError:
            return set()

    def _marked(self) -> bool:
        """Return whether a process has marked a kernel since the start of this one.

        Older marks were left by processes that were killed.
        """
        try:
            with os.scandir(self._folder) as entries:
                return any(
                    entry.name.endswith(_MARK) and entry.stat().st_mtime >= self._begin - 1.0
                    for entry in entries
                )
        except OSError:
            return False


@contextmanager
def compile_notices() -> Iterator[None]:
    """Print lines on standard error while kernels are compiled in this block, by any process.

    They replace the messages about this process alone (schemas/runtime/compiling.py).
    """
    ended = threading.Event()
    own = logging.getLogger("solidcloud.schemas.runtime.compiling")
    level = own.level
    own.setLevel(logging.ERROR)

    def watch() -> None:
        # Signals are for the main thread, which runs the handlers and may wait in a system call.
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
        if ended.wait(_LOOK_SECONDS):
            return
        # Imported here: most commands end before.
        from ....schemas.runtime.kernel_files import default_folder

        notice = CompileNotice(default_folder(os.environ.get("NUMBA_CACHE_DIR", "")), _print)
        while not ended.wait(_LOOK_SECONDS):
            notice.look()
        notice.end()

    thread = threading.Thread(target=watch, name="solidcloud-compile-notice", daemon=True)
    thread.start()
    try:
        yield
    finally:
        own.setLevel(level)
        ended.set()
        thread.join(1.0)


def _print(line: str) -> None:
    # `sys.stderr` is looked up at each call: progress bars replace it, to print above themselves.
    print(line, file=sys.stderr, flush=True)
