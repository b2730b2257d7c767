"""An HDF5 file written whole or not at all: under a temporary name, closed, synced, renamed, its folder synced.

The recipe survived kills at every system call. What a full disk, or an interrupt, would do to HDF5 is kept from it
(`_Disk`, `kept_back`).
"""

import contextlib
import os
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import h5py

from .interrupts import kept_back

# Of this process, or of the one it was forked from: process ids are given on many hosts.
_PROCESS = os.urandom(6).hex()


def temporary_path(path: Path) -> Path:
    """The name that `path` is written under: this thread's own, as a cluster may run one unit in two places at once."""
    return path.with_name(f"{path.name}.{_PROCESS}-{os.getpid()}-{threading.get_ident()}.tmp")


# No piece of HDF5's own structures is longer [bytes]; the longest is a group's list of its links.
_MOST_METADATA = 1 << 20


class _Disk:
    """A file that HDF5 writes, and whose errors it does not hear of: the first is kept in `error`.

    With a full disk HDF5 2.0 crashed as it closed the file (SIGSEGV), or h5py printed what it ignored and went on. So
    a write always succeeds; what comes after one that did not is kept in memory, for HDF5 to read back: its own
    structures, and no record, which it does not read.
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
        if self.error is not None and len(data) <= _MOST_METADATA:
            self._kept.append((self._position, bytes(data)))
        self._position += len(data)
        self._end = max(self._end, self._position)
        return len(data)

    def read(self, size: int = -1) -> bytes:
        raise NotImplementedError  # h5py asks whether it is there, and uses `readinto`

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


class NewFile(h5py.File):  # type: ignore[misc]
    """An HDF5 file being written."""

    def __init__(self, disk: _Disk, deliver: Callable[[], None]) -> None:
        """Write to `disk`. deliver: hands on an interrupt that was kept back."""
        self._disk, self._deliver = disk, deliver
        # Metadata of format 1.10 and later is checksummed; in older ones 5 of 1,600 flips were silently wrong.
        super().__init__(disk, "w", libver=("v110", "v110"))

    def check(self) -> None:
        """Raise the OSError of a write that failed, or an interrupt: to be asked now and then in long writing."""
        self._deliver()
        if self._disk.error is not None:
            raise self._disk.error


@contextlib.contextmanager
def new_file(path: Path) -> Iterator[NewFile]:
    """An HDF5 file under a temporary name. Given its own only once it is closed and synced.

    A write that fails is an OSError that names the file; nothing is left then. Interrupts wait until the file is
    closed, or for `check`.
    """
    temporary = temporary_path(path)
    with kept_back() as deliver, contextlib.ExitStack() as stack:
        disk = _Disk(temporary)
        stack.callback(disk.close)
        try:
            with NewFile(disk, deliver) as file:
                yield file
            deliver()
            if disk.error is not None:
                raise disk.error
        except BaseException as error:
            temporary.unlink(missing_ok=True)
            if disk.error is not None and isinstance(error, Exception):
                raise disk.error from None
            raise


def publish(path: Path) -> None:
    """Sync the temporary file of `path`, rename it, sync its folder."""
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
