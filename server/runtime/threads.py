"""Start of this process's threads, each with a name that `top -H` shows too."""

import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

PREFIX = "solidcloud-"
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


def _name_for_system(name: str) -> None:
    """Set the calling thread's name in the operating system to the end of `name`.

    Python 3.14 does so itself.
    """
    if sys.platform == "linux":
        with suppress(OSError):
            file = Path(f"/proc/self/task/{threading.get_native_id()}/comm")
            file.write_bytes(name.encode()[-_MAX_NAME_BYTES:])
