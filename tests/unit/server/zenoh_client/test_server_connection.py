"""The connection of a client whose server accepts no farewell."""

from typing import Any

import pytest
import zenoh
from solidcloud.schemas.errors import BusyError
from solidcloud.server.zenoh_client import server_connection
from solidcloud.server.zenoh_client.server_connection import scenes_at

OPEN = zenoh.open


class Unheard:
    """Session whose close ends as it does beside a frozen server."""

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session

    def __getattr__(self, name: str) -> Any:
        return getattr(self._session, name)

    def close(self) -> None:
        self._session.close()
        raise zenoh.ZError("close operation timed out! at /zenoh/src/close.rs:135.")


def test_a_farewell_that_nobody_accepts_hides_no_answer(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(server_connection.zenoh, "open", lambda config: Unheard(OPEN(config)))
    with pytest.raises(BusyError, match="no server answered"):
        scenes_at("tcp/127.0.0.1:1", timeout=0.2)
    assert "close operation timed out" in caplog.text and ".rs" not in caplog.text
