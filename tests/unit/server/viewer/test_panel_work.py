"""Test the thread that works for a browser's panels."""

import threading
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
from solidcloud.schemas.errors import BadRequestError, SolidcloudError
from solidcloud.server.viewer.page.page_messages import Measure, Spheres, SwitchEffects
from solidcloud.server.viewer.panel_work import PanelWork

DEADLINE = 60.0


class Parts:
    """Parts of a viewer that note what they are asked for."""

    def __init__(self, scene: Any = "scene") -> None:
        self.link = SimpleNamespace(scene=scene)
        self.statistics = self.switch = self.spheres = self
        self.followed: dict[int, Callable[[str], None]] = {}
        self.switched: list[list[str]] = []
        self.begun, self.go_on = threading.Event(), threading.Event()

    def follow(self, number: int, listener: Callable[[str], None]) -> None:
        self.followed[number] = listener
        listener("samples")

    def leave(self, number: int) -> None:
        del self.followed[number]

    def change(self, names: list[str]) -> None:
        self.switched.append(names)
        self.begun.set()
        assert self.go_on.wait(DEADLINE)
        raise BadRequestError("no such effect")

    def message(self, scene: Any, place: Any, level: int) -> bytes:
        return f"spheres {level}".encode()


class Work:
    """Work for the panels of browser 7, whose user is not in the scene, in a thread."""

    def __init__(self, parts: Parts, pose: Any = None) -> None:
        self.sent: list[str | bytes] = []
        self.problems: list[str] = []
        self._arrived = threading.Condition()
        self.panels = PanelWork(7, "al", parts, lambda: pose, self._send, self._attempt)  # type: ignore[arg-type]
        self.thread = threading.Thread(target=self.panels.run)
        self.thread.start()

    def _send(self, message: str | bytes) -> None:
        with self._arrived:
            self.sent.append(message)
            self._arrived.notify_all()

    def _attempt(self, work: Callable[[], None]) -> None:
        try:
            work()
        except SolidcloudError as error:
            self.problems.append(str(error))

    def wait(self, count: int) -> None:
        """Wait for a number of messages."""
        with self._arrived:
            assert self._arrived.wait_for(lambda: len(self.sent) >= count, DEADLINE), self.sent

    def end(self) -> None:
        self.panels.close()
        self.thread.join(DEADLINE)
        assert not self.thread.is_alive()


def test_only_the_latest_request_of_each_kind_is_answered() -> None:
    parts = Parts()
    work = Work(parts)
    work.panels.ask(SwitchEffects(["stop"]))
    assert parts.begun.wait(DEADLINE)
    for level in range(5):
        work.panels.ask(Spheres((0.0, 0.0, 0.0), level))
    parts.followed[7]("sample")
    parts.go_on.set()
    work.wait(3)
    work.end()
    assert work.sent == ["samples", "sample", b"spheres 4"]
    assert parts.switched == [["stop"]] and work.problems == ["no such effect"]
    assert parts.followed == {}, "a closed browser follows nothing"


def test_nothing_is_measured_without_a_scene_or_a_user() -> None:
    for parts, pose in ((Parts(scene=None), np.eye(4)), (Parts(), None)):
        work = Work(parts, pose)
        work.panels.ask(Measure(0.1))
        parts.go_on.set()
        work.panels.ask(SwitchEffects(["slide"]))
        assert parts.begun.wait(DEADLINE)
        work.wait(1)
        work.end()
        assert work.sent == ["samples"]
