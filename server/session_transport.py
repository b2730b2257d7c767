"""Sessions over zenoh, the server's side: wishes that clients publish, and states that are published to them.

zenoh hands wishes to a bounded channel that a thread of ours empties into mailboxes at once; another simulates frames
and publishes (frames.py). A state is dropped where a client takes none, and never waits for one.
"""

import logging
from collections.abc import Callable
from typing import Any, Protocol

import zenoh

from ..schemas import keys
from ..schemas.encoding import JSON, MSGPACK
from ..schemas.errors import BadRequestError
from .frames import Frames
from .served import Answer

log = logging.getLogger(__name__)

# Wishes that zenoh may hand over before the thread takes them: of a thousand users one each.
_CHANNEL = 1024

_ENCODINGS = {name: zenoh.Encoding(name) for name in (MSGPACK, JSON)}

# How wishes and states travel. Not at the priority of replies: what is dropped where there is no room would wait
# behind a reply that blocks (zenoh's issue 2584). Express: a frame's states are not kept back to fill a batch.
FRAME_QOS: dict[str, Any] = {
    "congestion_control": zenoh.CongestionControl.DROP,
    "priority": zenoh.Priority.INTERACTIVE_HIGH,
    "express": True,
}


class Sessions(Protocol):
    """What has the frames of a scene simulated."""

    def frames(self, scene: str, publish: Callable[[keys.User, Answer], None]) -> Frames | None: ...


def declare_sessions(
    session: zenoh.Session, scene: str, service: Sessions, start: Callable[..., None]
) -> list[Any]:
    """Carry the sessions of a scene; returns what is to be undeclared at the end: then its threads end too.

    start: starts a thread of a name, that runs a function with arguments.
    """

    def publish(user: keys.User, answer: Answer) -> None:
        key = (keys.state_key if answer.ok else keys.refused_key)(scene, user)
        session.put(key, answer.payload, encoding=_ENCODINGS[answer.encoding], **FRAME_QOS)

    frames = service.frames(scene, publish)
    if frames is None:
        return []
    subscriber = session.declare_subscriber(keys.wishes_key(scene), zenoh.handlers.FifoChannel(_CHANNEL))
    start(f"{scene}-wishes", _take, subscriber.handler, frames)
    start(f"{scene}-frames", frames.run)
    return [subscriber]


def _take(samples: Any, frames: Frames) -> None:
    """One thread's work: take wishes in until there are no more, then end the frames."""
    try:
        for sample in samples:
            try:
                _take_one(sample, frames)
            except Exception:  # of this wish alone
                log.exception("a wish")
    finally:
        frames.close()


def _take_one(sample: zenoh.Sample, frames: Frames) -> None:
    """Take in one wish, or that a user leaves."""
    try:
        user = keys.parse_wish(str(sample.key_expr))
    except BadRequestError as error:
        log.debug("a wish of nobody: %s", error)
        return
    if sample.kind == zenoh.SampleKind.DELETE:
        frames.leave(user)
    else:
        frames.wish(user, sample.payload.to_bytes(), str(sample.encoding))
