"""Connection of the viewer to the server of a scene: finds it, and notices when it is lost."""

import logging
import threading
import time
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

from ....schemas.errors import BadRequestError, SolidcloudError
from ....schemas.wire.scene_messages import SceneInfo
from ....schemas.wire.warming_parts import MOTION, PARTS
from ...client import Client
from ...zenoh_client.server_connection import scenes_at
from ..page.view_frame import ViewFrame
from .browser_feed import BackgroundThread

log = logging.getLogger(__name__)

# Interval of the questions whether the server still answers, and how long an answer may take [s].
_CHECK_SECONDS, _ANSWER_SECONDS = 0.7, 5.0
# Questions in a row that may remain without an answer while the server compiles.
_MOST_SILENT = 24
# How long an answer to long work may take [s].
_LONG_SECONDS = 30.0
# Parts of a server that a user needs from the first frame: a direction to look to, and motion.
_ENTERING = frozenset({"raycast", MOTION})
# Interval of the attempts to find a server [s].
_SEARCH_SECONDS = 0.5


class LinkStatus(NamedTuple):
    """State of the connection to the server.

    number: grows with every change.  state: "searching" before a server was found, "connected", or
    "lost".  message: a sentence for the user, "" if all is well.
    round_trip: of the last question [s].
    """

    number: int
    state: str
    message: str
    round_trip: float = 0.0


class OpenScene(NamedTuple):
    """A scene that is connected.

    client: for users.  reader: for what is drawn; a server has a queue for each client, so that
    large tiles do not delay users.
    """

    info: SceneInfo
    frame: ViewFrame
    client: Client
    reader: Client


class SceneLink(BackgroundThread):
    """Connection to the scene that the viewer shows; a context manager, thread-safe.

    It is kept when the server is lost: the clients connect again by themselves.
    """

    def __init__(self, endpoint: str, scene: str | None = None, key_file: Path | None = None) -> None:
        """Make a link. scene: None: the only one at the endpoint."""
        super().__init__("viewer-link")
        self.endpoint = endpoint
        self._scene, self._key_file = scene, key_file
        self._lock = threading.Lock()
        self._status = LinkStatus(0, "searching", f"Looking for a server at {endpoint}.")
        self._failures = 0  # questions without an answer since the last answer
        self._open: OpenScene | None = None

    @property
    def status(self) -> LinkStatus:
        """Return the state of the connection to the server."""
        return self._status

    @property
    def scene(self) -> OpenScene | None:
        """Return the scene; None before it was found."""
        return self._open

    def another_client(self, scene: str) -> Client:
        """Return a client of its own for long work, for a `with`: it delays neither users nor tiles."""
        return Client(self.endpoint, scene=scene, timeout=_LONG_SECONDS, key_file=self._key_file)

    def _run(self) -> None:
        """Find the scene, and watch it. Runs in a thread."""
        with ExitStack() as stack:
            while self._open is None and not self._stop.is_set():
                self._find(stack)
                if self._open is None:
                    self._stop.wait(_SEARCH_SECONDS)
            while not self._stop.wait(_CHECK_SECONDS):
                self._check()

    def _find(self, stack: ExitStack) -> None:
        """Open the scene if a server serves it."""
        try:
            name = self._scene or self._only_scene()
            with ExitStack() as opening:
                client, reader = (
                    opening.enter_context(
                        Client(self.endpoint, scene=name, timeout=_ANSWER_SECONDS, key_file=self._key_file)
                    )
                    for _ in range(2)
                )
                info = reader.info()
                stack.push(opening.pop_all())
        except SolidcloudError as error:
            self._set("searching", str(error))
            return
        self._show(info, client, reader)

    def _only_scene(self) -> str:
        """Return the name of the only scene at the endpoint. Raise an error if there are others."""
        names = scenes_at(self.endpoint, key_file=self._key_file)
        if len(names) != 1:
            raise BadRequestError(
                f"{len(names)} scenes at {self.endpoint} ({', '.join(names)}): expected one: name it with --scene"
            )
        return names[0]

    def _check(self) -> None:
        """Ask the server for the scene."""
        opened = self._open
        if opened is None:
            return
        begin = time.monotonic()
        try:
            info = opened.reader.info()
        except SolidcloudError as error:
            log.debug("scene %s: %s", opened.info.scene, error)
            self._failures += 1
            # A single answer may be late because a large one is on the way. A server that compiles may
            # be silent for a minute; a question to one that is gone ends at once.
            silent = time.monotonic() - begin > 0.9 * _ANSWER_SECONDS
            if self._failures > (_MOST_SILENT if silent and opened.info.compiling else 1):
                self._set("lost", str(error))
            return
        self._failures = 0
        if info != opened.info or self._status.state != "connected":
            self._show(info, opened.client, opened.reader)
        else:
            self._status = self._status._replace(round_trip=time.monotonic() - begin)

    def _show(self, info: SceneInfo, client: Client, reader: Client) -> None:
        """Make a scene the one that is shown."""
        self._open = OpenScene(info, ViewFrame(info.bounds, info.up), client, reader)
        message = ""
        if not info.points:
            message = f"The scene {info.scene} holds no points."
        elif info.compiling:
            message = (
                f"The server compiles its kernels, once on this machine, for some minutes: {len(info.compiling)} "
                f"of {len(PARTS)} parts are left. Then you can walk."
            )
        self._set("connected", message)

    def _set(self, state: str, message: str) -> None:
        """Change the status, unless it is the same."""
        with self._lock:
            if (state, message) != self._status[1:3] or state == "connected":
                self._status = LinkStatus(self._status.number + 1, state, message)


def may_enter(info: SceneInfo) -> bool:
    """Return whether a user can enter a scene: it has points, and the server has compiled what that needs."""
    return bool(info.points) and not _ENTERING.intersection(info.compiling)


def same_picture(one: SceneInfo, other: SceneInfo) -> bool:
    """Return whether two descriptions of a scene are of the same points in the same frame."""
    return (one.generation, one.points, one.bounds, one.up) == (
        other.generation,
        other.points,
        other.bounds,
        other.up,
    )
