"""Changes that a client receives: what is missing among them is said, and storage is bounded."""

import queue
from collections.abc import Callable, Iterator
from itertools import islice
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from solidcloud.schemas.errors import BusyError, ErrorCode, InternalError
from solidcloud.schemas.wire.encoding import encode
from solidcloud.schemas.wire.residency_messages import ResidencyChanges
from solidcloud.schemas.wire.scene_messages import ErrorReply
from solidcloud.server.zenoh_client import residency_stream
from solidcloud.server.zenoh_client.residency_stream import ResidencyStream

DEADLINE = 20.0


class FakeQuery:
    """Query in place of `StateQuery`, whose replies the test makes."""

    def __init__(self, session: Any, key: str, anchor: Any, about: Callable[[], bytes]) -> None:
        self.keys, self.told = [key], b""
        self.arrived: queue.SimpleQueue[Any] = queue.SimpleQueue()

    def open(self) -> None:
        """Begin."""

    def take(self, published: Callable[[], float]) -> Any:
        """Return the next replies; None at the end."""
        return self.arrived.get(timeout=DEADLINE)

    def move(self, key: str) -> None:
        """Note another key."""
        self.keys.append(key)

    def tell(self, payload: bytes) -> None:
        """Note what the server is told."""
        self.told = payload

    def end(self) -> None:
        """End `take`."""
        self.arrived.put(None)

    def close(self) -> None:
        """End."""


@pytest.fixture
def connection() -> SimpleNamespace:
    """Return what a stream needs of a connection."""
    return SimpleNamespace(session=None, anchor=None, client_id="c1")


@pytest.fixture
def stream(connection: SimpleNamespace, monkeypatch: pytest.MonkeyPatch) -> Iterator[ResidencyStream]:
    """Return an open stream with a fake query."""
    monkeypatch.setattr(residency_stream, "StateQuery", FakeQuery)
    with ResidencyStream(connection, "hall") as stream:
        yield stream


def reply(seq: int, lost: bool = False) -> tuple[bool, bytes]:
    """Return a reply without changes."""
    none = np.empty(0, np.uint16), np.empty((0, 3), np.int32), np.empty(0, np.uint8)
    return True, encode(ResidencyChanges(seq, lost, *none))


def put(stream: ResidencyStream, *replies: Any) -> None:
    """Make replies arrive."""
    stream._query.arrived.put(list(replies))


def taken(stream: ResidencyStream, count: int) -> list[tuple[int, bool]]:
    """Return `seq` and `lost` of the next messages."""
    return [(message.seq, message.lost) for message in islice(stream.changes(DEADLINE), count)]


def test_gaps_are_said_to_be_lost(stream: ResidencyStream) -> None:
    put(stream, reply(7), reply(8), reply(10), reply(11), reply(11), reply(3, lost=True), reply(4))
    assert taken(stream, 7) == [
        (7, True), (8, False), (10, True), (11, False), (11, True), (3, True), (4, False)
    ]  # fmt: skip


def test_an_error_stands_at_its_place(stream: ResidencyStream) -> None:
    put(stream, reply(1), (False, encode(ErrorReply(ErrorCode.BUSY, "full"))), reply(2), (True, b"x"))
    changes = stream.changes(DEADLINE)
    assert next(changes).seq == 1
    with pytest.raises(BusyError, match="full"):
        next(changes)
    assert taken(stream, 1) == [(2, True)]
    with pytest.raises(InternalError):
        taken(stream, 1)


def test_messages_that_nobody_takes_are_bounded(
    stream: ResidencyStream, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(residency_stream, "_MAX_MESSAGES", 4)
    put(stream, *(reply(seq) for seq in range(1, 11)))
    with stream._changed:
        assert stream._changed.wait_for(lambda: stream._last == 10, DEADLINE)
    assert taken(stream, 2) == [(9, True), (10, False)]


def test_a_new_id_is_followed(stream: ResidencyStream, connection: SimpleNamespace) -> None:
    connection.client_id = "c2"
    put(stream, reply(1))
    assert taken(stream, 1) == [(1, True)]
    put(stream, reply(2))
    taken(stream, 1)
    assert stream._query.keys == ["solidcloud/1/residency/hall/c1", "solidcloud/1/residency/hall/c2"]


def test_the_server_is_told_of_the_end(stream: ResidencyStream) -> None:
    stream.close()
    stream.close()
    assert stream._query.told and list(stream.changes(DEADLINE)) == []


def test_silence_ends_the_messages(stream: ResidencyStream) -> None:
    assert list(stream.changes(0.01)) == []
