"""Test that no error of its work ends a browser's thread."""

import json
import logging
from types import SimpleNamespace
from typing import Any

import pytest
from solidcloud.schemas.errors import BadRequestError, BusyError
from solidcloud.server.viewer.browser import Browser
from solidcloud.server.viewer.feeds.scene_link import LinkStatus
from solidcloud.server.viewer.viewer_parts import Users


class Page:
    """Page that keeps what it is sent."""

    def __init__(self) -> None:
        self.problems: list[str] = []

    def send(self, message: str | bytes) -> None:
        fields = json.loads(message)
        assert fields["type"] == "problem"
        self.problems.append(fields["message"])

    def is_open(self) -> bool:
        return True


def browser_of(page: Page, state: str) -> Browser:
    """Return a browser whose server is in a state."""
    parts: Any = SimpleNamespace(
        users=Users(), avatar=None, link=SimpleNamespace(status=LinkStatus(1, state, "")), path=None
    )
    return Browser(page, parts)  # type: ignore[arg-type]


def failing(error: Exception) -> Any:
    """Return work that fails."""

    def work() -> None:
        raise error

    return work


def test_refusals_are_shown_and_a_busy_server_only_while_it_is_connected() -> None:
    page = Page()
    browser = browser_of(page, "connected")
    browser._attempt(failing(BadRequestError("too far")))
    browser._attempt(failing(BusyError("full")))
    browser._attempt(failing(BusyError("full")), again=True)
    browser_of(page, "lost")._attempt(failing(BusyError("full")))
    assert page.problems == ["too far", "full"]


def test_an_error_of_the_viewer_is_shown_and_logged(caplog: pytest.LogCaptureFixture) -> None:
    page, done = Page(), []
    browser = browser_of(page, "connected")
    with caplog.at_level(logging.ERROR):
        browser._attempt(failing(ValueError("no such axis")))
    browser._attempt(lambda: done.append(1))
    assert page.problems == ["The viewer failed at something: its log says at what."] and done == [1]
    assert "no such axis" in caplog.text
