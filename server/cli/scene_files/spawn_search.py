"""Search for a place where avatars stand on a floor, near the middle of a scene; z is up.

Only `collide` is used, which a server of the scene compiles first. In a column, an avatar lands
between a height where it touches the scan and the next height where it is clear. A landing is on a
floor if scan points surround the avatar's feet at their height.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ....schemas.wire.answers import CollideAnswers, Verdict
from ....schemas.wire.scene_messages import AvatarInfo, SceneInfo
from ...scene_interface import AvatarShape

_Floats = NDArray[np.float64]

# Height of the feet above the floor [m]: the default clearance of the effect `ground`.
CLEARANCE = 0.03
# Columns near the middle: their number along an axis and their distance [m]. If an avatar can stand
# on one level in less than this share of them, columns of the whole scene are tried too: the few may be
# the top of an arch or of a wall.
_NEAR_COLUMNS, _NEAR_DISTANCE, _NEAR_SHARE = 9, 0.5, 0.2
_ALL_COLUMNS = 15
# Heights tried in a column are this share of the avatars' height apart, and limited in number.
_STEP, _MAX_HEIGHTS = 0.3, 1000
# Resolution of a landing [m].
_RESOLUTION = 2e-3
# Feet are on a floor if at least _SUPPORT of the nine places at and around them have a scan point
# within _NEAR_FLOOR [m].
_SUPPORT, _NEAR_FLOOR = 7, 0.15
# Least distance of these places from the origin [m].
_LEAST_RING = 0.1
# Landings of one level differ by at most this height [m]. The spawn is on the lowest level that has
# at least _SHARE of the landings of the level with the most: not on a roof, not in a pit.
_LEVEL, _SHARE = 0.25, 0.5
# Poses of one request.
_POSES = 20_000
_PROBE = "spawn-search-probe"


class SearchedScene(Protocol):
    """Scene in which a place is searched: a `Scene`, or a `Client` of a server."""

    def info(self) -> SceneInfo: ...
    def add_avatar(self, name: str, points: Any, radius: float | None = None) -> AvatarInfo: ...
    def collide(self, name: str, poses: Any) -> CollideAnswers: ...


class Body(NamedTuple):
    """Avatars that must stand at the spawn, as one.

    names: their names in the scene.  foot, top: lowest and highest z of their spheres, avatar frame
    [m].  wide: largest horizontal distance from the origin [m].
    """

    names: Sequence[str]
    foot: float
    top: float
    wide: float


def add_body(scene: SearchedScene, avatars: Mapping[str, AvatarShape]) -> Body:
    """Add avatars to a scene, by name, and return them as one body."""
    foot, top, wide = np.inf, -np.inf, 0.0
    for name, shape in avatars.items():
        array = shape.surface
        made = scene.add_avatar(name, shape).radius or 0.0
        foot = min(foot, float(array[:, 2].min()) - made)
        top = max(top, float(array[:, 2].max()) + made)
        wide = max(wide, float(np.hypot(array[:, 0], array[:, 1]).max()))
    return Body(list(avatars), foot, top, wide)


def find_spawn(scene: SearchedScene, body: Body) -> tuple[float, float, float] | None:
    """Return a position of the avatars' origin where they stand clear on a floor [m].

    None if no such place is found.
    """
    info = scene.info()
    low, high = np.array(info.bounds)
    scene.add_avatar(_PROBE, [[0.0, 0.0, 0.0]], max(_NEAR_FLOOR, 3 * info.radius))
    middle = (low + high)[:2] / 2
    near = min(_NEAR_DISTANCE, *((high - low)[:2] / _NEAR_COLUMNS).tolist())
    spacings = (
        (_NEAR_COLUMNS, np.full(2, near)),
        (_ALL_COLUMNS, (high - low)[:2] / _ALL_COLUMNS),
    )
    places: _Floats = np.empty((0, 3))
    for count, spacing in spacings:
        offsets = np.arange(count) - count // 2
        columns = np.stack(np.meshgrid(offsets * spacing[0], offsets * spacing[1]), axis=-1).reshape(-1, 2)
        found = _standing_places(scene, body, np.round(middle + columns, 3), low[2], high[2])
        places = np.concatenate([places, found])
        if len(places) and len(_floor(places)) >= _NEAR_SHARE * _NEAR_COLUMNS**2:
            break
    return _nearest(_floor(places), middle) if len(places) else None


def _standing_places(scene: SearchedScene, body: Body, columns: _Floats, low: float, high: float) -> _Floats:
    """Return the positions (k, 3) in columns (c, 2) where the body stands clear on a floor [m].

    low, high: of the scan [m].
    """
    tall = body.top - body.foot
    step = max(_STEP * tall, (high - low + 2 * tall) / _MAX_HEIGHTS)
    heights = np.arange(low - tall, high + tall, step) - body.foot
    grid = np.concatenate(
        [np.repeat(columns, len(heights), axis=0), np.tile(heights, len(columns))[:, None]], axis=1
    )
    clear, touching = _verdicts(scene, body.names, grid)
    clear, touching = (flags.reshape(len(columns), -1) for flags in (clear, touching))
    above = np.flatnonzero((touching[:, :-1] & clear[:, 1:]).ravel())
    column, row = np.divmod(above, len(heights) - 1)
    place = np.concatenate([columns[column], heights[row + 1][:, None]], axis=1)
    touched = heights[row]
    while len(place) and (place[0, 2] - touched[0]) > _RESOLUTION:
        middle = np.column_stack([place[:, :2], (place[:, 2] + touched) / 2])
        clear, _ = _verdicts(scene, body.names, middle)
        place[clear, 2], touched[~clear] = middle[clear, 2], middle[~clear, 2]
    place[:, 2] = np.ceil((place[:, 2] + CLEARANCE) * 1e3) / 1e3
    clear, _ = _verdicts(scene, body.names, place)
    return place[clear & _on_floor(scene, body, place)]


def _on_floor(scene: SearchedScene, body: Body, places: _Floats) -> NDArray[np.bool_]:
    """Return at which places (k, 3) scan points surround the feet, at their height."""
    angles = np.arange(8) * (np.pi / 4)
    ring = np.stack([np.cos(angles), np.sin(angles), np.zeros(8)], axis=1) * max(body.wide, _LEAST_RING)
    offsets = np.vstack([np.zeros(3), ring])
    offsets[:, 2] = body.foot - CLEARANCE
    _, touching = _verdicts(scene, [_PROBE], (places[:, None] + offsets).reshape(-1, 3))
    found: NDArray[np.bool_] = touching.reshape(-1, len(offsets)).sum(axis=1) >= _SUPPORT
    return found


def _verdicts(
    scene: SearchedScene, names: Sequence[str], places: _Floats
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return at which places (k, 3) all avatars are clear, and at which one is in contact."""
    clear, touching = np.ones(len(places), bool), np.zeros(len(places), bool)
    for start in range(0, len(places), _POSES):
        part = slice(start, start + _POSES)
        poses = np.tile(np.eye(4), (len(places[part]), 1, 1))
        poses[:, :3, 3] = places[part]
        for name in names:
            verdict = scene.collide(name, poses).verdict
            clear[part] &= verdict == Verdict.CLEAR
            touching[part] |= verdict == Verdict.CONTACT
    return clear, touching


def _floor(places: _Floats) -> _Floats:
    """Return the places on the lowest level that has many."""
    levels = np.round(places[:, 2] / _LEVEL)
    found, counts = np.unique(levels, return_counts=True)
    level = found[np.argmax(counts >= _SHARE * counts.max())]
    return places[levels == level]


def _nearest(places: _Floats, middle: _Floats) -> tuple[float, float, float]:
    """Return the place nearest to the middle."""
    x, y, z = places[np.argmin(np.hypot(*(places[:, :2] - middle).T))].tolist()
    return round(x, 3), round(y, 3), round(z, 3)
