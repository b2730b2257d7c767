"""Search for ground below a walking avatar, and vertical motions; see effects/motion_effects.py."""

from typing import NamedTuple

import numpy as np

from ....schemas.kernels import compiling as nb
from ..motion.sweep_resident import LOWER
from .ground_plane import is_last_ground, old_plane
from .slide_along import slide_along
from .walk_motions import advance, move_to, settle_before
from .walk_normals import hit_normal, scan_normal
from .walk_queries import first_hit, nearest_point, pair_of
from .walk_state import (
    ARCHIVE,
    CONTACT,
    FRAME_VERDICT,
    HAS_NORMAL,
    HAS_PAIR,
    HITS,
    NORMAL,
    UNKNOWN,
    VERDICT,
    pose_now,
)
from .walk_vectors import copy_pose, divided, dot, minus, norm, place_of, plus, times, translated, vector

# Distance past an edge at which the surface behind it is tested, and the radius of that test [m].
# Points of treads of scanned stairs were 47 and 64 mm from there (scripts/walk_scans).
EDGE_DISTANCE, EDGE_REACH = 0.08, 0.08
# Least vertical component of a normal at an edge. A normal that is nearer to level belongs to the
# side of an object: points of both sides of an edge give a normal of some 45 degrees.
EDGE_RISES = 0.15
# Where a scan has few points of a tread, the normal at its edge is the riser's. It is an edge all the
# same if the touching sphere is above the touched one: least vertical component of their direction.
EDGE_ABOVE = 0.5
# Distances from a wall at which ground is searched for, one after the other [m]. Feet pushed against
# the foot of a slope that is too steep are above it by their clearance: with 3 cm, the floor is 5 cm
# aside at 30 degrees.
WALL_OFFSETS = (0.01, 0.05, 0.0)
MAX_WALLS = 3


class GroundBelow(NamedTuple):
    """Result of a search for ground straight down.

    hit: end of the downward motion; -1 if nothing is touched.  reach: distance searched [m].
    free: distance within which nothing is touched [m].
    stands: whether there is ground, not too steep.  normal: its unit normal.  same: whether that is
    the normal of the last ground.
    aside: whether the ground was found slightly aside, away from a steep surface.
    """

    hit: int
    reach: float
    free: float
    stands: bool
    normal: tuple[float, float, float]
    same: bool
    aside: bool


@nb.njit(nogil=True, cache=True)
def first_below(walk, reach):
    """Return the first hit straight down from the frame's pose within `reach` [m]."""
    to = translated(pose_now(walk), times(-reach, vector(walk.settings.up)))
    return first_hit(walk, to, walk.settings.tolerance, -1.0, True)


@nb.njit(nogil=True, cache=True)
def _beside_walls(walk):
    """Return whether walls beside the avatar ended motions, and the displacement away from the last."""
    memory, up = walk.memory, vector(walk.settings.up)
    found, aside = False, (0.0, 0.0, 0.0)
    for n in range(max(0, memory.numbers[HITS] - MAX_WALLS), memory.numbers[HITS]):
        known = memory.normals[n, 0] != 0.0
        normal = vector(memory.normals[n, 1:4])
        if not known:
            result = memory.tape[memory.hits[n]]
            known = result[HAS_NORMAL] != 0.0
            normal = vector(result[NORMAL : NORMAL + 3])
        if known and abs(dot(normal, up)) < EDGE_RISES:
            aside = times(WALL_OFFSETS[0], normal)
            found = aside[0] != 0.0 or aside[1] != 0.0 or aside[2] != 0.0
    return found, aside


@nb.njit(nogil=True, cache=True)
def search_below(walk, reach, near_known, near):
    """Find the first contact straight down from the frame's pose within `reach` [m].

    near_known: whether the search within the near reach has been made.  near: its result.
    Bumps of a wall beside the avatar may end the motion. After a contact that is too steep, the
    search is therefore repeated slightly away from it.
    """
    begin, near_reach = np.empty((4, 4)), walk.settings.near_reach
    copy_pose(pose_now(walk), begin)
    moved, aside = _beside_walls(walk)
    first = GroundBelow(-1, reach, reach, False, (0.0, 0.0, 0.0), False, moved)
    for offset in WALL_OFFSETS:  # away from the contact before
        if moved:
            move_to(walk, translated(begin, aside))
        # Ground is nearly always near, and a short sweep takes half the time.
        far = min(reach, near_reach)
        hit = near if near_known else first_below(walk, far)
        near_known = False
        if hit < 0 and far < reach:
            far = reach
            hit = first_below(walk, far)
        move_to(walk, begin)
        if hit < 0:
            return GroundBelow(-1, far, far, False, (0.0, 0.0, 0.0), False, moved)
        result = walk.memory.tape[hit]
        free = result[LOWER] * far
        if result[VERDICT] == UNKNOWN:
            return GroundBelow(hit, far, free, False, (0.0, 0.0, 0.0), False, moved)
        stands, normal, same = walkable_normal(walk, hit)
        found = GroundBelow(hit, far, free, stands, normal, same, moved)
        if stands:
            return found
        if first.hit < 0:
            first = found
        known, away = _away(walk, hit)
        if not known:
            break
        moved, aside = True, plus(aside, times(offset, away))
    return first


@nb.njit(nogil=True, cache=True)
def _away(walk, hit):
    """Return whether the direction away from a steep surface is known, and it: a horizontal unit vector."""
    if walk.memory.tape[hit, HAS_PAIR] == 0.0:
        return False, (0.0, 0.0, 0.0)
    up = vector(walk.settings.up)
    known, out = hit_normal(walk, hit, 0)
    if not known:
        own, cloud = pair_of(walk, hit)
        out = minus(own, cloud)
    level = minus(out, times(dot(out, up), up))
    length = norm(level)
    return (False, level) if length == 0.0 else (True, divided(level, length))


@nb.njit(nogil=True, cache=True)
def walkable_normal(walk, hit):
    """Return whether a touched surface can be stood on, its normal, and whether that is the last ground's.

    The points around an edge, for example of a stair, have a slanting normal. An avatar can
    stand on an edge if the surface farther in, at its height, is ground.
    """
    result, up, none = walk.memory.tape[hit], vector(walk.settings.up), (0.0, 0.0, 0.0)
    if result[HAS_PAIR] == 0.0:
        return False, none, False
    if is_last_ground(walk, hit):
        _, normal = old_plane(walk)
        return True, normal, True  # estimating a normal takes half a sweep's time
    own, cloud = pair_of(walk, hit)
    out = minus(own, cloud)
    length = norm(out)
    known, normal = hit_normal(walk, hit, 0)
    if not known:
        normal = divided(out, length) if length > 0.0 else up
    rises, walkable = dot(normal, up), walk.settings.walkable
    if rises >= walkable:
        return True, normal, False
    level = minus(normal, times(rises, up))
    steep = norm(level)
    if result[ARCHIVE] < 0.0 or steep == 0.0:
        return False, none, False
    if rises <= EDGE_RISES and dot(out, up) < EDGE_ABOVE * length:
        return False, none, False
    inner = nearest_point(walk, minus(cloud, times(EDGE_DISTANCE / steep, level)), EDGE_REACH)
    if inner < 0:
        return False, none, False
    _, there = pair_of(walk, inner)
    archive = walk.memory.tape[inner, ARCHIVE]
    known, top = scan_normal(walk, archive, there, minus(plus(there, up), there), 0)
    return known and dot(top, up) >= walkable, top, False


@nb.njit(nogil=True, cache=True)
def move_by(walk, way, upright):
    """Move by a displacement [m], sliding along touched surfaces; upright: as in `slide_along`."""
    numbers, begin = walk.memory.numbers, place_of(pose_now(walk))
    hits = numbers[HITS]
    hit = advance(walk, translated(pose_now(walk), way))
    if hit >= 0 and walk.settings.slides:
        gone = minus(place_of(pose_now(walk)), begin)
        slide_along(walk, hit, minus(way, gone), way, upright)
    numbers[HITS] = hits


@nb.njit(nogil=True, cache=True)
def lower_by(walk, below, way):
    """Move straight down by a distance `way` [m], within the distance found free."""
    if way <= 0.0:
        return
    up = vector(walk.settings.up)
    in_contact = walk.memory.numbers[FRAME_VERDICT] == CONTACT
    if not below.aside and not walk.bodies and not in_contact:  # the search left out bodies beside the avatar
        down = translated(pose_now(walk), times(-below.reach, up))
        settle_before(walk, down, way / below.reach, below.free / below.reach if below.hit >= 0 else 1.0)
    else:
        move_by(walk, times(-way, up), False)
