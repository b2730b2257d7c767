"""Lock of an archive: one builder at a time.

This module imports nothing slow, so that a second builder is refused at once.
"""

import errno
import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ...schemas.errors import BadRequestError

# Errors of flock that mean another process holds the lock; any other is a fault of the file system.
_HELD = (errno.EWOULDBLOCK, errno.EACCES)


def lock_path(target: Path) -> Path:
    """Return the file that is locked while the archive `target` is written."""
    return target.parent / f".{target.name}.lock"


def _taken(target: Path) -> BadRequestError:
    """Make the error for a second builder."""
    return BadRequestError(
        f"{target}: another build, add or remove is writing it: wait for it, or give a build another -o"
    )


def check_free(target: Path) -> None:
    """Raise BadRequestError if another builder is writing `target` now. This does not lock it."""
    try:
        with open(lock_path(target)) as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        raise _taken(target) from None
    except OSError:  # no lock file, or not readable
        return


@contextmanager
def locked(target: Path) -> Iterator[None]:
    """Hold the exclusive lock of `target`; raise BadRequestError if another builder has it."""
    path = lock_path(target)
    while True:
        file = open(path, "w")  # noqa: SIM115  stays open as long as the lock
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            file.close()
            if error.errno in _HELD:
                raise _taken(target) from None
            raise OSError(error.errno, error.strerror, str(path)) from None
        # The previous holder may have removed the file we just locked. Then lock the one that
        # exists now.
        if path.exists() and os.fstat(file.fileno()).st_ino == path.stat().st_ino:
            break
        file.close()
    try:
        yield
    finally:
        path.unlink(missing_ok=True)
        file.close()
