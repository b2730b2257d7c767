"""Test when the viewer says that a server is lost."""

from types import SimpleNamespace
from typing import Any

import pytest
from solidcloud.schemas.errors import BusyError
from solidcloud.schemas.wire.warming_parts import MOTION
from solidcloud.server.viewer.feeds import scene_link
from solidcloud.server.viewer.feeds.scene_link import SceneLink


def info(compiling: list[str], points: int = 9) -> Any:
    return SimpleNamespace(
        scene="hall", points=points, bounds=[[0, 0, 0], [1, 1, 1]], up=(0, 0, 1), compiling=compiling
    )


class Reader:
    """Client whose questions end without an answer after some time [s]."""

    def __init__(self, clock: list[float], seconds: float) -> None:
        self.clock, self.seconds = clock, seconds

    def info(self) -> Any:
        self.clock[0] += self.seconds
        raise BusyError("no answer")


def states(
    monkeypatch: pytest.MonkeyPatch, compiling: list[str], seconds: float, questions: int
) -> list[str]:
    """Return the state of a link after each of its questions."""
    clock = [0.0]
    monkeypatch.setattr(scene_link, "time", SimpleNamespace(monotonic=lambda: clock[0]))
    link = SceneLink("tcp/127.0.0.1:1")
    reader: Any = Reader(clock, seconds)
    link._show(info(compiling), reader, reader)
    found = []
    for _ in range(questions):
        link._check()
        found.append(link.status.state)
    return found


def test_server_without_two_answers_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    assert states(monkeypatch, [], 5.0, 2) == ["connected", "lost"]


def test_server_that_compiles_may_be_silent_but_not_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    assert states(monkeypatch, [MOTION], 5.0, 25) == ["connected"] * 24 + ["lost"]


def test_server_that_ends_while_it_compiles_is_lost_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    assert states(monkeypatch, [MOTION], 0.01, 2) == ["connected", "lost"]


def test_page_is_told_that_kernels_are_compiled() -> None:
    link = SceneLink("tcp/127.0.0.1:1")
    reader: Any = Reader([0.0], 0.0)
    link._show(info([MOTION, "sweep"]), reader, reader)
    assert "2 of 8 parts are left" in link.status.message
    link._show(info([]), reader, reader)
    assert link.status.message == ""
