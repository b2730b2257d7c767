"""Replies to zenoh queries: sending an answer as one, and reading one."""

import logging
from typing import Any

import zenoh

from ..schemas.encoding import JSON, MSGPACK
from .served import Answer

log = logging.getLogger(__name__)

_ENCODINGS = {name: zenoh.Encoding(name) for name in (MSGPACK, JSON)}


def send_reply(query: zenoh.Query, key: Any, answer: Answer) -> bool:
    """Send one answer; return False where the client or its link is gone, which is logged."""
    try:
        if answer.ok:
            query.reply(key, answer.payload, encoding=_ENCODINGS[answer.encoding])
        else:
            query.reply_err(answer.payload, encoding=_ENCODINGS[answer.encoding])
    except zenoh.ZError as error:
        log.warning("reply to %s: %s", query.key_expr, error)
        return False
    return True


def read_reply(reply: zenoh.Reply, key: str) -> tuple[bool, bytes] | None:
    """Return whether a reply is an answer or an error, and its bytes; None where it is not a server's.

    key: the key that was asked. A reply under any other, a wider one included, is ignored.
    """
    sample = reply.ok
    if sample is None:
        error: Any = reply.err
        if str(error.encoding).split(";", 1)[0] == MSGPACK:
            return False, error.payload.to_bytes()
        log.debug(
            "no answer to %s: %s", key, error.payload.to_bytes()[:200]
        )  # zenoh's own, such as "Timeout"
        return None
    if str(sample.key_expr) != key or sample.kind != zenoh.SampleKind.PUT or str(sample.encoding) != MSGPACK:
        log.debug(
            "ignored a reply to %s under %s, %s, %s", key, sample.key_expr, sample.kind, sample.encoding
        )
        return None
    return True, sample.payload.to_bytes()
