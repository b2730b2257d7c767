"""Key files: where a server leaves the key of its seals for clients of the same user, and where a client finds it."""

import hashlib
import logging
import os
import re
import secrets
import socket
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

from ...schemas.errors import BadRequestError
from ...schemas.wire.seals import KEY_BYTES, parse_key
from .endpoints import canonical

log = logging.getLogger(__name__)


class KeyFile(NamedTuple):
    """A key that was read, and what tells its file from one that has taken its place."""

    key: bytes
    version: tuple[int, int, int]


def key_paths(endpoint: str) -> list[Path]:
    """Return the files in which the key of a server at an endpoint may be: the first that can be is written.

    Both folders are the user's own. The host's name is in the file's: a home folder may be that of many hosts.
    """
    name = _file_name(socket.gethostname(), endpoint)
    folders = []
    if runtime := os.environ.get("XDG_RUNTIME_DIR"):
        folders.append(Path(runtime))
    with suppress(RuntimeError):  # nobody's home
        folders.append(Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"))
    return [folder / "solidcloud" / name for folder in folders]


@lru_cache(maxsize=256)
def _file_name(host: str, endpoint: str) -> str:
    """Return the name of the key file of a server. Remembered: it is looked for with each reply that has no seal."""
    text = f"{host} {canonical(endpoint)}"
    plain = re.sub(r"[^A-Za-z0-9.-]+", "_", text)[:80]
    return f"{plain}-{hashlib.sha256(text.encode()).hexdigest()[:8]}.key"


@contextmanager
def published_key(endpoint: str, key_file: Path | None) -> Iterator[bytes]:
    """Give a server's key, which the user's clients find while inside. To be entered once the endpoint is taken.

    key_file: holds the key; None: a random one. BadRequestError: that file does not do.
    """
    key = secrets.token_bytes(KEY_BYTES) if key_file is None else read_given_key(key_file)
    written: Path | None = None
    for path in key_paths(endpoint):
        try:
            _write(path, key)
        except OSError as error:
            log.debug("no key file at %s: %s", path, error)
        else:
            written = path
            break
    if written is None:
        log.warning(
            "no key file could be written: clients cannot tell this server from another program at its endpoint, "
            "unless both have --key-file"
        )
    try:
        yield key
    finally:
        if written is not None:
            written.unlink(missing_ok=True)


def find_key(endpoint: str, known: KeyFile | None = None, unusable: set[Any] | None = None) -> KeyFile | None:
    """Return the key of the server at an endpoint of this host, the newest that its user left; None: no usable one.

    known: returned where its file is still the newest.  unusable: files that were found unusable before and are not
    read again; others are added. A file that others can read or write is left alone, with a warning.
    """
    unusable = set() if unusable is None else unusable
    found = []
    for path in key_paths(endpoint):
        with suppress(OSError):
            status = os.stat(path, follow_symlinks=False)
            # The time of a change of mode or owner too: it may make a file usable.
            found.append((_version(status), status.st_ctime_ns, path))
    for each in sorted(found, reverse=True):
        version, _, path = each
        if known is not None and known.version == version:
            return known
        if each in unusable:
            continue
        try:
            return _read(path, private=True)
        except (OSError, BadRequestError) as error:
            unusable.add(each)
            log.warning("%s is not used: %s", path, error)
    return None


def read_given_key(path: Path) -> bytes:
    """Return the key in a file that somebody named; BadRequestError where it is none, or everybody could read it."""
    try:
        return _read(path, private=False).key
    except OSError as error:
        raise BadRequestError(f"key file {path}: {error.strerror or error}") from None


def _version(status: os.stat_result) -> tuple[int, int, int]:
    return status.st_mtime_ns, status.st_ino, status.st_dev


def _read(path: Path, *, private: bool) -> KeyFile:
    """Read a key file. private: nobody but this user may have access; else a group may read it."""
    with open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NOFOLLOW * private)) as file:
        status = os.fstat(file.fileno())
        forbidden = 0o077 if private else 0o027
        if not stat.S_ISREG(status.st_mode) or status.st_mode & forbidden:
            raise BadRequestError(
                f"{path}: others have access to it: expected a file of mode 600: chmod 600 {path}"
            )
        if private and status.st_uid != os.getuid():
            raise BadRequestError(f"{path}: of another user (id {status.st_uid}): expected this user's own")
        return KeyFile(parse_key(file.read(1024).decode("ascii", "replace"), str(path)), _version(status))


def _write(path: Path, key: bytes) -> None:
    """Write a key file whole or not at all, in a folder that nobody else enters."""
    from ...schemas.process.new_file import publish, temporary_path  # imports h5py, which no client needs

    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    folder = os.stat(path.parent, follow_symlinks=False)
    if not stat.S_ISDIR(folder.st_mode) or folder.st_uid != os.getuid():
        raise PermissionError(f"{path.parent} is not this user's own folder")
    os.chmod(path.parent, 0o700)
    temporary = temporary_path(path)
    try:
        descriptor = os.open(
            temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600
        )
        with open(descriptor, "w", encoding="ascii") as file:
            file.write(key.hex() + "\n")
        publish(path)
    except OSError:
        temporary.unlink(missing_ok=True)
        raise
