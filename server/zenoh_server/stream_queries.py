"""Queries that open a stream of replies: for the states of a user, and for changes of residency."""

import logging
from collections.abc import Callable, Iterable
from typing import TypeVar

import zenoh

from ...schemas.errors import BadRequestError
from ..scene_interface import EncodedReply
from ..zenoh_common.sealed_replies import Sealer, sealer_of, send_reply

log = logging.getLogger(__name__)

Owner = TypeVar("Owner")


def take_queries(
    queries: Iterable[zenoh.Query],
    subject: str,
    parse: Callable[[str], Owner],
    open_stream: Callable[[Owner, zenoh.Query], None],
) -> None:
    """Open a stream for each query of a channel until it ends. Runs in a thread.

    parse: returns the client or user of a key expression. End a query of none without a reply.
    """
    for query in queries:
        try:
            try:
                owner = parse(str(query.key_expr))
            except BadRequestError as error:
                log.debug("a query for %s of no client: %s", subject, error)
                query.drop()
            else:
                open_stream(owner, query)
        except Exception:  # affects this query only
            log.exception("a query for %s failed", subject)


def content_and_sealer(query: zenoh.Query, server_key: bytes) -> tuple[bytes, Sealer | None]:
    """Return the payload of a query, and the sealer of its replies."""
    content = b"" if query.payload is None else query.payload.to_bytes()
    return content, sealer_of(query, server_key, str(query.key_expr), content)


def refuse(query: zenoh.Query, answer: EncodedReply, sealer: Sealer | None) -> None:
    """Answer a query with an error, and end it."""
    with query:
        send_reply(query, query.key_expr, answer, sealer)
