"""Parts of a user's frame in one call: the motion command and `slide` (motions.py), `step` and `ground`.

`ground` stands on the ground or falls. It keeps the plane of the ground between frames and searches for
ground below; see effects/motion_effects.py.
"""

from typing import NamedTuple

import numpy as np

from ....schemas.runtime import compiling as nb
from ..bodies.leave_contact import find_heights
from ..motion.sweep_resident import MIN_MOTION
from ..motion.vector_tuples import (
    Vector,
    copy_pose,
    divided,
    dot,
    minus,
    norm,
    place_of,
    plus,
    put,
    rotate_back,
    times,
    translated,
    vector,
)
from .motions import (
    advance_by,
    follow_command,
    keep_rest,
    move_to,
    record_hit,
    settle_before,
    slide_along,
    slide_command,
)
from .queries import first_hit, hit_normal, lands, nearest_point, pair_of, scan_normal
from .state import (
    CONTACT,
    FOLLOW,
    GROUND,
    PARTS,
    SLIDE,
    STEP,
    UNKNOWN,
    Walk,
    blocked_pose,
    place_now,
    pose_now,
)


@nb.njit(nogil=True, cache=True)
def walk_frame(parts, given):
    """Run parts of a frame of one user, or raise AskedError for Python to answer a query.

    parts: bits of FOLLOW to GROUND.  given: the fields of `Walk`.
    """
    walk = Walk(*given)
    memory = walk.memory
    if memory.log[0].repeats:
        memory.state[0] = memory.saved_state[0]
        _copy_poses(memory.saved_poses, memory.poses)
    else:
        _clear_log(memory.log[0])
        memory.saved_state[0] = memory.state[0]
        _copy_poses(memory.poses, memory.saved_poses)
    state = memory.state[0]
    if parts & FOLLOW:
        state.part = 0
        follow_command(walk)
    if parts & SLIDE:
        state.part = 1
        slide_command(walk)
    if parts & STEP:
        state.part = 2
        step_up(walk)
    if parts & GROUND:
        state.part = 3
        stand_on_ground(walk)


@nb.njit(nogil=True, cache=True)
def _clear_log(log):
    """Clear what a call counts anew."""
    log.used, log.missed, log.apart = 0, False, 0
    for part in range(PARTS):
        log.visits[part] = 0


@nb.njit(nogil=True, cache=True)
def _copy_poses(source, target):
    """Save the poses that a part changes, or restore them. Hits are restored by their number."""
    for n in range(source.shape[0]):
        copy_pose(source[n], target[n])


# A point belongs to the last ground if it is within these distances of its plane and of the point of
# it that was touched last [m]: a person's feet are 0.3 to 0.65 m apart. With 0.3 m, 639 of the 1,200
# frames of the façade's walk estimated a normal; with 0.75 m, 61 do.
SAME_FLOOR, SAME_FLOOR_REACH = 5e-3, 0.75
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
# Feet this near to their target height are not moved [m], so that an avatar at rest stays at rest.
DEAD_BAND = 1e-4
# A standing avatar that moves keeps its height within this share of `clearance`. A floor's bumps
# would otherwise move it up and down in every frame, each time by a swept motion. Of the 1,200
# frames of the façade's walk, 1,017 take two queries with this band, 558 without it.
HEIGHT_BAND = 0.2
# The same band beside a wall, whose bumps obstruct motion up and down [m].
WALL_BAND = 5e-3
# An avatar that pushes against something is not lowered again within this distance of the place where
# it was raised [m]. With a part wedged under a slope or over the edge of a sheet, the heights of the
# ground a millimetre apart may differ by centimetres. It would rise and sink in turn.
SAME_PLACE = 5e-3
# For `search_below`: the search within the near reach has not been made.
NOT_SEARCHED = -2
# Longest time for which gravity acts in one frame [s].
LONGEST_FRAME = 0.1


@nb.njit(nogil=True, cache=True)
def lowest_height(walk, pose):
    """Return the lowest height of the spheres of the avatar, not empty, under a pose, along `up` [m]."""
    up, direction, heights = vector(walk.settings[0].up), np.empty((1, 3)), np.empty(1)
    put(direction[0], times(-1.0, rotate_back(pose, up)))
    find_heights(walk.avatar, direction, heights)
    return dot(place_of(pose), up) - heights[0] - walk.avatar.radius


@nb.njit(nogil=True, cache=True)
def old_plane(walk):
    """Return the point and the normal of the plane that the avatar stood on."""
    before = walk.memory.before[0]
    return vector(before.plane[0]), vector(before.plane[1])


@nb.njit(nogil=True, cache=True)
def is_last_ground(walk, hit):
    """Return whether a hit is of the plane that the avatar stood on."""
    memory = walk.memory
    result = memory.tape[hit]
    if not memory.before[0].has_plane or result.archive < 0 or not result.has_pair:
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
    if result.archive < 0 or not result.has_pair:
        return
    _, place = pair_of(walk, hit)
    if same:
        point, _ = old_plane(walk)
        place = minus(place, times(dot(minus(place, point), normal), normal))
    memory.state[0].has_plane = True
    put(memory.state[0].plane[0], place)
    put(memory.state[0].plane[1], normal)


@nb.njit(nogil=True, cache=True)
def is_held_above_ground(walk, hit, reach):
    """Return whether only the body is held, above the ground that the avatar stood on.

    A body that is wedged, for example between two stray points, has no clear way down, although
    its feet are at the floor. It would fall a little in each frame, and be raised again.
    hit: the contact below.  reach: height up to which contacts are with ground or steps [m].
    """
    memory, up = walk.memory, vector(walk.settings[0].up)
    if not memory.before[0].has_plane or not memory.tape[hit].has_pair or walk.avatar.points.shape[0] == 0:
        return False
    pose = pose_now(walk)
    feet, place = lowest_height(walk, pose), place_of(pose)
    (_, cloud), (point, normal) = pair_of(walk, hit), old_plane(walk)
    if dot(cloud, up) - feet <= reach:
        return False
    way = minus(plus(place, times(feet - dot(place, up), up)), point)
    return 0.0 <= dot(way, normal) <= reach and norm(way) <= SAME_FLOOR_REACH


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
    normal: Vector
    same: bool
    aside: bool


@nb.njit(nogil=True, cache=True)
def first_below(walk, reach):
    """Return the first hit straight down from the frame's pose within `reach` [m]."""
    to = translated(pose_now(walk), times(-reach, vector(walk.settings[0].up)))
    return first_hit(walk, to, True)


@nb.njit(nogil=True, cache=True)
def _beside_walls(walk):
    """Return whether walls beside the avatar ended motions, and the displacement away from the last."""
    memory, up = walk.memory, vector(walk.settings[0].up)
    found, aside = False, (0.0, 0.0, 0.0)
    for n in range(max(0, memory.state[0].hits - MAX_WALLS), memory.state[0].hits):
        known, normal = memory.hits[n].has_normal, vector(memory.hits[n].normal)
        if not known:
            result = memory.tape[memory.hits[n].row]
            known = result.has_normal
            normal = vector(result.normal)
        if known and abs(dot(normal, up)) < EDGE_RISES:
            aside = times(WALL_OFFSETS[0], normal)
            found = aside[0] != 0.0 or aside[1] != 0.0 or aside[2] != 0.0
    return found, aside


@nb.njit(nogil=True, cache=True)
def search_below(walk, reach, near):
    """Find the first contact straight down from the frame's pose within `reach` [m].

    near: result of the search within the near reach, or NOT_SEARCHED.
    Bumps of a wall beside the avatar may end the motion. After a contact that is too steep, the
    search is therefore repeated slightly away from it.
    """
    begin, near_reach = pose_now(walk).copy(), walk.settings[0].near_reach
    moved, aside = _beside_walls(walk)
    first = GroundBelow(-1, reach, reach, False, (0.0, 0.0, 0.0), False, moved)
    for offset in WALL_OFFSETS:  # away from the contact before
        if moved:
            move_to(walk, translated(begin, aside))
        # Ground is nearly always near, and a short sweep takes half the time.
        far = min(reach, near_reach)
        hit = first_below(walk, far) if near == NOT_SEARCHED else near
        near = NOT_SEARCHED
        if hit < 0 and far < reach:
            far = reach
            hit = first_below(walk, far)
        move_to(walk, begin)
        free, is_known, stands, normal, same = far, False, False, (0.0, 0.0, 0.0), False
        if hit >= 0:
            result = walk.memory.tape[hit]
            free, is_known = result.lower * far, result.verdict != UNKNOWN
        if is_known:
            stands, normal, same = walkable_normal(walk, hit)
        found = GroundBelow(hit, far, free, stands, normal, same, moved)
        if stands or not is_known:
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
    if not walk.memory.tape[hit].has_pair:
        return False, (0.0, 0.0, 0.0)
    up = vector(walk.settings[0].up)
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
    result, up, none = walk.memory.tape[hit], vector(walk.settings[0].up), (0.0, 0.0, 0.0)
    if not result.has_pair:
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
    rises, walkable = dot(normal, up), walk.settings[0].walkable
    if rises >= walkable:
        return True, normal, False
    level = minus(normal, times(rises, up))
    steep = norm(level)
    if result.archive < 0 or steep == 0.0:
        return False, none, False
    if rises <= EDGE_RISES and dot(out, up) < EDGE_ABOVE * length:
        return False, none, False
    inner = nearest_point(walk, minus(cloud, times(EDGE_DISTANCE / steep, level)), EDGE_REACH)
    if inner < 0:
        return False, none, False
    _, there = pair_of(walk, inner)
    archive = walk.memory.tape[inner].archive
    known, top = scan_normal(walk, archive, there, minus(plus(there, up), there), 0)
    return known and dot(top, up) >= walkable, top, False


@nb.njit(nogil=True, cache=True)
def move_by(walk, way, upright):
    """Move by a displacement [m], sliding along touched surfaces; upright: as in `slide_along`."""
    state, begin = walk.memory.state[0], place_now(walk)
    hits = state.hits
    hit = advance_by(walk, way)
    if hit >= 0 and walk.settings[0].slides:
        gone = minus(place_now(walk), begin)
        slide_along(walk, hit, minus(way, gone), way, upright)
    state.hits = hits


@nb.njit(nogil=True, cache=True)
def lower_by(walk, below, way):
    """Move straight down by a distance `way` [m], within the distance found free."""
    if way <= 0.0:
        return
    up = vector(walk.settings[0].up)
    in_contact = walk.memory.state[0].verdict == CONTACT
    if not below.aside and not walk.bodies and not in_contact:  # the search left out bodies beside the avatar
        down = translated(pose_now(walk), times(-below.reach, up))
        settle_before(walk, down, way / below.reach, below.free / below.reach if below.hit >= 0 else 1.0)
    else:
        move_by(walk, times(-way, up), False)


@nb.njit(nogil=True, cache=True)
def stand_on_ground(walk):
    """Move the avatar to its height above the ground, or let it fall."""
    memory, settings = walk.memory, walk.settings[0]
    state, before = memory.state[0], memory.before[0]
    stood, up = before.stood, vector(settings.up)
    near = NOT_SEARCHED
    if stood and state.hits == 0:
        near = first_below(walk, settings.near_reach)
        if near >= 0 and _keeps_height(walk, near):
            return
    seconds = min(before.seconds, LONGEST_FRAME)
    speed = 0.0 if stood else before.fall_speed
    after = min(speed + settings.gravity * seconds, settings.max_speed)
    fall = 0.5 * (speed + after) * seconds
    below = search_below(walk, max(settings.down if stood else 0.0, fall + settings.clearance), near)
    hit, stands, fall_speed = below.hit, False, after
    has_normal, normal = below.stands, below.normal
    if hit < 0 and not _would_land(walk, below.reach, stood):
        stands, fall_speed = stood, 0.0
    elif hit < 0:
        lower_by(walk, below, fall)
    elif memory.tape[hit].verdict == UNKNOWN:
        # Something below is unknown, so there may be ground: the avatar does not fall.
        record_hit(walk, hit, pose_now(walk))
        lower_by(walk, below, min(fall, below.free - settings.clearance))
        stands, fall_speed = stood, 0.0
    elif below.stands:
        stands, fall_speed = True, 0.0
        lower = below.free - settings.clearance
        store_ground(walk, hit, normal, below.same)
        band = max(DEAD_BAND, HEIGHT_BAND * settings.clearance) if stood else DEAD_BAND
        if below.aside:
            band = max(band, WALL_BAND)
        if lower > band:
            if not _was_raised_here(walk):
                lower_by(walk, below, lower)
        elif lower < -band:
            move_by(walk, times(-lower, up), False)
            state.raised = True
            put(state.raised_at, place_now(walk))
    elif stood and is_held_above_ground(walk, hit, settings.down):
        stands, fall_speed = True, 0.0
        has_normal, (_, normal) = True, old_plane(walk)
    else:
        begin = place_now(walk)
        move_by(walk, times(-fall, up), False)
        fell = -dot(minus(place_now(walk), begin), up)
        if seconds > 0.0:
            fall_speed = min(fall_speed, max(fell, 0.0) / seconds)
    _report(walk, stands, fall_speed, has_normal, normal)


@nb.njit(nogil=True, cache=True)
def _report(walk, stands, fall_speed, has_normal, normal):
    """Write the results of the effect."""
    state = walk.memory.state[0]
    state.grounded, state.stands, state.has_ground, state.fall_speed = True, stands, has_normal, fall_speed
    put(state.ground, normal)


@nb.njit(nogil=True, cache=True)
def _keeps_height(walk, hit):
    """Finish the frame of an avatar that stands on its last ground at its height, as most do.

    hit: the first contact straight down, within the near reach. Return False if the avatar has to
    move, or stands on other ground.
    """
    settings, result = walk.settings[0], walk.memory.tape[hit]
    lower = result.lower * settings.near_reach - settings.clearance
    if result.verdict == UNKNOWN or abs(lower) > max(DEAD_BAND, HEIGHT_BAND * settings.clearance):
        return False
    if not is_last_ground(walk, hit):
        return False
    _, normal = old_plane(walk)
    store_ground(walk, hit, normal, True)
    _report(walk, True, 0.0, True, normal)
    return True


@nb.njit(nogil=True, cache=True)
def _would_land(walk, reach, stood):
    """Return whether an avatar without ground within `reach` [m] of its feet may land."""
    row = lands(walk, reach, stood)
    result = walk.memory.tape[row]
    if result.unloaded:
        # Whether it would land is not known until the voxels below are in memory: it waits there.
        result.verdict, result.archive, result.has_pair, result.lower = UNKNOWN, -1, False, 0.0
        record_hit(walk, row, pose_now(walk))
        return False
    return result.answer


@nb.njit(nogil=True, cache=True)
def _was_raised_here(walk):
    """Return whether the avatar pushes against something where it was raised before."""
    memory = walk.memory
    if not memory.before[0].was_raised or memory.state[0].blocked < 0 or not memory.before[0].stood:
        return False
    place = vector(memory.before[0].raised_at)
    return norm(minus(place_now(walk), place)) <= SAME_PLACE


# The climb must lead this much farther than sliding [m], and by this share of the remainder.
MIN_CLIMB_GAIN, MIN_CLIMB_GAIN_SHARE = 2e-4, 0.02
# If sliding led along this share of the motion command, only its first obstacle may be a step.
SLID_SHARE = 0.5


@nb.njit(nogil=True, cache=True)
def step_up(walk):
    """Climb the obstacle that stopped the motion command, if possible."""
    memory, settings, state = walk.memory, walk.settings[0], walk.memory.state[0]
    hit = state.blocked
    if hit < 0 or not memory.before[0].stood or not memory.tape[hit].has_pair:
        return
    begin = place_of(memory.begin)
    command = minus(place_of(memory.target), begin)
    length = norm(command)
    if length < MIN_MOTION:
        return
    along = divided(command, length)
    so_far = dot(minus(place_now(walk), begin), along)
    top = lowest_height(walk, blocked_pose(walk)) + settings.step
    low = _is_low(walk, hit, top)
    if not so_far > SLID_SHARE * length:
        # Beside a wall that is touched first, a step is touched while sliding.
        for n in range(state.hits):
            low |= _is_low(walk, memory.hits[n].row, top)
    least = so_far + max(MIN_CLIMB_GAIN, MIN_CLIMB_GAIN_SHARE * (length - so_far))
    if not low or least >= length:  # walls
        return
    before, hits, verdict = pose_now(walk).copy(), state.hits, state.verdict
    move_to(walk, blocked_pose(walk))
    climbed, rose = _climb(walk, along, length, least)
    if climbed:
        state.stepped = max(rose, 0.0)
        keep_rest(walk, rose)
    else:
        move_to(walk, before)
        state.verdict = verdict
    state.hits = hits


@nb.njit(nogil=True, cache=True)
def _is_low(walk, hit, top):
    """Return whether a hit is at most at the height `top` [m], or without a place it is not."""
    if not walk.memory.tape[hit].has_pair:
        return False
    _, cloud = pair_of(walk, hit)
    return not dot(cloud, vector(walk.settings[0].up)) > top


@nb.njit(nogil=True, cache=True)
def _climb(walk, along, length, least):
    """Move up, forward and down from the frame's pose.

    along: unit vector, horizontal direction.  length: [m].  least: least gain along it [m].
    Return whether the motion ends on ground that is not too high, and the height gained [m].
    """
    settings, begin = walk.settings[0], place_of(walk.memory.begin)
    up, start = vector(settings.up), place_now(walk)
    move_by(walk, times(settings.step, up), False)  # sliding avoids the bumps of the riser
    rose = dot(minus(place_now(walk), start), up)
    if rose < MIN_MOTION:
        return False, rose
    gone = dot(minus(place_now(walk), begin), along)
    move_by(walk, times(length - gone, along), True)  # along a jamb beside the step
    if dot(minus(place_now(walk), begin), along) < least:
        return False, rose
    below = search_below(walk, rose + 2.0 * settings.clearance, NOT_SEARCHED)
    if not below.stands:
        return False, rose
    lower = below.free - settings.clearance
    if rose - lower > settings.step + DEAD_BAND:
        return False, rose
    lower_by(walk, below, lower)
    # Sliding down along a surface may have moved the avatar back.
    if dot(minus(place_now(walk), begin), along) < least:
        return False, rose
    return True, dot(minus(place_now(walk), start), up)
