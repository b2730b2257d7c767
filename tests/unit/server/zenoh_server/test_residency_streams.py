"""Test that changes of residency go on after an error."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from solidcloud.schemas.wire.encoding import MSGPACK, decode_answer
from solidcloud.schemas.wire.key_expressions import User
from solidcloud.schemas.wire.residency_messages import ResidencyChanges
from solidcloud.server.zenoh_server import residency_streams
from solidcloud.server.zenoh_server.residency_streams import ResidencyStreams

USER = User("one", "")


class Watch:
    """Changes of a scene, of which the second ones cannot be read."""

    taken = 0

    def take(self, always: bool) -> ResidencyChanges:
        self.taken += 1
        if self.taken == 2:
            raise ZeroDivisionError("broken changes")
        nothing = np.zeros(0, np.uint16), np.zeros((0, 3), np.int32), np.zeros(0, np.uint8)
        return ResidencyChanges(self.taken, False, *nothing)

    def close(self) -> None:
        pass


def test_changes_go_on_after_an_error_and_say_what_is_lost(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Issue 35: the thread of the changes ended for good at the first error that is not ours."""
    monkeypatch.setattr(residency_streams, "CHANGES_SECONDS", 0.0)
    sent: list[ResidencyChanges] = []
    session: Any = SimpleNamespace(declare_queryable=lambda *_, **__: SimpleNamespace(handler=()))
    dispatcher: Any = SimpleNamespace(watch=lambda _: Watch())
    streams = ResidencyStreams(session, "hall", dispatcher, lambda *_: None, b"", str)

    def send(user: User, reply: Any) -> None:
        sent.append(decode_answer(ResidencyChanges, reply.payload, MSGPACK))
        if len(sent) == 3:
            streams._closed.set()

    streams._streams = cast(Any, SimpleNamespace(users=lambda: {USER}, send=send, close=lambda: None))
    streams._new[USER] = MSGPACK
    streams._wake.set()
    streams._run()
    assert [(each.seq, each.lost) for each in sent] == [(1, True), (3, True), (4, False)]
    assert "broken changes" in caplog.text
