"""Messages for errors of the operating system: where, what was found and what to do.

This module imports nothing slow: the command line loads it before it knows its subcommand.
"""

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..errors import SolidcloudError

_FULL = (errno.ENOSPC, errno.EDQUOT)

_WORDS = {
    errno.EACCES: "permission denied: change the permissions, or choose another path",
    errno.EPERM: "not permitted: choose another path",
    errno.EROFS: "the file system is read-only: choose another path",
    errno.ENOENT: "no such file or folder: check the path",
    errno.ENOTDIR: "a part of the path is a file, expected a folder: check the path",
    errno.EEXIST: "already exists: choose another path",
    errno.EISDIR: "is a folder, expected a file: choose another path",
    errno.ENOTEMPTY: "is a folder that is not empty: choose another path",
    errno.ENAMETOOLONG: "the name is too long: choose a shorter one",
    errno.ELOOP: "too many links in the path: check the path",
    errno.EFBIG: "the file grows larger than the file system or a limit allows: choose another disk",
    errno.EIO: "the disk does not read or write (input/output error): check the disk",
    errno.EMFILE: "too many open files: raise the limit (ulimit -n)",
    errno.ENFILE: "too many open files on this machine: close other programs",
    errno.ENOMEM: "out of memory: close other programs",
    errno.ETXTBSY: "the file is in use: try again later",
    **dict.fromkeys(_FULL, "no space left on the disk: make room"),
}


def os_error_words(error: OSError) -> str:
    """Return the meaning of an operating system error and what to do, without path and number."""
    return _WORDS.get(error.errno or 0) or (
        f"{error.strerror}: check the path and the disk" if error.strerror else str(error)
    )


def os_error_line(error: OSError) -> str:
    """Return one sentence for an OSError: path if known, meaning, what to do."""
    where = error.filename if error.filename2 is None else error.filename2
    return (
        f"{os.fsdecode(where)}: {os_error_words(error)}"
        if isinstance(where, str | bytes)
        else os_error_words(error)
    )


@contextmanager
def naming_write_errors(output: Path) -> Iterator[None]:
    """Convert an OSError about writing `output` to a SolidcloudError that names it.

    Errors about other files pass unchanged. Errors count as about the output if they name the
    output, the temporary files beside it or the folders above it, or if the disk is full.
    """
    try:
        yield
    except OSError as error:
        if not _is_about(error, output):
            raise
        raise SolidcloudError(f"{output}: cannot be written: {write_error_words(error, output)}") from error


def check_writable(folder: Path) -> None:
    """Raise OSError if no file can be created in a folder.

    Call it before hours of work whose result is written there.
    """
    probe = folder / f".{os.getpid()}.tmp"
    descriptor = os.open(probe, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o600)
    os.close(descriptor)
    probe.unlink()


def _is_about(error: OSError, output: Path) -> bool:
    """Return True if an error is about writing `output`."""
    names = [os.fsdecode(n) for n in (error.filename, error.filename2) if isinstance(n, str | bytes)]
    if not names:
        return error.errno in (*_FULL, errno.EFBIG)
    whole = Path(os.path.abspath(output))
    for path in (Path(os.path.abspath(name)) for name in names):
        beside = path.parent == whole.parent and whole.stem in path.name
        if beside or path == whole or whole in path.parents or path in whole.parents:
            return True
    return False


def write_error_words(error: OSError, output: Path) -> str:
    """Return a message on what prevents writing `output`, and what to do."""
    if error.errno in (errno.ENOTDIR, errno.EEXIST, errno.ENOENT):
        for folder in output.parents:
            if folder.exists() and not folder.is_dir():
                return f"{folder} is a file, expected a folder: choose another path"
        if error.errno == errno.ENOENT:
            if output.parent.is_dir():
                return f"{output.parent} takes no new files: choose another path"
            return f"there is no folder {output.parent}: make it first"
    return os_error_words(error)
