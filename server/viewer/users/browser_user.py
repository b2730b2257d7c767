"""User of one browser: its session with the server, and its states as messages for the page."""

import logging
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ....schemas.errors import BusyError, SolidcloudError
from ....schemas.wire.motion_messages import State
from ...runtime.threads import start_loop
from ...scene_interface import AvatarShape
from ...zenoh_client.client_session import ClientSession
from ..feeds.scene_link import OpenScene
from ..page.page_messages import FAILED, Intent
from ..page.view_frame import ViewFrame
from .user_motion import Easing, turn, velocity

log = logging.getLogger(__name__)

Floats = NDArray[np.float64]

# How long the first state may take: a server loads and places the avatar first [s].
_FIRST_SECONDS = 10.0
# How often the thread that receives states checks whether the session has ended [s].
_STATES_SECONDS = 0.5


class BrowserUser:
    """User that the server moves; begins with `begin` and ends with `end`.

    Only the server changes its pose.
    """

    def __init__(
        self,
        name: str,
        avatar: AvatarShape,
        deliver: Callable[[State, ViewFrame], None],
        report: Callable[[str], None],
    ) -> None:
        """Make a user.

        name: of its avatar in the server.  deliver, report: receive each state, and each error as a
        sentence, in a thread of the user.
        """
        self._name, self._avatar, self._deliver, self._report = name, avatar, deliver, report
        self._session: ClientSession | None = None
        self._frame: ViewFrame | None = None
        self._thread: threading.Thread | None = None
        self._latest: State | None = None
        self._easing = Easing()

    @property
    def place(self) -> Floats | None:
        """Return where the user is, world [m]; None before the first state."""
        latest = self._latest
        return None if latest is None else latest.pose[0, :3, 3]

    @property
    def pose(self) -> Floats | None:
        """Return its pose (4, 4), avatar to world; None while it is not in the scene."""
        latest = self._latest
        return None if latest is None or self._session is None else latest.pose[0]

    def begin(self, scene: OpenScene, pose: Floats) -> None:
        """Enter the scene at a pose (4, 4). Raise the server's errors, BusyError without a server."""
        scene.client.add_avatar(self._name, self._avatar)
        session = scene.client.session(self._name, late="bounds")
        session.__enter__()
        try:
            end = time.monotonic() + _FIRST_SECONDS
            state = session.wait(session.wish(pose=pose), _FIRST_SECONDS)
            # A frame does not wait for voxels: the way to the pose is completed as they are loaded.
            while state.unloaded and time.monotonic() < end:
                state = session.wait(session.wish(pose=pose), _FIRST_SECONDS)
            self._latest = state
        except SolidcloudError:
            session.close()
            raise
        self._session, self._frame = session, scene.frame
        self._thread = start_loop(
            f"viewer-{self._name}", self._receive, session, scene.frame, failed=partial(self._report, FAILED)
        )

    def command(self, intent: Intent) -> None:
        """Send one motion command."""
        session, frame, latest = self._session, self._frame, self._latest
        if session is None or frame is None or latest is None:
            return
        speed, is_off = self._easing.ease(velocity(intent, frame), latest)
        # A turn would push the hand into the wall again.
        turning = 0.0 if is_off else turn(intent, frame.yaw(latest.pose[0]))
        session.wish(velocity=speed, turn=turning)

    def end(self) -> None:
        """Leave the scene. Ending twice is allowed."""
        session, thread, self._session, self._thread = self._session, self._thread, None, None
        if session is not None:
            session.close()
        if thread is not None and thread is not threading.current_thread():
            thread.join()

    def _receive(self, session: ClientSession, frame: ViewFrame) -> None:
        """Deliver states until the session ends. Runs in a thread."""
        while session is self._session:
            try:
                for state in session.states(_STATES_SECONDS):
                    self._latest = state
                    self._deliver(state, frame)
            except BusyError as error:
                log.debug("user %s: %s", self._name, error)
            except SolidcloudError as error:
                self._report(str(error))


def state_fields(state: State, frame: ViewFrame) -> dict[str, Any]:
    """Return a state for the page, in the page's frame."""
    fields: dict[str, Any] = {
        "seq": state.seq,
        "time": state.time,
        "frame": state.frame,
        "pose": rounded(frame.pose(state.pose[0])),
        "verdict": state.verdict,
        "left": state.left,
        "unknown": state.unknown,
        "unloaded": state.unloaded,
        "stepped": state.stepped,
        "seconds": state.seconds,
        "roundTrip": time.monotonic() - state.time,
        "touched": [
            {
                "place": rounded(frame.points(each.place)),
                "normal": None if each.normal is None else rounded(frame.directions(each.normal)),
                "what": each.what,
                "unknown": each.unknown,
                "unloaded": each.unloaded,
            }
            for each in state.touched
        ],
    }
    if state.ground is not None:
        fields["ground"] = {"on": state.ground.on_ground, "speed": state.ground.speed}
    near = state.proximity
    if near is not None and near.avatar is not None and near.cloud is not None:
        fields["proximity"] = {
            "distance": near.distance,
            "avatar": rounded(frame.points(near.avatar)),
            "cloud": rounded(frame.points(near.cloud)),
        }
    if state.contacts is not None:
        fields["contacts"] = {
            "total": state.contacts.total,
            "clusters": [
                {"count": each.count, "deepest": each.deepest, "place": rounded(frame.points(each.cloud))}
                for each in state.contacts.clusters
            ],
        }
    return fields


def rounded(values: NDArray[np.float64]) -> list[Any]:
    """Return numbers for the page, to a micrometre."""
    listed: list[Any] = np.round(values, 6).tolist()
    return listed
