"""Who may write an archive: one builder at a time. Loads nothing that takes time: a second is refused at once."""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..schemas.errors import BadRequestError


def lock_path(target: Path) -> Path:
    """The file that is locked while the archive `target` is written."""
    return target.parent / f".{target.name}.lock"


def _taken(target: Path) -> BadRequestError:
    """What a second builder is told."""
    return BadRequestError(
        f"{target}: another build is writing it, or add or remove: wait for it (a build may be given another -o)"
    )


def check_free(target: Path) -> None:
    """Raise BadRequestError where another builder writes `target` just now; who comes after this is not kept off."""
    try:
        with open(lock_path(target)) as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        raise _taken(target) from None
    except OSError:  # no lock, or nobody may see it
        return


@contextmanager
def locked(target: Path) -> Iterator[None]:
    """Keep a second builder off the same target."""
    path = lock_path(target)
    while True:
        file = open(path, "w")  # noqa: SIM115  held open as long as the lock
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            file.close()
            raise _taken(target) from None
        # The holder before us may have removed the file we just locked: then lock the one that is there now.
        if path.exists() and os.fstat(file.fileno()).st_ino == path.stat().st_ino:
            break
        file.close()
    try:
        yield
    finally:
        path.unlink(missing_ok=True)
        file.close()
