"""Surroundings of a clash, for its picture: points of the scan, the avatar, and the contacts."""

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ...schemas.wire.tile_messages import MAX_DETAIL, TileAnswer, VoxelsAnswer
from .clash_list import Clash
from .clash_snapshot import Cloud, Colours

Floats = NDArray[np.float64]

# How far from a clash the scan is drawn [m], and with at most how many points.
REACH, MOST_POINTS = 14.0, 400_000
_AVATAR, _CONTACT = (95, 211, 196), (255, 84, 72)
_LIGHT = np.array([0.6, -0.7, 0.39])
_LOW, _HIGH = np.array([58.0, 84.0, 128.0]), np.array([226.0, 230.0, 224.0])


class PictureSource(Protocol):
    """A `Client` or a `Scene`."""

    def voxels(self, place: Any, reach: float | None = None, limit: int = 4096) -> VoxelsAnswer: ...
    def tile(self, archive: int, voxel: Any, detail: int = 0, level: int | None = None) -> TileAnswer: ...


def surroundings(
    scene: PictureSource, clash: Clash, pose: Floats, avatar: Floats, contacts: Floats, up: Floats
) -> list[Cloud]:
    """Return the scan near a clash, the avatar at its deepest pose, and its contacts.

    pose: (4, 4), avatar to world.  avatar: (n, 3), its points, avatar frame [m].
    contacts: (p, 3), scan points in contact, world [m].  Raise the server's errors.
    """
    clouds = scan_points(scene, clash.place, up)
    body = avatar @ pose[:3, :3].T + pose[:3, 3]
    size = np.ptp(avatar, axis=0)
    area = 2 * (size[0] * size[1] + size[1] * size[2] + size[2] * size[0])
    radius = max(0.008, 0.5 * float(np.sqrt(0.55 * area / len(avatar))))
    clouds.append(Cloud(body, _lit(body, up), radius))
    clouds.append(Cloud(contacts, _plain(len(contacts), _CONTACT), 0.02, over=True))
    return clouds


def scan_points(scene: PictureSource, place: Floats, up: Floats) -> list[Cloud]:
    """Return points of the scan near a place (3,), world [m], one cloud for each voxel."""
    near = scene.voxels(place, REACH)
    clouds = []
    # Nearest first, in full; a coarser detail has half the budget of the one before.
    detail, left = 0, MOST_POINTS / 2
    for number in range(len(near.voxel)):
        archive, count = int(near.archive[number]), int(near.points[number])
        while count / 4**detail > left and detail < MAX_DETAIL:
            detail, left = detail + 1, max(left, MOST_POINTS / 2 ** (detail + 2))
        left -= count / 4**detail
        tile = scene.tile(archive, near.voxel[number].tolist(), detail)
        matrix = tile.pose[0]
        points = tile.points * tile.step @ matrix[:3, :3].T + matrix[:3, 3]
        colours = tile.rgb if len(tile.rgb) and tile.rgb.any() else _by_height(points, place, up)
        clouds.append(Cloud(points, colours, max(0.008, 1.7 * tile.radius * 2**detail)))
    return clouds


def _by_height(points: Floats, place: Floats, up: Floats) -> Colours:
    """Return colours (n, 3) of points by their height above a place."""
    share = np.clip(((points - place) @ up + 2.0) / 7.0, 0.0, 1.0)[:, None]
    return np.round(_LOW + (_HIGH - _LOW) * share).astype(np.uint8)


def _lit(body: Floats, up: Floats) -> Colours:
    """Return colours (n, 3) of an avatar's points, lighter on one side, so that it looks round."""
    out = body - body.mean(axis=0)
    out -= np.outer(out @ up, up)
    out /= np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-9)
    light = 0.72 + 0.28 * out @ _LIGHT
    return np.round(np.array(_AVATAR) * light[:, None]).astype(np.uint8)


def _plain(count: int, colour: tuple[int, int, int]) -> Colours:
    """Return colours (n, 3) that are all the same."""
    return np.tile(np.array(colour, np.uint8), (count, 1))
