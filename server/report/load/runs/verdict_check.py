"""Check of a server's verdicts under load against a scene in this process with everything resident."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .....schemas.wire.answers import Verdict
from ....scene import Scene
from ...common.whole_scene import open_whole
from ..users.frame_outcomes import ANSWERED, Frames
from ..users.user_process import AVATAR
from ..users.user_traces import Trace


class Judge:
    """Undisturbed scene, opened at the first query, closed by `close`."""

    def __init__(self, archive: Path, avatar: NDArray[np.float64]) -> None:
        """Create the judge. avatar: (n, 3) points [m]."""
        self._archive, self._avatar = archive, avatar
        self._scene: Scene | None = None

    def verdicts(self, trace: Trace) -> NDArray[np.int64]:
        """Return the true verdict of each pose (n,), in one call per user."""
        if self._scene is None:
            self._scene = open_whole(self._archive)
            self._scene.add_avatar(AVATAR, self._avatar)
        found = np.full(len(trace.user), -1)
        for user in np.unique(trace.user):
            own = trace.user == user
            found[own] = self._scene.collide(AVATAR, trace.pose[own]).verdict
        return found

    def close(self) -> None:
        """Close the scene, if it is open."""
        scene, self._scene = self._scene, None
        if scene is not None:
            scene.close()


def wrong(frames: Frames, truth: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the numbers of frames whose verdict is neither `UNKNOWN` nor the true one.

    Unanswered frames are ignored.
    """
    said = (frames.status == ANSWERED) & (frames.verdict != Verdict.UNKNOWN)
    return np.flatnonzero(said & (frames.verdict != truth))
