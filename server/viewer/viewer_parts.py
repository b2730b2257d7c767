"""Parts that the browsers of one viewer share: the scene, the avatar, tiles, and the users' places."""

import threading
from itertools import count
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..scene_interface import AvatarShape
from .feeds.residency_feed import ResidencyFeed
from .feeds.scene_link import SceneLink
from .feeds.statistics_feed import StatisticsFeed
from .feeds.tile_source import TileSource
from .panels.effect_switch import EffectSwitch
from .panels.path_source import GivenPath
from .panels.voxel_spheres import SphereSource
from .users.starting_place import StartingPlaces


class UserPlace(NamedTuple):
    """Place of a user.

    place: world [m].  pose: rows of a 4 x 4 matrix, avatar to the page's frame.  verdict: of it.
    """

    place: NDArray[np.float64]
    pose: list[list[float]]
    verdict: int


class Users:
    """Users of the viewer, by the number of their browser. Thread-safe."""

    def __init__(self) -> None:
        """Begin without users."""
        self._places: dict[int, UserPlace] = {}
        self._numbers: set[int] = set()
        self._lock = threading.Lock()

    def enter(self) -> int:
        """Return the least free number, for a new user.

        Numbers are used again, because a server keeps the avatar of each until the viewer ends.
        """
        with self._lock:
            number = next(each for each in count(1) if each not in self._numbers)
            self._numbers.add(number)
            return number

    def moved(self, number: int, place: NDArray[np.float64], pose: list[list[float]], verdict: int) -> None:
        """Store where a user is."""
        with self._lock:
            self._places[number] = UserPlace(place, pose, verdict)

    def leave(self, number: int) -> None:
        """Forget where a user is."""
        with self._lock:
            self._places.pop(number, None)

    def free(self, number: int) -> None:
        """Let another user have a number."""
        with self._lock:
            self._places.pop(number, None)
            self._numbers.discard(number)

    def places(self, number: int) -> list[NDArray[np.float64]]:
        """Return where the other users are, world [m]."""
        with self._lock:
            return [each.place for other, each in self._places.items() if other != number]

    def others(self, number: int) -> list[dict[str, Any]]:
        """Return the other users for the page of one."""
        with self._lock:
            return [
                {"number": other, "pose": each.pose, "verdict": each.verdict}
                for other, each in self._places.items()
                if other != number
            ]


class ViewerParts(NamedTuple):
    """Parts that the browsers of one viewer share.

    path: whose clashes each page shows from the beginning, or None.
    """

    link: SceneLink
    avatar: AvatarShape
    places: StartingPlaces
    tiles: TileSource
    users: Users
    residency: ResidencyFeed
    statistics: StatisticsFeed
    switch: EffectSwitch
    spheres: SphereSource
    path: GivenPath | None = None
