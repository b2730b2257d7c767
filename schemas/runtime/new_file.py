"""Writing of new files and folders: under a temporary name, synced, renamed, parent folder synced.

A file or folder therefore has its name only when it is complete and durable on disk.
new_hdf5_file.py writes HDF5 files in this way.
"""

import os
import re
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

TEMPORARY_SUFFIX = ".tmp"
# The second form was used by earlier versions, whose units may still be running on a cluster.
_TEMPORARY = re.compile(r".+\.([0-9a-f]{32}|[0-9a-f]{12}-\d+-\d+|directory)\.tmp")


@contextmanager
def new_path(path: Path) -> Iterator[Path]:
    """Yield a temporary path; the file or folder made there is renamed to `path` at the end.

    Its name is unique, because a unit that a cluster has given up may still be running. After an
    error, remove what was made. Replace an existing file, or an empty folder.
    """
    temporary = path.with_name(f"{path.name}.{uuid.uuid4().hex}{TEMPORARY_SUFFIX}")
    try:
        yield temporary
        if temporary.is_dir():
            for inner in temporary.rglob("*"):
                sync_path(inner)
        sync_path(temporary)
        os.replace(temporary, path)
    except BaseException:
        if temporary.is_dir():
            shutil.rmtree(temporary, ignore_errors=True)
        else:
            temporary.unlink(missing_ok=True)
        raise
    sync_path(path.parent)


@contextmanager
def new_file(path: Path) -> Iterator[BinaryIO]:
    """Open a file for writing that gets its name only when it is complete and durable on disk."""
    with new_path(path) as temporary, open(temporary, "wb") as file:
        yield file


def sync_path(path: Path) -> None:
    """Make the bytes of a file, or the names in a folder, survive a power cut."""
    descriptor = os.open(path, os.O_RDONLY)
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
