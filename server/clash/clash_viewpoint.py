"""Viewpoint of a clash: candidates around it, tested with rays."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas.wire.answers import Verdict
from ..scene_interface import QueryMethods
from .clash_list import Clash

Floats = NDArray[np.float64]

# Vertical angle of view [degrees]; BCF 2.1 allows 45 to 60.
FIELD_OF_VIEW = 60.0
# Candidates: directions about the up axis, angles above the horizon, and distances [m] as shares of
# the avatar's height above 2 m.
_DIRECTIONS, _RISES, _DISTANCES = 24, (12.0, 28.0, 50.0), (3.0, 2.1)
# Room that a camera needs [m], and how near a hit may be to the place that the ray goes to: the scan
# there is what is to be seen.
_ROOM, _BESIDE = 0.25, 0.25


class Viewpoint(NamedTuple):
    """Place and direction of a camera, world.

    eye, target: (3,) [m].  up: (3,), unit vector.
    """

    eye: Floats
    target: Floats
    up: Floats

    @property
    def direction(self) -> Floats:
        """Return the unit vector along which it looks."""
        way: Floats = self.target - self.eye
        return way / np.linalg.norm(way)


def find_viewpoint(
    scene: QueryMethods, clash: Clash, poses: Floats, middle: Floats, height: float, up: Any
) -> Viewpoint:
    """Return a viewpoint from which the contact and the avatar at the deepest pose are seen.

    middle: (3,), of the avatar, avatar frame [m].  height: of the avatar [m].  up: against gravity.
    Candidates on the side from which the avatar comes are preferred. Raise the server's errors.
    """
    up = np.asarray(up, np.float64) / np.linalg.norm(up)
    pose = poses[clash.deepest]
    body = pose[:3, :3] @ middle + pose[:3, 3]
    contact = clash.place + 0.05 * clash.normal
    target = 0.35 * body + 0.65 * contact
    ahead, side = _level(_travel(poses, clash), up)
    angles = np.arange(_DIRECTIONS) * 2 * np.pi / _DIRECTIONS
    back = -np.cos(angles)[:, None] * ahead + np.sin(angles)[:, None] * side
    size = max(1.0, height / 2.0)
    offsets, scores = [], []
    for distance in _DISTANCES:
        for rise in np.radians(_RISES):
            offsets.append(size * distance * (np.cos(rise) * back + np.sin(rise) * up))
            # Obliquely from behind: the avatar does not hide what it touches.
            scores.append(
                0.6 * np.cos(np.abs(angles) - np.radians(35.0))
                + (0.3 if distance > 2.5 else 0.0)
                - 0.4 * np.sin(rise)
            )
    eyes = target + np.concatenate(offsets)
    score = np.concatenate(scores)
    score = score + np.tile(
        0.6 * (np.concatenate(offsets[:1]) @ clash.normal) / size / _DISTANCES[0], len(offsets)
    )
    for aim, worth in ((contact, 2.0), (body, 1.5), (body + 0.35 * height * up, 1.0)):
        score += worth * _seen(scene, eyes, aim)
    score += 2.0 * (scene.within(eyes, _ROOM).verdict == Verdict.CLEAR)
    return Viewpoint(eyes[int(np.argmax(score))], target, up)


def _seen(scene: QueryMethods, eyes: Floats, aim: Floats) -> NDArray[np.bool_]:
    """Return whether the way from each eye to a place is free, (k,)."""
    ways = aim - eyes
    lengths = np.linalg.norm(ways, axis=1)
    hits = scene.raycast(eyes, ways / lengths[:, None], float(lengths.max()))
    free: NDArray[np.bool_] = (hits.distance >= lengths - _BESIDE) & (hits.verdict != Verdict.UNKNOWN)
    return free


def _travel(poses: Floats, clash: Clash) -> Floats:
    """Return the way from some poses before a clash to its deepest pose, (3,)."""
    places = poses[: clash.deepest + 1, :3, 3]
    away = np.linalg.norm(places - places[-1], axis=1)
    far = np.flatnonzero(away > 0.5)
    start = int(far[-1]) if len(far) else 0
    way: Floats = places[-1] - places[start]
    return way if np.linalg.norm(way) > 1e-6 else -clash.normal


def _level(way: Floats, up: Floats) -> tuple[Floats, Floats]:
    """Return the horizontal unit vector along a way, and the one to its right."""
    ahead = way - up * (way @ up)
    if np.linalg.norm(ahead) < 1e-6:
        ahead = np.cross(up, [1.0, 0.0, 0.0] if abs(up[0]) < 0.9 else [0.0, 1.0, 0.0])
    ahead /= np.linalg.norm(ahead)
    return ahead, np.cross(ahead, up)
