"""Plane of the ground that an avatar stands on, kept between frames."""

from ....schemas.kernels import compiling as nb
from .walk_queries import pair_of
from .walk_state import (
    ARCHIVE,
    HAD_PLANE,
    HAS_PAIR,
    HAS_PLANE,
    PLANE,
    pose_now,
)
from .walk_vectors import dot, lowest_height, minus, norm, place_of, plus, times, vector

# A point belongs to the last ground if it is within these distances of its plane and of the point of
# it that was touched last [m]: a person's feet are 0.3 to 0.65 m apart. With 0.3 m, 639 of the 1,200
# frames of the façade's walk estimated a normal; with 0.75 m, 61 do.
SAME_FLOOR, SAME_FLOOR_REACH = 5e-3, 0.75


@nb.njit(nogil=True, cache=True)
def old_plane(walk):
    """Return the point and the normal of the plane that the avatar stood on."""
    plane = walk.memory.old_plane
    return vector(plane), (plane[3], plane[4], plane[5])


@nb.njit(nogil=True, cache=True)
def is_last_ground(walk, hit):
    """Return whether a hit is of the plane that the avatar stood on."""
    memory = walk.memory
    result = memory.tape[hit]
    if memory.inputs[HAD_PLANE] == 0.0 or result[ARCHIVE] < 0.0 or result[HAS_PAIR] == 0.0:
        return False
    (_, cloud), (point, normal) = pair_of(walk, hit), old_plane(walk)
    way = minus(cloud, point)
    return abs(dot(way, normal)) <= SAME_FLOOR and dot(way, way) <= SAME_FLOOR_REACH**2


@nb.njit(nogil=True, cache=True)
def store_ground(walk, hit, normal, same):
    """Store the plane that the avatar stands on, and the point of it that was touched.

    same: whether the normal is that of the last ground. The plane then stays the same and only the
    point moves on it: ground that goes on in one plane is one ground.
    """
    memory = walk.memory
    result = memory.tape[hit]
    if result[ARCHIVE] < 0.0 or result[HAS_PAIR] == 0.0:
        return
    _, place = pair_of(walk, hit)
    if same:
        point, _ = old_plane(walk)
        place = minus(place, times(dot(minus(place, point), normal), normal))
    memory.numbers[HAS_PLANE] = 1
    for r in range(3):
        memory.values[PLANE + r], memory.values[PLANE + 3 + r] = place[r], normal[r]


@nb.njit(nogil=True, cache=True)
def is_held_above_ground(walk, hit, reach):
    """Return whether only the body is held, above the ground that the avatar stood on.

    A body that is wedged, for example between two stray points, has no clear way down, although
    its feet are at the floor. It would fall a little in each frame, and be raised again.
    hit: the contact below.  reach: height up to which contacts are with ground or steps [m].
    """
    memory, avatar, up = walk.memory, walk.avatar, vector(walk.settings.up)
    if memory.inputs[HAD_PLANE] == 0.0 or memory.tape[hit, HAS_PAIR] == 0.0 or avatar.points.shape[0] == 0:
        return False
    pose = pose_now(walk)
    feet, place = lowest_height(avatar.points, avatar.radius, pose, up), place_of(pose)
    (_, cloud), (point, normal) = pair_of(walk, hit), old_plane(walk)
    if dot(cloud, up) - feet <= reach:
        return False
    way = minus(plus(place, times(feet - dot(place, up), up)), point)
    return 0.0 <= dot(way, normal) <= reach and norm(way) <= SAME_FLOOR_REACH
