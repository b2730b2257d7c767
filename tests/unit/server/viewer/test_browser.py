"""Test that no error of its work ends a browser's thread, or leaves its page without what it waits for."""

import json
import logging
import threading
from types import SimpleNamespace
from typing import Any, cast

import pytest
from solidcloud.schemas.errors import BadRequestError, BusyError
from solidcloud.server.runtime import threads
from solidcloud.server.viewer.browser import Browser
from solidcloud.server.viewer.clash_session import ClashSession
from solidcloud.server.viewer.feeds.scene_link import LinkStatus
from solidcloud.server.viewer.page.page_messages import FAILED, Around, PathText
from solidcloud.server.viewer.viewer_parts import Users


class Page:
    """Page that keeps what it is sent."""

    def __init__(self) -> None:
        self.problems: list[str] = []
        self.sent: list[bytes] = []

    def send(self, message: str | bytes) -> None:
        if isinstance(message, bytes):
            self.sent.append(message)
            return
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


@pytest.mark.parametrize("what", ["overview", "voxels"])
def test_what_the_page_waits_for_is_asked_for_again_until_the_server_answers(what: str) -> None:
    page, scene, around = Page(), cast(Any, object()), Around((0.0, 0.0, 0.0))
    browser = browser_of(page, "connected")
    answers: list[bytes | Exception] = [BusyError("no answer within 5 s"), BusyError("no answer"), b"answer"]

    def answer(_: object) -> bytes:
        content = answers.pop(0)
        if isinstance(content, Exception):
            raise content
        browser._closed.set()
        return content

    browser._parts = cast(Any, SimpleNamespace(tiles=SimpleNamespace(**{what: answer})))
    if what == "overview":
        browser._overview = scene
    else:
        browser._around = around
    thread = threading.Thread(target=browser._send_tiles, daemon=True)
    thread.start()
    thread.join(30)
    assert not thread.is_alive()
    assert page.sent == [b"answer"]


def test_tile_that_fails_is_named_and_the_next_one_is_sent(caplog: pytest.LogCaptureFixture) -> None:
    """Issue 35: the tiles' thread ended for good at the first error that is not ours."""
    page, told = Page(), []
    browser = browser_of(page, "connected")
    page.send = lambda message: told.append(message)  # type: ignore[method-assign]

    def tile(key: tuple[int, ...]) -> bytes:
        if key[0] == 0:
            raise ValueError("broken tile")
        browser._closed.set()
        return b"tile"

    browser._parts = cast(Any, SimpleNamespace(tiles=SimpleNamespace(tile=tile)))
    browser._wanted = [(0, 0, 0, 0, 0), (1, 0, 0, 0, 0)]
    browser._send_tiles()
    missing = json.loads(told[0])
    assert (missing["type"], missing["key"], missing["again"]) == ("missing", [0, 0, 0, 0], False)
    assert told[1:] == [b"tile"]
    assert "broken tile" in caplog.text


def test_clash_check_reports_an_error_and_checks_the_next_path(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Issue 35: the check's thread ended for good at the first error that is not ours."""
    monkeypatch.setattr(threads, "PAUSE", 0.0)
    told: list[dict[str, Any]] = []
    heard = threading.Event()

    class Link:
        """Link to a server that fails once, and then has no server."""

        asked = 0

        @property
        def scene(self) -> None:
            self.asked += 1
            if self.asked == 1:
                raise ZeroDivisionError("broken check")

    def send(message: str | bytes) -> None:
        told.append(json.loads(message))
        heard.set()

    session = ClashSession(1, cast(Any, SimpleNamespace(link=Link(), path=None)), send)
    try:
        for number in (1, 2):
            heard.clear()
            session.take(PathText(f"{number}.csv", "t,x,y,z,qw,qx,qy,qz\n0,0,0,0,1,0,0,0\n", True, True))
            assert heard.wait(10.0)
    finally:
        session.end()
    assert [(each["state"], each["message"]) for each in told] == [
        ("failed", FAILED),
        ("failed", "no server yet"),
    ]
    assert "broken check" in caplog.text
