"""Work for the panels of one browser: statistics, measurements of the user's pose, spheres near it."""

import threading
from collections import deque
from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from .page.page_messages import Measure, Spheres, SwitchEffects
from .panels.pose_measurement import measured_message
from .viewer_parts import ViewerParts

# Samples of statistics that wait for a page that takes none: the charts then have a gap.
_MOST_SAMPLES = 64

FromPanel = Measure | Spheres | SwitchEffects


class PanelWork:
    """Work for the panels of one browser, in a thread of its own: users and tiles do not wait for it.

    Of each kind of request only the latest is answered.
    """

    def __init__(
        self,
        number: int,
        avatar: str,
        parts: ViewerParts,
        pose: Callable[[], NDArray[np.float64] | None],
        send: Callable[[str | bytes], None],
        attempt: Callable[[Callable[[], None]], None],
    ) -> None:
        """Make it.

        number: of the browser.  avatar: name of its user's.  pose: returns the user's pose (4, 4).
        send: sends a message to the page.  attempt: does something that the server may refuse.
        """
        self._number, self._avatar, self._parts = number, avatar, parts
        self._pose, self._send, self._attempt = pose, send, attempt
        self._asked: dict[type, FromPanel] = {}
        self._samples: deque[str] = deque(maxlen=_MOST_SAMPLES)
        self._work = threading.Condition()
        self._closed = False

    def ask(self, message: FromPanel) -> None:
        """Take a request of the page."""
        with self._work:
            self._asked[type(message)] = message
            self._work.notify()

    def close(self) -> None:
        """End `run`."""
        with self._work:
            self._closed = True
            self._work.notify()

    def run(self) -> None:
        """Answer requests until `close`. Runs in a thread."""
        self._parts.statistics.follow(self._number, self._sampled)
        try:
            self._serve()
        finally:
            self._parts.statistics.leave(self._number)

    def _serve(self) -> None:
        """Answer requests until `close`."""
        while True:
            with self._work:
                self._work.wait_for(lambda: self._closed or self._asked or self._samples)
                if self._closed:
                    return
                samples = [self._samples.popleft() for _ in range(len(self._samples))]
                asked = list(self._asked.values())
                self._asked.clear()
            for each in samples:
                self._send(each)
            for message in asked:
                self._attempt(partial(self._answer, message))

    def _sampled(self, message: str) -> None:
        """Take a sample of statistics."""
        with self._work:
            self._samples.append(message)
            self._work.notify()

    def _answer(self, message: FromPanel) -> None:
        """Answer a request. Raise the server's errors."""
        scene, pose = self._parts.link.scene, self._pose()
        if isinstance(message, SwitchEffects):
            self._parts.switch.change(message.names)
        elif scene is None:
            return
        elif isinstance(message, Spheres):
            self._send(self._parts.spheres.message(scene, message.place, message.level))
        elif pose is not None:
            self._send(measured_message(scene.client, self._avatar, pose, message.tolerance))
