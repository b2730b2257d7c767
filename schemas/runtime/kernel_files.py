"""Folder of compiled kernels: files of machine code, each checked before it is used.

A file contains a magic number, a SHA-256 over its own name and its payload, and the payload. The
payload is unpickled and run, so a file is used only if its digest is right, and a folder only if
nobody else can write to it. A damaged file is removed, reported once, and compiled again. No file
makes this module raise: a process that cannot use the folder compiles. A package may deliver kernels
in a folder of its own (scripts/build_wheel): what the folder lacks is looked for there.
"""

import contextlib
import errno
import fcntl
import hashlib
import logging
import os
import secrets
import shutil
import stat
import time
from collections.abc import Iterator
from pathlib import Path

log = logging.getLogger(__name__)

_MAGIC = b"solidcloud k 1\n\0"
_HEAD = len(_MAGIC) + hashlib.sha256().digest_size
_SUFFIX = ".kernel"
_TEMPORARY = ".tmp"
_STARTING = ".starting"
_COMPILING = ".compiling"
# An empty file: delivered kernels are not used.
_REFUSED = "delivered.refused"
_DAY = 86_400.0
# Longest wait for another process that compiles a kernel: that of walks takes 40 s with all that it calls.
_CLAIM_SECONDS = 600.0
# Limits of the folder. All kernels of one version of this package take 10 MB, of each family of processors.
MAX_BYTES = 1 << 29
MAX_DAYS = 60.0


def default_folder(cache: str) -> Path:
    """Return the folder of compiled kernels.

    cache: value of NUMBA_CACHE_DIR, "" if it is not set.
    """
    if cache:
        return Path(cache).absolute() / "solidcloud-kernels"
    home = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    return Path(home).absolute() / "solidcloud" / "kernels"


class KernelFiles:
    """Folder of compiled kernels. Threads may share an instance; processes may share the folder.

    folder: where the files are; created on first use.  delivered: a folder with more of them, which
    is only read; it need not exist.
    """

    def __init__(self, folder: Path, delivered: Path | None = None) -> None:
        self.folder = folder
        self._warned: set[str] = set()
        self._fault = ""  # why the folder cannot be used
        self._pruned = False
        self.has_waited = False  # whether another process was found compiling
        self._claims: dict[str, int] = {}
        self._descriptor = self._open()
        refused = self._descriptor is not None and self._stat(_REFUSED) is not None
        self._delivered = None if refused else delivered

    def __del__(self) -> None:
        """Remove the marks of what was not written, and close the folder."""
        if (descriptor := getattr(self, "_descriptor", None)) is not None:
            for name in list(self._claims):
                self._release(name)
            os.close(descriptor)

    def read(self, name: str) -> bytes | None:
        """Return the payload that was written under `name`; None if there is none that may be used.

        Without a file, wait while another process compiles it; the first process is to write it.
        """
        if self._descriptor is None:
            payload = self._read_delivered(name)
            if payload is None:
                self._warn_not_stored(self._fault)
            return payload
        try:
            content = self._content(name)
        except FileNotFoundError:
            payload = self._read_delivered(name)
            return self.read(name) if payload is None and self._claim(name) else payload
        except OSError as error:
            self.discard(name, error.strerror or str(error))
            return None
        payload = content[_HEAD:]
        if content[:_HEAD] != _head(name, payload):
            self.discard(name, f"its {len(content)} bytes do not match their digest")
            return None
        return payload

    def _read_delivered(self, name: str) -> bytes | None:
        """Return a payload of the delivered kernels; None if there is none that may be used."""
        if self._delivered is not None:
            with contextlib.suppress(OSError):
                content = (self._delivered / name).read_bytes()
                if content[:_HEAD] == _head(name, content[_HEAD:]):
                    return content[_HEAD:]
        return None

    def write(self, name: str, payload: bytes) -> None:
        """Write a payload under `name`, atomically."""
        if self._descriptor is None:
            self._warn_not_stored(self._fault)
            return
        if not self._pruned:
            self._pruned = True
            self.prune()
        temporary = f"{secrets.token_hex(12)}{_TEMPORARY}"
        try:
            try:
                self._create(temporary, _head(name, payload), payload)
                os.replace(temporary, name, src_dir_fd=self._descriptor, dst_dir_fd=self._descriptor)
            except BaseException:
                with contextlib.suppress(OSError):
                    os.unlink(temporary, dir_fd=self._descriptor)
                raise
        except OSError as error:
            self._warn_not_stored(error.strerror or str(error))
        finally:
            self._release(name)

    def discard(self, name: str, fault: str) -> None:
        """Remove a damaged file, and log that on the first occurrence."""
        outcome = "removed" if self._remove(name) else "it cannot be removed: remove the folder"
        self._warn_once(
            "damaged",
            f"compiled kernels in {self.folder}: {name} is damaged ({fault}): {outcome}; "
            "damaged kernels are compiled again",
        )

    def remove_all(self) -> None:
        """Remove every compiled kernel, and use delivered ones no longer."""
        for name in self._names(_SUFFIX):
            self._remove(name)
        self._delivered = None
        if self._descriptor is not None:
            with contextlib.suppress(OSError):
                self._create(_REFUSED)

    def prune(self, max_bytes: int = MAX_BYTES, max_days: float = MAX_DAYS) -> None:
        """Remove files not used for `max_days`, then the least recently used beyond `max_bytes`."""
        now, kept = time.time(), 0
        for name, found in (*self._files(_TEMPORARY), *self._files(_COMPILING)):
            if now - found.st_mtime > _DAY:
                self._remove(name)
        listed = [(found.st_mtime, found.st_size, name) for name, found in self._files(_SUFFIX)]
        for used, size, name in sorted(listed, reverse=True):
            kept += size
            if kept > max_bytes or now - used > max_days * _DAY:
                self._remove(name)

    @contextlib.contextmanager
    def starting(self) -> Iterator[bool]:
        """Mark the folder during a block; yield True if an earlier process crashed in such a block.

        A mark is a file that its process holds locked. The system unlocks it however the process
        ends.
        """
        unfinished = any([self._remove_stale_mark(name) for name in self._names(_STARTING)])
        with contextlib.ExitStack() as stack:
            with contextlib.suppress(OSError):
                if self._descriptor is not None:
                    name, flags = f"{secrets.token_hex(12)}{_STARTING}", os.O_RDWR | os.O_CREAT | os.O_EXCL
                    mark = os.open(name, flags | os.O_CLOEXEC, 0o600, dir_fd=self._descriptor)
                    stack.callback(os.close, mark)
                    stack.callback(self._remove, name)
                    fcntl.flock(mark, fcntl.LOCK_EX | fcntl.LOCK_NB)
            yield unfinished

    def _remove_stale_mark(self, name: str) -> bool:
        """Remove a mark that no process holds; return True if it was removed."""
        try:
            mark = os.open(name, os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC, dir_fd=self._descriptor)
        except OSError:
            return False
        try:
            fcntl.flock(mark, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return self._remove(name)
        except OSError:
            return False
        finally:
            os.close(mark)

    def _claim(self, name: str) -> bool:
        """Return True once another process that compiles `name` has ended that; False if there is none.

        False marks `name` as compiled by this process, until `write`. So processes that start at
        the same time do not compile everything twice. A mark is a file that its process holds
        locked. The system unlocks it however the process ends.
        """
        if self._descriptor is None or name in self._claims:
            return False
        try:
            flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
            mark = os.open(_claim_name(name), flags, 0o600, dir_fd=self._descriptor)
        except OSError:
            return False
        end, waited = time.monotonic() + _CLAIM_SECONDS, False
        while time.monotonic() < end:
            try:
                fcntl.lockf(mark, fcntl.LOCK_EX | fcntl.LOCK_NB)  # of this process, not of its children
            except OSError:
                waited = self.has_waited = True
                time.sleep(0.02)
                continue
            if not waited:
                self._claims[name] = mark
                return False
            os.close(mark)
            return True
        os.close(mark)
        return False

    def _release(self, name: str) -> None:
        """Remove the mark of `_claim`."""
        if (mark := self._claims.pop(name, None)) is not None:
            self._remove(_claim_name(name))
            os.close(mark)

    def _open(self) -> int | None:
        """Open the folder, created if needed. If it cannot be used, note why and return None."""
        try:
            self.folder.parent.mkdir(parents=True, exist_ok=True)
            with contextlib.suppress(FileExistsError):
                self.folder.mkdir(mode=0o700)
            descriptor = os.open(self.folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
        except OSError as error:
            self._fault = error.strerror or str(error)
            return None
        found = os.fstat(descriptor)
        if found.st_uid in (os.geteuid(), 0) and not found.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
            return descriptor
        os.close(descriptor)
        mode = stat.S_IMODE(found.st_mode)
        self._fault = f"owner {found.st_uid}, mode {mode:o}: expected owner {os.geteuid()}, mode 700"
        return None

    def _content(self, name: str) -> bytes:
        """Read a file and update its time of use.

        Raises OSError if it cannot be read or is no regular file.
        """
        flags = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
        descriptor = os.open(name, flags, dir_fd=self._descriptor)
        with open(descriptor, "rb", buffering=0, closefd=True) as file:
            found = os.fstat(descriptor)
            if not stat.S_ISREG(found.st_mode):
                raise OSError(errno.EINVAL, "not a regular file")
            if time.time() - found.st_mtime > _DAY:
                with contextlib.suppress(OSError):  # fails in another owner's folder
                    os.utime(descriptor)
            return file.readall()

    def _create(self, name: str, *parts: bytes) -> None:
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
        descriptor = os.open(name, flags, 0o600, dir_fd=self._descriptor)
        with open(descriptor, "wb") as file:
            file.writelines(parts)

    def _names(self, suffix: str) -> list[str]:
        """List the names in the folder with a suffix."""
        if self._descriptor is None:
            return []
        try:
            return [name for name in os.listdir(self._descriptor) if name.endswith(suffix)]
        except OSError:
            return []

    def _files(self, suffix: str) -> Iterator[tuple[str, os.stat_result]]:
        """Yield the names with a suffix, and their file status."""
        for name in self._names(suffix):
            if (found := self._stat(name)) is not None:
                yield name, found

    def _stat(self, name: str) -> os.stat_result | None:
        try:
            return os.stat(name, dir_fd=self._descriptor, follow_symlinks=False)
        except OSError:
            return None

    def _remove(self, name: str) -> bool:
        """Remove a file or folder; return True if nothing is left under its name."""
        try:
            os.unlink(name, dir_fd=self._descriptor)
        except FileNotFoundError:
            return True
        except IsADirectoryError:
            shutil.rmtree(name, ignore_errors=True, dir_fd=self._descriptor)
        except OSError:
            return False
        return self._stat(name) is None

    def _warn_not_stored(self, fault: str) -> None:
        self._warn_once(
            "not kept",
            f"compiled kernels are not kept in {self.folder} ({fault}), so each start compiles for about a minute: "
            "set NUMBA_CACHE_DIR to a folder that you alone may write",
        )

    def _warn_once(self, kind: str, message: str) -> None:
        """Log a message, but only the first of its kind."""
        if kind not in self._warned:
            self._warned.add(kind)
            log.warning(message)


def _claim_name(name: str) -> str:
    return name.removesuffix(_SUFFIX) + _COMPILING


def _head(name: str, payload: bytes) -> bytes:
    """Return the header of a file.

    The digest covers the name too, so that no file can stand in for another.
    """
    digest = hashlib.sha256(f"{name}\0".encode())
    digest.update(payload)
    return _MAGIC + digest.digest()
