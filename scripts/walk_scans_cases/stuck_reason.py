"""Reason why a walk ended before its goal: what the person touches, and how wide the way is."""

import numpy as np
from numpy.typing import NDArray
from solidcloud.server.scene import Scene

from .persons import HEIGHT
from .route_walk import AVATAR, FRAME, Walked
from .routes import Scan

Floats = NDArray[np.float64]

# The way ahead: this far, and this far to both sides [m]. Points lower than _TALL above the feet, such
# as steps, do not make it narrower [m].
_AHEAD, _ASIDE, _TALL = 0.6, 2.0, 0.75
# A push whose share into a surface is larger than this is head on, and slides nowhere.
_HEAD_ON = 0.99
# Distances from the touched surface from which the motion is tried again [m].
_LIFTS = np.arange(0.001, 0.0605, 0.001)


def stuck_reason(scene: Scene, scan: Scan, walked: Walked, feet: float, points: Floats) -> dict[str, object]:
    """Return where and why a person does not move, as plain values [m].

    scene: has the person.  feet: height of the feet.  points: (n, 3), of the scan.
    """
    pose, state = walked.poses[-1], walked.states[-1]
    way = walked.commands[-1].velocity
    way = way / max(float(np.linalg.norm(way)), 1e-9)
    nearest = scene.distance(AVATAR, pose, 0.1)
    touched = [
        {
            "place": _round(each.place),
            "above feet": round(each.place[scan.up] - feet, 3),
            "normal": None if each.normal is None else _round(each.normal),
            "way into it": None if each.normal is None else round(-float(way @ np.array(each.normal)), 3),
            "lift needed": None if each.normal is None else _lift(scene, pose, way, np.array(each.normal)),
        }
        for each in state.touched
    ]
    return {
        "why": walked.why,
        "place": _round(pose[:3, 3]),
        "way": _round(way),
        "on ground": bool(state.ground is not None and state.ground.on_ground),
        "touched": touched,
        "nearest pair": {
            "distance": round(float(nearest.signed_distance[0]), 4),
            "scan point": _round(nearest.witness_cloud),
            "normal": _round(nearest.normal),
            "way into it": round(-float(way @ np.ravel(nearest.normal)), 3),
        },
        "gap ahead": _gap(scan, points, pose[:3, 3], feet, way),
    }


def _lift(scene: Scene, pose: Floats, way: Floats, normal: Floats) -> float | None:
    """Return the least distance from a surface from which half a frame's slide along it is free [m].

    None: not within 6 cm, or the push is head on.
    """
    if -way @ normal > _HEAD_ON:
        return None
    along = (way - (way @ normal) * normal) * FRAME
    starts = np.tile(pose, (len(_LIFTS), 1, 1))
    starts[:, :3, 3] += _LIFTS[:, None] * normal
    ends = starts.copy()
    ends[:, :3, 3] += along
    clear = scene.collide(AVATAR, starts).verdict == 0
    free = clear & (scene.sweep(AVATAR, starts, ends).lower > 0.5)
    return round(float(_LIFTS[free.argmax()]), 3) if free.any() else None


def _gap(scan: Scan, points: Floats, place: Floats, feet: float, way: Floats) -> dict[str, float]:
    """Return the gap across the way around the person's axis; its ends from the axis, left positive.

    An end of 2 m means that there is none.
    """
    side = np.cross(scan.up_vector(), way)
    high = points[:, scan.up] - feet
    near = points[(high > _TALL) & (high < HEIGHT)] - place
    ahead, aside = near @ way, near @ side
    aside = aside[(ahead > 0.0) & (ahead < _AHEAD) & (np.abs(aside) < _ASIDE)]
    low = float(aside[aside < 0.0].max(initial=-_ASIDE))
    high_end = float(aside[aside >= 0.0].min(initial=_ASIDE))
    return {"width": round(high_end - low, 3), "from": round(low, 3), "to": round(high_end, 3)}


def _round(values: object) -> list[float]:
    return np.ravel(np.array(values, np.float64)).round(4).tolist()
