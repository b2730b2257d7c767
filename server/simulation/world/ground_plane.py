"""Plane of the ground that an avatar stands on, kept between frames for the effect `ground`."""

from .frame import Frame, Hit, Vec, lowest_height
from .vectors import dot, norm

# Name under which `Body.effect_state` keeps a point of the plane and its normal.
GROUND = "ground"
# A point belongs to the last ground if it is within these distances of its plane and of the point of
# it that was touched last [m]: a person's feet are 0.3 to 0.65 m apart. With 0.3 m, 639 of the 1,200
# frames of the façade's walk estimated a normal; with 0.75 m, 61 do.
_SAME_FLOOR, _SAME_FLOOR_REACH = 5e-3, 0.75


def last_normal(frame: Frame, hit: Hit) -> Vec | None:
    """Return the normal of the ground that the avatar stood on if a hit is of its plane, else None."""
    stood = frame.body.effect_state.get(GROUND)
    if stood is None or hit.archive < 0 or hit.cloud is None:
        return None
    point, normal = stood
    (x, y, z), (a, b, c), (u, v, w) = hit.cloud.tolist(), point.tolist(), normal.tolist()
    x, y, z = x - a, y - b, z - c
    same = abs(x * u + y * v + z * w) <= _SAME_FLOOR and x * x + y * y + z * z <= _SAME_FLOOR_REACH**2
    return normal if same else None


def store_ground(frame: Frame, hit: Hit, normal: Vec) -> None:
    """Store the plane that the avatar stands on, and the point of it that was touched.

    If the normal is that of the last ground, the plane stays the same and only the point moves
    on it: ground that goes on in one plane is one ground.
    """
    if hit.archive < 0 or hit.cloud is None:
        return
    stood, point = frame.body.effect_state.get(GROUND), hit.cloud
    if stood is not None and normal is stood[1]:
        point = point - dot(point - stood[0], normal) * normal
    frame.effect_state[GROUND] = point, normal


def held_above_ground(frame: Frame, hit: Hit, reach: float) -> Vec | None:
    """Return the normal of the last ground, if only the body is held, above that ground; else None.

    A body that is wedged, for example between two stray points, has no clear way down, although
    its feet are at the floor. It would fall a little in each frame, and be raised again.
    hit: the contact below.  reach: height up to which contacts are with ground or steps [m].
    """
    stood, avatar, up = frame.body.effect_state.get(GROUND), frame.body.avatar, frame.world.up
    if stood is None or hit.cloud is None or not len(avatar.points):
        return None
    feet, place = lowest_height(avatar, frame.pose, up), frame.pose[:3, 3]
    if dot(hit.cloud, up) - feet <= reach:
        return None
    way = place + (feet - dot(place, up)) * up - stood[0]
    near = 0.0 <= dot(way, stood[1]) <= reach and norm(way) <= _SAME_FLOOR_REACH
    return stood[1] if near else None
