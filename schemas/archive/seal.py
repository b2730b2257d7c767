"""Seals: an archive's index authenticated with a secret key, and digests of its records in the index.

A checksum shows that bytes changed by accident. A seal shows that nobody changed them who does not
have the key: an HMAC over the index, in a file beside it, and in the index a digest of each record,
which is compared when the record is read. An archive is sealed by builder/edit/seal_archive.py; a
reader without the key reads it as any other.

FORMAT.md, "Seals", documents the same; change both together.
"""

import hashlib
import hmac
import os
import secrets
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import BadRequestError, FormatError
from ..process.new_file import sync_path

# File beside the index.
SEAL_NAME = "index.hmac"
SEAL_BYTES = 32
# Least and most bytes of a key file. HMAC gains nothing from more bytes than the hash's.
MIN_KEY_BYTES, MAX_KEY_BYTES = 32, 4096
# Bytes of a digest: half a SHA-256. To find other bytes with the same digest takes 2^128 trials.
DIGEST_BYTES = 16
# Begins what is authenticated, so that a seal means nothing in another use of the key.
_DOMAIN = b"solidcloud seal 1"


def record_digests(cells: bytes, nodes: bytes, points: bytes) -> NDArray[np.uint8]:
    """Return the digests (2, DIGEST_BYTES) of a record: of its hierarchy, and of its points."""
    return np.stack([frames_digest((cells, nodes)), frames_digest((points,))])


def frames_digest(frames: Sequence[bytes]) -> NDArray[np.uint8]:
    """Return the digest (DIGEST_BYTES,) of some frames, one after the other."""
    digest = hashlib.sha256()
    for frame in frames:
        digest.update(frame)
    return np.frombuffer(digest.digest()[:DIGEST_BYTES], np.uint8)


def make_seal(key: bytes, version: int, index_digest: bytes) -> bytes:
    """Return the content of SEAL_NAME for an index of this format version and checksum."""
    return hmac.digest(key, _DOMAIN + version.to_bytes(4, "little") + index_digest, "sha256")


def check_seal(folder: Path, key: bytes, version: int, index_digest: bytes, *, has_digests: bool) -> None:
    """Check the seal of an index that was read from `folder`.

    index_digest: computed from what was read.  has_digests: whether the index has digests of records.
    Raise FormatError if there is no seal, or if it was not made of this index with this key.
    """
    path = folder / SEAL_NAME
    seal = b""
    with suppress(FileNotFoundError), path.open("rb") as file:
        seal = file.read(SEAL_BYTES + 1)
    if not seal:
        raise FormatError(
            f"{path}: not found, expected the seal of the archive: seal it with `solidcloud seal`, after "
            "`solidcloud add`, `remove` and `level` again"
        )
    if not hmac.compare_digest(seal, make_seal(key, version, index_digest)) or not has_digests:
        raise FormatError(
            f"{path}: not the seal of this index with this key: the archive was changed, or sealed with another "
            "key: fetch it again, or give its key"
        )


def read_archive_key(path: Path) -> bytes:
    """Return the key in a file. Raise BadRequestError if it holds none."""
    try:
        with path.open("rb") as file:
            key = file.read(MAX_KEY_BYTES + 1)
    except OSError as error:
        raise BadRequestError(f"{path}: {error.strerror}: expected a file with the key of archives") from None
    if not MIN_KEY_BYTES <= len(key) <= MAX_KEY_BYTES:
        found = f"over {MAX_KEY_BYTES}" if len(key) > MAX_KEY_BYTES else str(len(key))
        raise BadRequestError(
            f"{path}: {found} bytes, expected {MIN_KEY_BYTES} to {MAX_KEY_BYTES} random bytes: make a key with "
            "`solidcloud seal --new-key FILE`"
        )
    return key


def write_new_key(path: Path) -> None:
    """Write a random key to a new file that only its owner can read.

    Raise BadRequestError if the file exists.
    """
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
    except FileExistsError:
        raise BadRequestError(f"{path}: exists, expected a new file: give another name") from None
    try:
        with open(descriptor, "wb") as file:
            os.fchmod(descriptor, 0o600)  # whatever the umask leaves of it
            file.write(secrets.token_bytes(MIN_KEY_BYTES))
            file.flush()
            os.fsync(descriptor)
    except BaseException:
        path.unlink(missing_ok=True)
        raise
    sync_path(path.parent)
