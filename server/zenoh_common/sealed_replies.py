"""Sealed replies: keyed hashes that prove that the server sent a reply, and to which request.

WIRE.md, "Seals", has the layout of a seal and a worked example. A client sends a nonce with its
query. The seal is a hash of nonce, key expression, request, reply and the avatars that the reply is
about, under the server's key, which only the server and the user's clients know. The server seals
its replies with `sealer_of` and `send_reply`; a client checks them with `SealedQuery`.
"""

import hashlib
import hmac
import logging
import os
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import zenoh

from ...schemas.errors import UnknownAvatarError
from ...schemas.wire.encoding import JSON, MSGPACK
from ..scene_interface import EncodedReply
from .key_files import KeyFile, find_key, read_given_key

log = logging.getLogger(__name__)

_ENCODINGS = {name: zenoh.Encoding(name) for name in (MSGPACK, JSON)}

NONCE_BYTES = 16
_HASH_BYTES = 32
# A seal holds the number of the reply among the replies to its query, the SHA-256 of the digests of
# its avatars, and the keyed hash.
_NUMBER = struct.Struct("<Q")
_ABOUT = slice(_NUMBER.size, _NUMBER.size + _HASH_BYTES)
SEAL_BYTES = _ABOUT.stop + _HASH_BYTES
_REPLY = struct.Struct("<QBQ")


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

        number: of the reply among the replies to its query, counted from 0.
        ok: whether the reply is an answer and not an error.
        about: concatenated digests (`avatar_digest`) of the client's avatars that the answer used,
        in the request's order.
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


def hash_of(payload: bytes) -> bytes:
    """Return the SHA-256 of a payload.

    It is twice as fast as BLAKE2b on processors that have instructions for it.
    """
    return hashlib.sha256(payload).digest()


def encoding_of(query: zenoh.Query) -> str | None:
    """Return the encoding that a query states, if any."""
    return None if query.encoding is None else str(query.encoding)


def sealer_of(query: zenoh.Query, key: bytes, key_expression: str, request: bytes) -> Sealer | None:
    """Return the sealer of the replies to a query; None if the query has no nonce.

    key: the server's.  request: the query's payload.
    """
    attachment = query.attachment
    if attachment is None or len(nonce := attachment.to_bytes()) != NONCE_BYTES:
        return None
    return Sealer(key, nonce, key_expression, hash_of(request))


def send_reply(
    query: zenoh.Query, key: Any, answer: EncodedReply, sealer: Sealer | None = None, number: int = 0
) -> bool:
    """Send one answer; log and return False if the client or its link no longer exists.

    number: of the replies to this query, increasing.
    """
    payload, encoding, ok, about = answer
    seal = None if sealer is None else sealer.seal(number, ok, encoding, payload, about)
    try:
        if ok:
            query.reply(key, payload, encoding=_ENCODINGS[encoding], attachment=seal)
        elif seal is None:
            query.reply_err(payload, encoding=_ENCODINGS[encoding])
        else:
            # zenoh's error replies have no attachment.
            query.reply_err(payload, encoding=f"{encoding};{seal.hex()}")
    except zenoh.ZError as error:
        log.warning("reply to %s: %s", query.key_expr, error)
        return False
    return True


class OtherAvatarError(UnknownAvatarError):
    """Reply about an avatar that the client did not add: another program uses the client's id.

    key_expression: of the query, with the id.
    """

    def __init__(self, key_expression: str) -> None:
        super().__init__("the server answered about another avatar of this name than the one that was added")
        self.key_expression = key_expression


def _no_avatars() -> bytes:
    """Return the joined digests of no avatars."""
    return b""


class TrustAnchor:
    """Trust anchor of one client: the key that the seals of its server's replies need.

    The key is given, or found in the user's key files. With a key, replies without a valid seal are
    ignored. Only the file can replace the key: a restarted server stores a new one there. Without a
    key, all replies are accepted, with one warning. Thread-safe: assignments are atomic.
    """

    def __init__(self, endpoint: str, key_file: Path | str | None = None) -> None:
        """Read or find the key.

        key_file: file with the key; None: search the user's key files. Raise BadRequestError if the
        given file contains no key.
        """
        self._endpoint = endpoint
        self._given = None if key_file is None else Path(key_file)
        self._known: KeyFile | None = None
        self._said: set[str] = set()
        self._unusable: set[Any] = set()  # key files
        if self._given is None:
            self._known = find_key(endpoint, None, self._unusable)
        else:
            self._known = KeyFile(read_given_key(self._given), (0, 0, 0))

    @property
    def key(self) -> bytes | None:
        """Return the key; None if there is none yet."""
        return None if self._known is None else self._known.key

    def look_again(self) -> bytes | None:
        """Return the key after rereading its file, where a new server may have stored another."""
        if self._given is None:
            self._known = find_key(self._endpoint, self._known, self._unusable) or self._known
        return self.key

    def unsealed(self) -> None:
        """Warn once that unauthenticated replies are accepted."""
        if "unsealed" not in self._said:
            self._said.add("unsealed")
            log.warning(
                "no key of the server at %s: its replies are accepted unchecked; give its --key-file to distinguish it "
                "from another program at that endpoint",
                self._endpoint,
            )

    def refused(self, key_expression: str) -> None:
        """Warn once that a reply is ignored."""
        if "refused" not in self._said:
            self._said.add("refused")
            log.warning(
                "ignored a reply to %s at %s: it is not sealed with the server's key: another program may be there, "
                "or the server was started with another --key-file",
                key_expression.rpartition("/")[2],
                self._endpoint,
            )


class SealedQuery:
    """Query of a client, and reader of its replies."""

    __slots__ = (
        "_about",
        "_anchor",
        "_hash",
        "_key",
        "_key_expression",
        "_last",
        "_request",
        "_sealer",
        "nonce",
    )

    def __init__(
        self,
        anchor: TrustAnchor,
        key_expression: str,
        request: bytes = b"",
        about: Callable[[], bytes | None] = _no_avatars,
    ) -> None:
        """Make a nonce, which the caller sends as the query's attachment.

        about: returns the joined digests of the avatars that this client added and that the query
        names; None if the client does not know one of them. With a key, a reply about other avatars
        is rejected.
        """
        self._anchor, self._key_expression, self._request = anchor, key_expression, request
        self._about = about
        self.nonce = os.urandom(NONCE_BYTES)
        self._hash: bytes | None = None  # of the request
        self._key: bytes | None = None  # of `_sealer`
        self._sealer: Sealer | None = None
        self._last = -1  # number of the last reply

    def sent(self) -> None:
        """Hash the request after it was sent: the server hashes a large one at the same time."""
        self._hash = hash_of(self._request)

    def read(self, reply: zenoh.Reply) -> tuple[bool, bytes] | None:
        """Return (whether a reply is an answer, its bytes); None if the server did not send it.

        A reply that is not an answer is an error. The server replies only under the exact key of
        the query, never under a wider one. Raise OtherAvatarError for a sealed reply about other
        avatars; an error reply may also name no avatars.
        """
        sample: Any = reply.ok
        if sample is None:
            error: Any = reply.err
            encoding, _, said = str(error.encoding).partition(";")
            payload: bytes = error.payload.to_bytes()
            if encoding != MSGPACK:
                log.debug(
                    "no answer to %s: %s", self._key_expression, payload[:200]
                )  # zenoh's own, such as "Timeout"
                return None
            seal = _unhexed(said)
        else:
            encoding, payload = str(sample.encoding), sample.payload.to_bytes()
            under = str(sample.key_expr)
            if under != self._key_expression or sample.kind != zenoh.SampleKind.PUT or encoding != MSGPACK:
                log.debug("ignored a reply to %s under %s, %s", self._key_expression, under, encoding)
                return None
            attachment = sample.attachment
            seal = b"" if attachment is None else attachment.to_bytes()
        ok = sample is not None
        if not self._has_key_and_seal(seal, ok, encoding, payload):
            if self._anchor.key is not None:
                self._anchor.refused(self._key_expression)
                return None
            self._anchor.unsealed()
        elif not self._is_about_ours(seal, ok):
            raise OtherAvatarError(self._key_expression)
        return ok, payload

    def _has_key_and_seal(self, seal: bytes, ok: bool, encoding: str, payload: bytes) -> bool:
        """Return whether a key exists and the reply has its seal; reread the key if not."""
        key = self._anchor.key
        if key is not None and self._is_sealed(key, seal, ok, encoding, payload):
            return True
        fresh = self._anchor.look_again()
        return fresh is not None and fresh != key and self._is_sealed(fresh, seal, ok, encoding, payload)

    def _is_about_ours(self, seal: bytes, ok: bool) -> bool:
        """Return whether a sealed reply names the client's avatars; an error may name none."""
        about = self._about()
        return (about is not None and is_about(seal, about)) or (not ok and is_about(seal, b""))

    def _is_sealed(self, key: bytes, seal: bytes, ok: bool, encoding: str, payload: bytes) -> bool:
        """Return whether a reply has a valid seal and does not repeat an earlier reply."""
        if self._sealer is None or key is not self._key:
            if self._hash is None:
                self.sent()
            self._key, self._sealer = key, Sealer(key, self.nonce, self._key_expression, self._hash or b"")
        number = self._sealer.number_of(seal, ok, encoding, payload)
        if number <= self._last:
            return False
        self._last = number
        return True


def _unhexed(text: str) -> bytes:
    """Return the bytes of hex digits; b"" if the text is not hexadecimal."""
    try:
        return bytes.fromhex(text)
    except ValueError:
        return b""
