"""One browser: reads its messages, moves its user, and sends it what it draws."""

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from functools import partial

import numpy as np

from ...schemas.errors import BusyError, SolidcloudError
from ...schemas.wire.motion_messages import FRAME_SECONDS, State
from ..runtime.threads import start_loop
from .clash_session import ClashSession
from .feeds.scene_link import LinkStatus, OpenScene, may_enter, same_picture
from .page.page_messages import (
    FAILED,
    PAGE_VERSION,
    Around,
    Boom,
    ClashMessage,
    FromPage,
    Hello,
    Intent,
    Measure,
    PageConnection,
    Restart,
    Spheres,
    SwitchEffects,
    TileKey,
    Want,
    binary_message,
    read_message,
    text_message,
)
from .page.view_frame import ViewFrame
from .panel_work import PanelWork
from .panels.effect_switch import effects_message
from .users.browser_user import BrowserUser, state_fields
from .viewer_parts import ViewerParts

log = logging.getLogger(__name__)

# Interval of attempts to enter the scene [s].
_RETRY_SECONDS = 1.0
# An intent without a following message ends after this time: the page may be hidden or frozen [s].
_INTENT_SECONDS = 1.0
# Distance of the outer rays between user and camera from the middle one [m].
_BOOM_RADIUS = 0.12
# A page that takes tiles slowly asks again for those that are on their way: a tile that was sent is sent
# again only after this time [s].
_AGAIN_SECONDS = 3.0
# Until a server that did not answer is asked again [s].
_LATER_SECONDS = 0.2
# Changes of residency that wait for a page that takes none: a page that misses some asks again for
# the voxels near it every few seconds.
_MOST_CHANGES = 64


class Browser:
    """One browser's page, from its first message until it is closed.

    Five threads work for it: the caller of `run` reads, one sends motion commands at 30 Hz, one
    delivers the states, one reads tiles, and one works for the panels.
    """

    def __init__(self, connection: PageConnection, parts: ViewerParts) -> None:
        """Make a browser."""
        self._connection, self._parts = connection, parts
        self.number = parts.users.enter()
        self._intent, self._intended = Intent(), 0.0
        name = f"viewer-{self.number}"
        self._user = BrowserUser(name, parts.avatar, self._deliver, self._problem)
        self._panels = PanelWork(self.number, name, parts, lambda: self._user.pose, self._send, self._attempt)
        self._clash = ClashSession(self.number, parts, self._send)
        self._boom: Boom | None = None
        self._begun = False
        self._at: tuple[float, float, float, float] | None = None
        self._restart = threading.Event()
        self._closed = threading.Event()
        self._wanted: list[TileKey] = []
        self._sent: dict[TileKey, float] = {}  # when a tile was sent last [s]
        self._around: Around | None = None
        self._overview: OpenScene | None = None  # whose overview the page lacks
        self._changes: deque[bytes] = deque(maxlen=_MOST_CHANGES)
        self._work = threading.Condition()

    def run(self) -> None:
        """Serve the page until it is closed. Raise BadRequestError for an invalid message."""
        try:
            self._serve()
        finally:
            self._parts.users.free(self.number)

    def _serve(self) -> None:
        """Serve the page, from its first message."""
        messages = map(read_message, self._connection)
        hello = next(messages, None)
        if not isinstance(hello, Hello):
            return
        if hello.version != PAGE_VERSION:
            self._problem("This page is of another version of solidcloud: reload it.")
            return
        self._at = hello.at
        threads = [
            start_loop(f"viewer-{self.number}-{name}", target, failed=self._failed)
            for name, target in (
                ("commands", self._pace),
                ("tiles", self._send_tiles),
                ("panels", self._panels.run),
            )
        ]
        self._parts.residency.follow(self.number, self._changed)
        try:
            self._read(messages)
        finally:
            self._closed.set()
            self._panels.close()
            self._parts.residency.leave(self.number)
            with self._work:
                self._work.notify_all()
            self._parts.users.leave(self.number)
            for thread in threads:
                thread.join()
            self._user.end()
            self._clash.end()

    def _read(self, messages: Iterable[FromPage]) -> None:
        """Take the page's messages."""
        for message in messages:
            if isinstance(message, Intent):
                self._intent, self._intended = message, time.monotonic()
            elif isinstance(message, Boom):
                self._boom = message
            elif isinstance(message, Restart):
                self._at = message.at
                self._restart.set()
            elif isinstance(message, Measure | Spheres | SwitchEffects):
                self._panels.ask(message)
            elif isinstance(message, ClashMessage):
                self._clash.take(message)
            else:
                with self._work:
                    if isinstance(message, Want):
                        self._wanted = message.tiles
                    elif isinstance(message, Around):
                        self._around = message
                    self._work.notify_all()

    # --- user ------------------------------------------------------------------------------------

    def _pace(self) -> None:
        """Report the server's state, enter the scene, and send motion commands. Runs in a thread."""
        known, shown, tried = -1, None, 0.0
        due = time.monotonic()
        while not self._closed.is_set():
            status, scene = self._parts.link.status, self._parts.link.scene
            if status.number != known:
                known = status.number
                self._send(status_message(status, self._parts.link.endpoint))
                if scene is not None:
                    self._send(effects_message(scene.info.effects, self._parts.switch))
                if scene is not None and (shown is None or not same_picture(scene.info, shown)):
                    shown = scene.info
                    self._send(welcome_message(scene, self.number))
                    self._send(avatar_message(self._parts))
                    self._clash.begin()
                    with self._work:
                        self._overview = scene
                        self._sent.clear()
                        self._work.notify_all()
            if self._restart.is_set():
                self._restart.clear()
                self._user.end()
                self._begun, tried = False, 0.0
            now = time.monotonic()
            if (
                not self._begun
                and scene is not None
                and may_enter(scene.info)
                and now - tried > _RETRY_SECONDS
            ):
                self._enter(scene)
                tried = now
            if self._begun:
                intent = self._intent if now - self._intended < _INTENT_SECONDS else Intent()
                self._attempt(partial(self._user.command, intent))
            boom, self._boom = self._boom, None
            if boom is not None and scene is not None:
                self._attempt(partial(self._send_boom, boom, scene), again=True)
            due = max(due + FRAME_SECONDS, time.monotonic() - FRAME_SECONDS)
            self._closed.wait(max(0.0, due - time.monotonic()))

    def _enter(self, scene: OpenScene) -> None:
        """Put the user into the scene."""

        def enter() -> None:
            others = self._parts.users.places(self.number)
            self._user.begin(scene, self._parts.places.pose(scene, self._at, others))
            self._begun = True
            self._send(text_message("entered"))

        self._attempt(enter)

    def _attempt(self, work: Callable[[], None], *, again: bool = False) -> None:
        """Do something that the server may refuse; the page shows why.

        again: the page asks again by itself, so that a busy server needs no words.
        """
        try:
            work()
        except BusyError as error:
            # Without a server the page already shows this.
            if self._parts.link.status.state == "connected" and not again:
                self._problem(str(error))
        except SolidcloudError as error:
            self._problem(str(error))
        except Exception:  # the browser's thread must go on: its user would never enter, or never move
            log.exception("browser %d", self.number)
            self._failed()

    def _deliver(self, state: State, frame: ViewFrame) -> None:
        """Send a state to the page, with the other users."""
        fields = state_fields(state, frame)
        self._parts.users.moved(self.number, state.pose[0, :3, 3], fields["pose"], state.verdict)
        others = self._parts.users.others(self.number)
        self._send(text_message("frame", state=fields, others=others))

    # --- what is drawn ---------------------------------------------------------------------------

    def _changed(self, message: bytes) -> None:
        """Take changes of residency."""
        with self._work:
            self._changes.append(message)
            self._work.notify_all()

    def _send_tiles(self) -> None:
        """Send voxels and tiles that the page asked for. Runs in a thread."""
        while not self._closed.is_set():
            with self._work:
                self._work.wait_for(self._has_work)
                overview, self._overview = self._overview, None
                around, self._around = self._around, None
                changes = [self._changes.popleft() for _ in range(len(self._changes))]
                key = self._next_tile() if around is None else None
                if overview is None and around is None and key is None and not changes:
                    self._work.wait(0.1)  # all that is wanted is on its way
            for message in changes:
                self._send(message)
            if overview is not None:
                self._attempt(partial(self._send_overview, overview))
            if around is not None:
                self._attempt(partial(self._send_voxels, around))
            elif key is not None:
                self._send_tile(key)

    def _next_tile(self) -> TileKey | None:
        """Take the most urgent tile that is not on its way to the page. The caller holds `_work`."""
        begin = time.monotonic() - _AGAIN_SECONDS
        for place, key in enumerate(self._wanted):
            if self._sent.get(key, -math.inf) < begin:
                self._sent = {each: when for each, when in self._sent.items() if when >= begin}
                return self._wanted.pop(place)
        return None

    def _send_overview(self, scene: OpenScene) -> None:
        """Send the overview of a scene."""
        if not self._answered(partial(self._parts.tiles.overview, scene)):
            with self._work:
                self._overview = self._overview or scene

    def _send_voxels(self, around: Around) -> None:
        """Send the voxels near a place."""
        if not self._answered(partial(self._parts.tiles.voxels, around.place)):
            with self._work:
                self._around = self._around or around

    def _answered(self, ask: Callable[[], bytes | None]) -> bool:
        """Send an answer that the page waits for. Return False if it must be asked for again."""
        try:
            self._send(ask())
        except BusyError as error:
            log.debug("no answer: %s", error)
            self._closed.wait(_LATER_SECONDS)
            return False
        return True

    def _send_boom(self, boom: Boom, scene: OpenScene) -> None:
        """Send how far the camera may be from the user."""
        self._send(boom_message(boom, scene))

    def _has_work(self) -> bool:
        """Return whether there is something to send. The caller holds `_work`."""
        asked = self._overview or self._wanted or self._around or self._changes
        return bool(asked) or self._closed.is_set()

    def _send_tile(self, key: TileKey) -> None:
        """Send one tile. One that cannot be read is named, so that the page does not ask again."""
        try:
            message = self._parts.tiles.tile(key)
        except BusyError as error:
            log.debug("tile %s: %s", key, error)
            self._send(
                text_message("missing", key=list(key[:4]), detail=key[4], again=True, message=str(error))
            )
            self._closed.wait(_LATER_SECONDS)
        except SolidcloudError as error:
            self._send(
                text_message("missing", key=list(key[:4]), detail=key[4], again=False, message=str(error))
            )
        except Exception:  # affects this tile only
            log.exception("browser %d: tile %s", self.number, key)
            self._send(text_message("missing", key=list(key[:4]), detail=key[4], again=False, message=FAILED))
        else:
            self._send(message)
            with self._work:
                self._sent[key] = time.monotonic()

    # --- messages --------------------------------------------------------------------------------

    def _failed(self) -> None:
        """Tell the page of an error that is not expected."""
        self._problem(FAILED)

    def _problem(self, message: str) -> None:
        """Show a sentence on the page."""
        self._send(text_message("problem", message=message))

    def _send(self, message: str | bytes | None) -> None:
        """Send a message, unless the page is closed."""
        if message is not None and self._connection.is_open():
            self._connection.send(message)


def status_message(status: LinkStatus, endpoint: str) -> str:
    """Return the state of the server as a message."""
    return text_message("status", state=status.state, message=status.message, endpoint=endpoint)


def boom_message(boom: Boom, scene: OpenScene) -> str:
    """Return how far a line is free of the scan as a message.

    Four parallel rays beside it are tested too: the camera does not look through a gap.
    """
    way = np.array(boom.way)
    if not way.any():
        way = np.array([0.0, 0.0, 1.0])
    way /= np.linalg.norm(way)
    side = np.cross(way, [0.0, 0.0, 1.0] if abs(way[2]) < 0.9 else [1.0, 0.0, 0.0])
    side *= _BOOM_RADIUS / np.linalg.norm(side)
    over = np.cross(side, way)
    origins = np.array(boom.place) + np.stack([np.zeros(3), side, -side, over, -over])
    frame = scene.frame
    answers = scene.reader.raycast(
        frame.to_world(origins), frame.directions_to_world(np.tile(way, (len(origins), 1))), boom.reach
    )
    # A ray that begins at a wall beside the user says nothing about the way back.
    hits = answers.distance[answers.distance > _BOOM_RADIUS]
    return text_message("boom", free=float(min(boom.reach, *hits)) if len(hits) else boom.reach)


def welcome_message(scene: OpenScene, number: int) -> str:
    """Return the description of the scene as a message."""
    info = scene.info
    low, high = (scene.frame.points(corner).tolist() for corner in info.bounds)
    return text_message(
        "welcome",
        version=PAGE_VERSION,
        number=number,
        frame=scene.frame.description(),
        scene={
            "name": info.scene,
            "points": info.points,
            "voxels": info.voxels,
            "voxelSize": info.voxel_size,
            "radius": info.radius,
            "low": [min(pair) for pair in zip(low, high, strict=True)],
            "high": [max(pair) for pair in zip(low, high, strict=True)],
            "effects": info.effects,
            "generation": info.generation,
            "sources": [source.path for source in info.sources[:64]],
            "spawn": info.spawn is not None,
            "unknown": len(info.unknown) + info.unknown_everywhere,
        },
    )


def avatar_message(parts: ViewerParts) -> bytes:
    """Return the points of the avatar's surface as a message."""
    avatar = parts.avatar
    return binary_message("avatar", {"points": avatar.surface.astype("f4")}, radius=avatar.radius or 0.0)
