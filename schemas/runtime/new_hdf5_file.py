"""Atomic writing of HDF5 files, as new_file.py writes others.

The sequence survived kills at every system call. HDF5 is shielded from full disks (`_Disk`) and
from interrupts (`blocking_interrupts`).
"""

import contextlib
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import h5py

from .interrupts import blocking_interrupts
from .new_file import new_path

# No piece of HDF5's own structures is longer than this [bytes]; the longest is a group's list of
# its links.
_MAX_METADATA = 1 << 20


def hdf5_version() -> str:
    """Return the version of the HDF5 library."""
    return str(h5py.version.hdf5_version)


class _Disk:
    """File object for HDF5 that hides write errors from it and keeps the first one in `error`.

    With a full disk HDF5 2.0 crashed when it closed the file (SIGSEGV), or h5py printed an ignored
    exception and continued. A write here therefore always succeeds. After a failed write, the data
    that HDF5 reads back, its own structures, is kept in memory; records are not kept.
    """

    def __init__(self, path: Path) -> None:
        self.error: OSError | None = None
        self._path, self._position, self._end = path, 0, 0
        self._kept: list[tuple[int, bytes]] = []
        self._descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o666)

    def close(self) -> None:
        os.close(self._descriptor)

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        if whence == os.SEEK_END:
            offset += self._end
        elif whence == os.SEEK_CUR:
            offset += self._position
        self._position = offset
        return offset

    def tell(self) -> int:
        return self._position

    def write(self, data: memoryview) -> int:
        data = memoryview(data).cast("B")
        if self.error is None:
            done = 0
            try:
                while done < len(data):
                    done += os.pwrite(self._descriptor, data[done:], self._position + done)
            except OSError as error:
                self.error = OSError(error.errno, error.strerror, str(self._path))
        if self.error is not None and len(data) <= _MAX_METADATA:
            self._kept.append((self._position, bytes(data)))
        self._position += len(data)
        self._end = max(self._end, self._position)
        return len(data)

    def read(self, size: int = -1) -> bytes:
        raise NotImplementedError  # h5py requires the attribute, but calls `readinto`

    def readinto(self, buffer: memoryview) -> int:
        view = memoryview(buffer).cast("B")
        found = os.pread(self._descriptor, len(view), self._position)
        view[:] = found + bytes(len(view) - len(found))
        for at, data in self._kept:
            low, high = max(at, self._position), min(at + len(data), self._position + len(view))
            if low < high:
                view[low - self._position : high - self._position] = data[low - at : high - at]
        self._position += len(view)
        return len(view)

    def truncate(self, size: int) -> int:
        try:
            os.ftruncate(self._descriptor, size)
        except OSError as error:
            self.error = self.error or OSError(error.errno, error.strerror, str(self._path))
        self._end = size
        return size

    def flush(self) -> None:
        pass


class NewHdf5File(h5py.File):  # type: ignore[misc]
    """HDF5 file that is being written."""

    def __init__(self, disk: _Disk, deliver: Callable[[], None]) -> None:
        """Open a file on `disk` for writing.

        deliver: raises an interrupt that was held back.
        """
        self._disk, self._deliver = disk, deliver
        # Metadata of format 1.10 and later has checksums; in older formats, 5 of 1,600 flipped
        # bytes gave silently wrong results.
        super().__init__(disk, "w", libver=("v110", "v110"))

    def check(self) -> None:
        """Raise the OSError of a failed write, or a pending interrupt.

        Call it regularly in long writing.
        """
        self._deliver()
        if self._disk.error is not None:
            raise self._disk.error


@contextlib.contextmanager
def new_hdf5_file(path: Path) -> Iterator[NewHdf5File]:
    """Open an HDF5 file for writing that gets its name only when it is complete and durable on disk.

    Errors and interrupts are those of `hdf5_file`.
    """
    with new_path(path) as temporary, hdf5_file(temporary) as file:
        yield file


@contextlib.contextmanager
def hdf5_file(path: Path) -> Iterator[NewHdf5File]:
    """Open an HDF5 file for writing, under a name that `new_path` gave.

    A failed write raises an OSError that names the file, and no file is left. Interrupts wait until
    the file is closed, or until `check_interrupt`.
    """
    with blocking_interrupts() as deliver, contextlib.ExitStack() as stack:
        disk = _Disk(path)
        stack.callback(disk.close)
        try:
            with NewHdf5File(disk, deliver) as file:
                yield file
            deliver()
            if disk.error is not None:
                raise disk.error
        except BaseException as error:
            path.unlink(missing_ok=True)
            if disk.error is not None and isinstance(error, Exception):
                raise disk.error from None
            raise
