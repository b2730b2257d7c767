"""Key files, in which a server stores the key of its seals for clients of the same user."""

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
from ...schemas.runtime.new_file import new_path
from .endpoints import canonical

log = logging.getLogger(__name__)

KEY_BYTES = 32
_HEX_KEY = re.compile(rf"[0-9a-fA-F]{{{2 * KEY_BYTES}}}")


class KeyFile(NamedTuple):
    """Key that was read. version: distinguishes its file from one that has replaced it."""

    key: bytes
    version: tuple[int, int, int]


def key_paths(endpoint: str) -> list[Path]:
    """Return the possible key files of a server at an endpoint. The server writes one of them.

    It takes the first that it can write. Both folders belong to the user. The file name contains
    the host's name, because several hosts may share a home folder.
    """
    name = _file_name(socket.gethostname(), endpoint)
    folders = []
    if runtime := os.environ.get("XDG_RUNTIME_DIR"):
        folders.append(Path(runtime))
    with suppress(RuntimeError):  # no home folder
        folders.append(Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"))
    return [folder / "solidcloud" / name for folder in folders]


@lru_cache(maxsize=256)
def _file_name(host: str, endpoint: str) -> str:
    """Return the name of a server's key file. Cached: each reply without a seal needs it."""
    text = f"{host} {canonical(endpoint)}"
    plain = re.sub(r"[^A-Za-z0-9.-]+", "_", text)[:80]
    return f"{plain}-{hashlib.sha256(text.encode(errors='surrogatepass')).hexdigest()[:8]}.key"


@contextmanager
def published_key(endpoint: str, key_file: Path | None) -> Iterator[bytes]:
    """Yield a server's key, and store it for the user's clients during the `with`.

    Enter it after opening the endpoint, so that the key of a running server is not overwritten.
    key_file: file with the key; None: a random key is made. Raise BadRequestError if the file is
    not usable.
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
            "no key file could be written: clients cannot distinguish this server from another program at its "
            "endpoint: give --key-file to server and clients"
        )
    try:
        yield key
    finally:
        if written is not None:
            written.unlink(missing_ok=True)


def find_key(endpoint: str, known: KeyFile | None = None, unusable: set[Any] | None = None) -> KeyFile | None:
    """Return the newest key that this user's server at an endpoint stored; None if none is usable.

    known: returned if its file is still the newest.  unusable: files found unusable before, which
    are not read again; further ones are added. A file that other users can read or write is
    ignored with a warning.
    """
    unusable = set() if unusable is None else unusable
    found = []
    for path in key_paths(endpoint):
        with suppress(OSError):
            status = os.stat(path, follow_symlinks=False)
            # The change time is included: a change of mode or owner may make a file usable.
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
    """Return the key in a file given by the user.

    Raise BadRequestError if it holds no key or all users can read it.
    """
    try:
        return _read(path, private=False).key
    except OSError as error:
        raise BadRequestError(f"key file {path}: {error.strerror or error}") from None


def _parse_key(text: str, where: str) -> bytes:
    """Return the key in a key file's text.

    where: name of the file, for messages. Raise BadRequestError for an invalid key.
    """
    found = text.strip()
    if not _HEX_KEY.fullmatch(found):
        raise BadRequestError(
            f"{where}: {len(found)} characters: expected a key of {2 * KEY_BYTES} hex digits: "
            f"make one with: (umask 077; openssl rand -hex {KEY_BYTES} > {where})"
        )
    return bytes.fromhex(found)


def _version(status: os.stat_result) -> tuple[int, int, int]:
    return status.st_mtime_ns, status.st_ino, status.st_dev


def _read(path: Path, *, private: bool) -> KeyFile:
    """Read a key file. private: only this user may have access; otherwise a group may read it."""
    with open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NOFOLLOW * private)) as file:
        status = os.fstat(file.fileno())
        forbidden = 0o077 if private else 0o027
        if not stat.S_ISREG(status.st_mode) or status.st_mode & forbidden:
            raise BadRequestError(
                f"{path}: others have access to it: expected a file of mode 600: chmod 600 {path}"
            )
        if private and status.st_uid != os.getuid():
            raise BadRequestError(
                f"{path}: owned by another user (id {status.st_uid}): expected a file of this user"
            )
        return KeyFile(_parse_key(file.read(1024).decode("ascii", "replace"), str(path)), _version(status))


def _write(path: Path, key: bytes) -> None:
    """Write a key file atomically, in a folder that only this user can enter."""
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    folder = os.stat(path.parent, follow_symlinks=False)
    if not stat.S_ISDIR(folder.st_mode) or folder.st_uid != os.getuid():
        raise PermissionError(f"{path.parent} is not this user's own folder")
    os.chmod(path.parent, 0o700)
    with new_path(path) as temporary:
        descriptor = os.open(
            temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600
        )
        with open(descriptor, "w", encoding="ascii") as file:
            file.write(key.hex() + "\n")
