"""Seals: keyed hashes by which a client knows that a reply is its server's, and to its own question.

A client sends a nonce with its query. Whoever has the server's key can hash nonce, key expression and request together
with the reply; nobody else can. WIRE.md ("Seals") has the layout and a worked example.
"""

import hashlib
import hmac
import re
import struct

from .errors import BadRequestError

KEY_BYTES = 32
NONCE_BYTES = 16
_HASH_BYTES = 32
# In a reply: which of the replies to its query it is, and the hash.
_NUMBER = struct.Struct("<Q")
SEAL_BYTES = _NUMBER.size + _HASH_BYTES
_REPLY = struct.Struct("<QBQ")

_HEX_KEY = re.compile(rf"[0-9a-fA-F]{{{2 * KEY_BYTES}}}")


class Sealer:
    """The seals of the replies to one query."""

    __slots__ = ("_begun", "_key", "_name")

    def __init__(self, key: bytes, nonce: bytes, key_expression: str, request: bytes) -> None:
        """key: the server's, KEY_BYTES.  nonce: the query's, NONCE_BYTES.  request: SHA-256 of the query's payload."""
        self._key, self._name = key, key_expression.encode()
        self._begun = nonce + request

    def seal(self, number: int, ok: bool, encoding: str, payload: bytes) -> bytes:
        """Return the seal of a reply, SEAL_BYTES. number: of the replies to its query, from 0 on.  ok: no error."""
        return _NUMBER.pack(number) + self._hash(number, ok, encoding, payload)

    def number_of(self, seal: bytes, ok: bool, encoding: str, payload: bytes) -> int:
        """Return the number in a seal; -1 where the seal is not that of this reply."""
        if len(seal) != SEAL_BYTES:
            return -1
        number: int = _NUMBER.unpack_from(seal)[0]
        right = hmac.compare_digest(seal[_NUMBER.size :], self._hash(number, ok, encoding, payload))
        return number if right else -1

    def _hash(self, number: int, ok: bool, encoding: str, payload: bytes) -> bytes:
        """Hash one reply."""
        text = b"".join(
            (
                self._begun,
                _REPLY.pack(number, ok, len(self._name)),
                self._name,
                hash_of(payload),
                encoding.encode(),
            )
        )
        return hashlib.blake2b(text, key=self._key, digest_size=_HASH_BYTES).digest()


def hash_of(payload: bytes) -> bytes:
    """Return the SHA-256 of a payload: twice as fast as BLAKE2b where processors have instructions for it."""
    return hashlib.sha256(payload).digest()


def parse_key(text: str, where: str) -> bytes:
    """Return the key that a key file holds; BadRequestError says what is wrong with it. where: the file."""
    found = text.strip()
    if not _HEX_KEY.fullmatch(found):
        raise BadRequestError(
            f"{where}: {len(found)} characters: expected a key of {2 * KEY_BYTES} hex digits: "
            f"make one with: (umask 077; openssl rand -hex {KEY_BYTES} > {where})"
        )
    return bytes.fromhex(found)
