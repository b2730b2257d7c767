"""Starting place of a user: the scene's spawn, or a place where the avatar stands free on a floor."""

import logging
import threading
from collections.abc import Sequence
from typing import Any

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from ....schemas.errors import SolidcloudError
from ....schemas.wire.answers import CollideAnswers, Verdict
from ....schemas.wire.scene_messages import AvatarInfo, SceneInfo
from ...cli.scene_files.spawn_search import Body, add_body, find_spawn
from ...scene_interface import AvatarShape
from ..feeds.scene_link import OpenScene
from .user_avatar import height_of

log = logging.getLogger(__name__)

Floats = NDArray[np.float64]

# Distance between users at the start, and how many rings of this width are tried [m].
_APART, _RINGS = 1.0, 4
# Height of the eyes as a share of the avatar's height, how far it looks, and in how many directions.
_EYES, _SIGHT, _DIRECTIONS = 0.9, 60.0, 32
# Room that a camera behind the user takes [m].
_BEHIND = 4.0
_PROBE = "viewer-start"


class _UprightScene:
    """Scene in the page's frame, whose z is up, for the search of a place."""

    def __init__(self, scene: OpenScene) -> None:
        self._scene = scene

    def info(self) -> SceneInfo:
        """Return the scene, with bounds in the page's frame."""
        info = self._scene.info
        low, high = np.array(info.bounds)
        low, high = self._scene.frame.boxes(np.eye(4)[None], low[None], high[None])
        return structs.replace(info, bounds=[low[0].tolist(), high[0].tolist()])

    def add_avatar(self, name: str, points: Any, radius: float | None = None) -> AvatarInfo:
        """Add an avatar."""
        return self._scene.client.add_avatar(name, points, radius)

    def collide(self, name: str, poses: Any) -> CollideAnswers:
        """Return the verdicts of poses (k, 4, 4), avatar to the page's frame."""
        return self._scene.client.collide(name, self._scene.frame.poses_to_world(poses))


class StartingPlaces:
    """Places where users begin. Thread-safe; a search is done once for each avatar and scene."""

    def __init__(self, avatar: AvatarShape) -> None:
        """Make places for an avatar."""
        self._avatar = avatar
        self._lock = threading.Lock()
        self._found: tuple[int, Floats] | None = None  # generation, place

    def pose(
        self, scene: OpenScene, at: tuple[float, float, float, float] | None, others: Sequence[Floats]
    ) -> Floats:
        """Return the pose (4, 4), avatar to world, where a user begins.

        at: place in the world [m] and direction [degrees], if the user chose one.
        others: (3,) each, where other users are, world [m]. Raise the server's errors.
        """
        frame = scene.frame
        if at is not None:
            return frame.standing(at[:3], np.radians(at[3]))
        spawn = scene.info.spawn
        if spawn is not None:
            return frame.standing(spawn.position, np.radians(spawn.heading + 90.0))
        with self._lock:
            place = self._place(scene)
            place = self._free(scene, place, others)
            return frame.standing(place, self._outlook(scene, place))

    def _place(self, scene: OpenScene) -> Floats:
        """Return a place to stand near the middle of the scene, or above it if none is found."""
        if self._found is not None and self._found[0] == scene.info.generation:
            return self._found[1]
        body = add_body(scene.client, {_PROBE: self._avatar})
        found = find_spawn(_UprightScene(scene), body)
        place = scene.frame.to_world(found) if found is not None else _above(scene, body)
        self._found = (scene.info.generation, place)
        return place

    def _free(self, scene: OpenScene, place: Floats, others: Sequence[Floats]) -> Floats:
        """Return the place, or one near it where the avatar is clear and away from the others."""
        for ring in range(_RINGS + 1):
            for step in range(6 * ring or 1):
                angle = step * np.pi / (3 * max(1, ring))
                offset = np.array([np.cos(angle), np.sin(angle), 0.0]) * ring * _APART
                tried = place + scene.frame.directions_to_world(offset)
                if any(np.linalg.norm(tried - other) < 0.9 * _APART for other in others):
                    continue
                verdict = scene.client.collide(_PROBE, scene.frame.standing(tried, 0.0)).verdict
                if ring == 0 or verdict[0] == Verdict.CLEAR:
                    return tried
        return place

    def _outlook(self, scene: OpenScene, place: Floats) -> float:
        """Return the direction with the farthest view that ends at a point of the scan [rad]."""
        angles = np.arange(_DIRECTIONS) * 2 * np.pi / _DIRECTIONS
        ways = np.column_stack([np.cos(angles), np.sin(angles), np.full(_DIRECTIONS, 0.05)])
        ways /= np.linalg.norm(ways, axis=1)[:, None]
        eyes = scene.frame.directions_to_world([0.0, 0.0, _EYES * height_of(self._avatar)])
        try:
            hits = scene.client.raycast(
                np.tile(place + eyes, (_DIRECTIONS, 1)), scene.frame.directions_to_world(ways), _SIGHT
            )
        except SolidcloudError as error:
            log.debug("no outlook: %s", error)
            return 0.0
        far = np.where(np.isfinite(hits.distance), hits.distance, 0.0)
        # A direction counts with its neighbours, so that the view is not through a crack, and needs
        # room behind for the camera.
        ahead = far + np.roll(far, 1) + np.roll(far, -1)
        behind = np.roll(np.minimum(hits.distance, _BEHIND), _DIRECTIONS // 2)
        return float(angles[np.argmax(ahead * behind)])


def _above(scene: OpenScene, body: Body) -> Floats:
    """Return a place above the middle of the scene, world [m]."""
    low, high = (scene.frame.points(corner) for corner in scene.info.bounds)
    top = max(low[2], high[2])
    middle = (low + high) / 2
    return scene.frame.to_world([middle[0], middle[1], top - body.foot + 0.5])
