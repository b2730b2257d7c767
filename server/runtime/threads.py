"""Start of this process's threads, each with a name that `top -H` shows too."""

import logging
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

log = logging.getLogger(__name__)

PREFIX = "solidcloud-"
# Pause of a loop after an error [s], so that one that fails at once does not fill the log.
PAUSE = 0.5
# Longest thread name that Linux stores.
_MAX_NAME_BYTES = 15


def start_thread(name: str, run: Callable[..., object], *arguments: object) -> threading.Thread:
    """Start a daemon thread named `solidcloud-{name}` that runs a function; return it."""

    def named() -> None:
        _name_for_system(name)
        run(*arguments)

    thread = threading.Thread(target=named, name=PREFIX + name, daemon=True)
    thread.start()
    return thread


def start_loop(
    name: str,
    loop: Callable[..., object],
    *arguments: object,
    failed: Callable[[], object] = lambda: None,
) -> threading.Thread:
    """Start a thread for a loop that must not end before its time; return it.

    loop: returns at its end. After an error it is called again; it therefore keeps what it still has
    to do outside of itself. The error is logged; `failed` is called to report it elsewhere.
    """

    def run() -> None:
        while True:
            try:
                loop(*arguments)
                return
            except Exception:
                log.exception("thread %s: goes on after an error", name)
            try:
                failed()
            except Exception:
                log.exception("thread %s: cannot report its error", name)
            time.sleep(PAUSE)

    return start_thread(name, run)


def _name_for_system(name: str) -> None:
    """Set the calling thread's name in the operating system to the end of `name`.

    Python 3.14 does so itself.
    """
    if sys.platform == "linux":
        with suppress(OSError):
            file = Path(f"/proc/self/task/{threading.get_native_id()}/comm")
            file.write_bytes(name.encode(errors="replace")[-_MAX_NAME_BYTES:])
