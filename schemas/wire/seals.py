"""Seals: keyed hashes that prove that a reply is the server's, to the client's own request.

A seal also proves that the reply is about the client's own avatars. A client sends a nonce with its
query. Whoever has the server's key can hash nonce, key expression and request together with the
reply and the avatars that it is about; nobody else can. WIRE.md ("Seals") has the layout and a
worked example.
"""

import hashlib
import hmac
import re
import struct

import numpy as np
from numpy.typing import NDArray

from ..errors import BadRequestError

KEY_BYTES = 32
NONCE_BYTES = 16
_HASH_BYTES = 32
# A seal holds the number of the reply among the replies to its query, the SHA-256 of the digests of
# its avatars, and the keyed hash.
_NUMBER = struct.Struct("<Q")
_ABOUT = slice(_NUMBER.size, _NUMBER.size + _HASH_BYTES)
SEAL_BYTES = _ABOUT.stop + _HASH_BYTES
_REPLY = struct.Struct("<QBQ")
_RADIUS = struct.Struct("<d")

_HEX_KEY = re.compile(rf"[0-9a-fA-F]{{{2 * KEY_BYTES}}}")


class Sealer:
    """Seals of the replies to one query: a server makes them, a client checks them."""

    __slots__ = ("_begun", "_key", "_name")

    def __init__(self, key: bytes, nonce: bytes, key_expression: str, request: bytes) -> None:
        """Store the parameters of one query.

        key: the server's, KEY_BYTES.  nonce: the query's, NONCE_BYTES.
        request: SHA-256 of the query's payload.
        """
        self._key, self._name = key, key_expression.encode()
        self._begun = nonce + request

    def seal(self, number: int, ok: bool, encoding: str, payload: bytes, about: bytes = b"") -> bytes:
        """Return the seal of a reply, SEAL_BYTES.

        number: of the reply among the replies to its query, counted from 0.  ok: it is not an
        error.
        about: the digests of the client's own avatars that answered (`avatar_digest`), in the
        request's order, concatenated.
        """
        hashed = hash_of(about)
        return _NUMBER.pack(number) + hashed + self._hash(number, ok, encoding, payload, hashed)

    def number_of(self, seal: bytes, ok: bool, encoding: str, payload: bytes) -> int:
        """Return the number in a seal; -1 if the seal is not that of this reply."""
        if len(seal) != SEAL_BYTES:
            return -1
        number: int = _NUMBER.unpack_from(seal)[0]
        expected = self._hash(number, ok, encoding, payload, seal[_ABOUT])
        return number if hmac.compare_digest(seal[_ABOUT.stop :], expected) else -1

    def _hash(self, number: int, ok: bool, encoding: str, payload: bytes, about: bytes) -> bytes:
        """Hash one reply.

        about: SHA-256 of the digests of its avatars.
        """
        text = b"".join(
            (
                self._begun,
                _REPLY.pack(number, ok, len(self._name)),
                self._name,
                hash_of(payload),
                about,
                encoding.encode(),
            )
        )
        return hashlib.blake2b(text, key=self._key, digest_size=_HASH_BYTES).digest()


def is_about(seal: bytes, about: bytes) -> bool:
    """Return True if a seal of the right length names these avatars.

    about: as in `Sealer.seal`.
    """
    return seal[_ABOUT] == hash_of(about)


def avatar_digest(points: NDArray[np.float64], radius: float) -> bytes:
    """Return the SHA-256 that identifies an avatar by its content.

    points: (n, 3) [m].  radius: of each point's sphere [m].
    The hash covers the points, row by row, and the radius, each number as a little-endian float64;
    -0.0 counts as 0.0.
    """
    found = hashlib.sha256(np.asarray(points + 0.0, "<f8").tobytes())
    found.update(_RADIUS.pack(radius + 0.0))
    return found.digest()


def hash_of(payload: bytes) -> bytes:
    """Return the SHA-256 of a payload.

    It is twice as fast as BLAKE2b on processors that have instructions for it.
    """
    return hashlib.sha256(payload).digest()


def parse_key(text: str, where: str) -> bytes:
    """Return the key in a key file's text.

    where: the file, for the BadRequestError that says what is wrong with the key.
    """
    found = text.strip()
    if not _HEX_KEY.fullmatch(found):
        raise BadRequestError(
            f"{where}: {len(found)} characters: expected a key of {2 * KEY_BYTES} hex digits: "
            f"make one with: (umask 077; openssl rand -hex {KEY_BYTES} > {where})"
        )
    return bytes.fromhex(found)
