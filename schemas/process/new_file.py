"""Atomic writing of files: under a temporary name, synced, renamed, the folder synced.

A file therefore has its name only when it is complete and durable on disk. new_hdf5_file.py writes
HDF5 files in the same way.
"""

import os
import re
import threading
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

TEMPORARY_SUFFIX = ".tmp"
_TEMPORARY = re.compile(r".+\.([0-9a-f]{32}|[0-9a-f]{12}-\d+-\d+|directory)\.tmp")

# Random id of this process, or of the one that it was forked from: several hosts use the same
# process ids.
_PROCESS = os.urandom(6).hex()


def temporary_path(path: Path) -> Path:
    """Return the temporary name under which this thread writes `path`.

    Names differ between threads and processes, because a cluster may run one unit in two places at
    once.
    """
    return path.with_name(f"{path.name}.{_PROCESS}-{os.getpid()}-{threading.get_ident()}{TEMPORARY_SUFFIX}")


@contextmanager
def new_file(path: Path) -> Iterator[BinaryIO]:
    """Open a file for writing that gets its name only when it is complete and durable on disk.

    Its temporary name is unique, because a unit that a cluster has given up may still be running.
    """
    temporary = path.with_name(f"{path.name}.{uuid.uuid4().hex}{TEMPORARY_SUFFIX}")
    try:
        with open(temporary, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def publish(path: Path) -> None:
    """Sync the temporary file of `path`, rename it, and sync its folder."""
    temporary = temporary_path(path)
    with open(temporary, "rb") as file:
        os.fsync(file.fileno())
    os.replace(temporary, path)
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Make a rename inside this folder survive a power cut."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def is_temporary(path: Path) -> bool:
    """Return whether a name is a temporary name that this module makes, or that of merged run directories."""
    return _TEMPORARY.fullmatch(path.name) is not None


def remove_temporaries(folder: Path) -> None:
    """Remove every temporary file below a folder."""
    for path in folder.rglob(f"*{TEMPORARY_SUFFIX}"):
        path.unlink(missing_ok=True)
