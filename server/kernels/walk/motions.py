"""Motions of a walking avatar: as far as nothing is touched, then along the touched surfaces, their
creases and corners; see effects/motion_effects.py.

With the effect `sweep`, a motion stops the skin before the first contact, at a pose that is clear by
`collide`. The sweep proves the pose clear if the pose is one of the sweep's bit for bit; otherwise
`collide` is queried. Without `sweep`, a motion leads to its end or nowhere.
"""

import math

import numpy as np

from ....schemas.runtime import compiling as nb
from ..core.kernel_decorators import njit_no_refcount
from ..core.normal_codes import MAX_NORMAL_REACH
from ..motion.sweep_resident import MIN_MOTION, skin_fraction
from ..motion.vector_tuples import (
    copy_pose,
    cross,
    divided,
    dot,
    minus,
    norm,
    place_of,
    put,
    same_pose,
    times,
    translated,
    vector,
)
from .queries import (
    contact_normal,
    farthest_motion,
    first_hit,
    gives_way,
    hit_at,
    hit_normal,
    is_clear,
    keep_point,
    pair_of,
    pose_on_way,
    scan_heights,
    touching_point,
)
from .state import CLEAR, CONTACT, UNKNOWN, blocked_pose, place_now, pose_now

# First step back from a pose that turns out not to be clear [m], and its growth factor.
FIRST_STEP_BACK, STEP_GROWTH = 1e-7, 4.0
# Limit of pushes of bodies in one motion.
MAX_PUSHES = 4


@nb.njit(nogil=True, cache=True)
def move_to(walk, pose):
    """Set the frame's pose (4, 4)."""
    copy_pose(pose, pose_now(walk))


@nb.njit(nogil=True, cache=True)
def record_hit(walk, hit, to):
    """Record the hit that ended a motion to a pose (4, 4)."""
    memory = walk.memory
    result, state = memory.tape[hit], memory.state[0]
    if result.unloaded:
        result.rest = norm(minus(place_of(to), place_now(walk)))
    memory.hits[state.hits].row, memory.hits[state.hits].has_normal = hit, False
    state.hits += 1
    if result.verdict == UNKNOWN and state.verdict == CLEAR:
        state.verdict = UNKNOWN


@nb.njit(nogil=True, cache=True)
def settle_before(walk, to, fraction, proved):
    """Move to the pose at `fraction` of the way to a pose (4, 4), or to a clear one before it.

    proved: fraction before which nothing touches. The avatar stays if the way is shorter than
    MIN_MOTION.
    """
    begin, pose = pose_now(walk), np.empty((4, 4))
    way, back = farthest_motion(walk, begin, to), 0.0
    while (fraction - back) * way >= MIN_MOTION:
        same = pose_on_way(walk, begin, to, fraction - back, pose)
        if is_clear(walk, pose, same and fraction - back < proved):
            move_to(walk, pose)
            return
        back = max(STEP_GROWTH * back, FIRST_STEP_BACK / way)


@nb.njit(nogil=True, cache=True)
def _skin_share(walk, to, hit):
    """Return the share of the motion to a pose (4, 4) by which to stop before a hit, to keep the skin."""
    skin, begin, result = walk.settings[0].skin, pose_now(walk), walk.memory.tape[hit]
    way = farthest_motion(walk, begin, to)
    if way <= 0.0 or skin <= 0.0:
        return 0.0
    if not result.has_pair:
        return skin / way
    point = vector(result.point) if result.has_point else touching_point(walk, to, hit)
    own, cloud = pair_of(walk, hit)
    return skin_fraction(begin, to, own, cloud, point, way, skin)


@nb.njit(nogil=True, cache=True)
def advance(walk, to):
    """Move towards a pose (4, 4) as far as nothing is touched; return the hit that ended the motion."""
    memory, hit = walk.memory, -1
    leaves = memory.state[0].verdict == CONTACT  # the frame began in contact
    if not (walk.settings[0].continuous or leaves):
        return _move_if_clear(walk, to)
    for _ in range(MAX_PUSHES):
        if same_pose(pose_now(walk), to):
            return -1
        hit = first_hit(walk, to, False)
        if hit < 0:
            move_to(walk, to)
            return -1
        result = memory.tape[hit]
        if result.has_end:
            end = np.empty((4, 4))
            copy_pose(result.end, end)
            if not walk.bodies or is_clear(walk, end, True):
                move_to(walk, end)
        else:
            keep_point(walk, to, hit)
            fraction = result.lower
            settle_before(walk, to, fraction - _skin_share(walk, to, hit), fraction)
        if not gives_way(walk, hit, to):
            break
    record_hit(walk, hit, to)
    return hit


@nb.njit(nogil=True, cache=True)
def advance_by(walk, way):
    """Advance by a displacement [m]; return the hit that ended the motion."""
    return advance(walk, translated(pose_now(walk), way))


@nb.njit(nogil=True, cache=True)
def _move_if_clear(walk, to):
    """Move to a pose (4, 4) if nothing is touched there; otherwise return the hit."""
    if same_pose(pose_now(walk), to):
        return -1
    memory = walk.memory
    hit = hit_at(walk, to)
    if hit >= 0 and gives_way(walk, hit, to):
        hit = hit_at(walk, to)
    if hit < 0:
        move_to(walk, to)
        memory.state[0].clear = True
        if memory.state[0].verdict == CONTACT:
            memory.state[0].verdict = CLEAR
        return -1
    memory.tape[hit].lower = 1.0
    keep_point(walk, to, hit)
    memory.tape[hit].lower = 0.0
    record_hit(walk, hit, to)
    return hit


@nb.njit(nogil=True, cache=True)
def follow_command(walk):
    """Move towards the commanded pose."""
    memory = walk.memory
    hit = advance(walk, memory.target)
    if hit >= 0 and memory.state[0].verdict == CONTACT:
        hit = _move_before_turn(walk, hit)
    memory.state[0].blocked = hit
    if hit >= 0:
        copy_pose(pose_now(walk), blocked_pose(walk))
    keep_rest(walk, 0.0)


@nb.njit(nogil=True, cache=True)
def _move_before_turn(walk, hit):
    """Follow a motion command of an avatar in contact: move first, then turn.

    hit: that of the whole motion. Returns the hit that ends the motion, -1 for none.
    """
    target, moved = walk.memory.target, pose_now(walk).copy()
    turns = False
    for r in range(3):
        moved[r, 3] = target[r, 3]
        for c in range(3):
            turns |= moved[r, c] != target[r, c]
    if not turns:
        return hit
    walk.memory.state[0].hits -= 1
    hit = advance(walk, moved)
    return hit if hit >= 0 else advance(walk, target)


@nb.njit(nogil=True, cache=True)
def keep_rest(walk, rose):
    """Record what is left of the motion command, after a climb by `rose` [m]."""
    memory = walk.memory
    target, pose = memory.target, pose_now(walk)
    left = memory.state[0].left
    for r in range(3):
        left[r] = target[r, 3] + rose * walk.settings[0].up[r] - pose[r, 3]


# A displacement may lead into a surface by this share of its length, which is rounding.
ROUNDING = 1e-9
# Least share of the remainder that must lie along the surfaces to slide: 6 degrees off head on.
# Smoothed normals are wrong by a few degrees: at 0.02, an avatar pushed straight at a flat wall
# crept along it.
MIN_SLIDE_SHARE = 0.1
# Below this share, 11 degrees, a push is nearly head on: the normals of flat surfaces are estimated
# more exactly. With 2 mm of noise, bumps stopped half of the pushes of 6 to 8 degrees before.
NEARLY_HEAD_ON = 0.2
# Least share on flat surfaces, whose normal is estimated from points within three times the reach
# (level 1 of `scan_normal`): a degree. With 2 mm of noise, normals of points within 8 cm are wrong by
# up to 0.5 degrees at 5 mm spacing, 1.4 at 2 cm and 3.9 at 4 cm; within 24 cm by up to 0, 0.2 and 0.7.
# The code of a normal adds up to 0.6.
MIN_FLAT_SHARE, FLAT = 0.02, 1
# A surface is flat if its points are this near to its plane, as a share of the reach: 2.4 cm.
MAX_FLAT_HEIGHT_SHARE = 0.1
# Bumps farther on may be higher than those in the neighbourhood, by this share of its thickness. With
# noise that is 1.5 standard deviations.
MORE_BUMP_SHARE = 0.25
# Least length of a sliding motion [m]. With shorter ones an avatar in a corner would tremble.
MIN_SLIDE = 5e-5
# Least cosine between the normals of one plane: 8 degrees.
SAME_PLANE_COSINE = 0.99
# Distances to move off a surface with a bump, as multiples of the lift.
FIRST_LIFT, LAST_LIFT = 1.0, 3.0
# Nearly head on, moving off a surface may cost at most this share of the gain along the command.
MAX_LIFT_LOSS = 0.9
# Least gain along the motion command for which moving over a bump is kept, as a share of the way.
MIN_GAIN = 1e-3
# Limit of motions in a frame, for each of `surfaces`. Moving over bumps takes some of them.
MOTIONS_PER_SURFACE = 2
# Reach of the normals of flat surfaces, as a multiple of the normal reach.
FLAT_REACH_FACTOR = 3.0


@njit_no_refcount
def limit_displacement(gone, way, most):
    """Shorten a displacement so that its sum with `gone` is at most `most` long [m].

    gone, way: vectors. The direction of `way` is kept.
    """
    a, b, c = dot(way, way), dot(gone, way), dot(gone, gone) - most * most * (1.0 - 1e-12)
    if a + 2.0 * b + c <= 0.0:
        return way
    root = b * b - a * c
    share = (math.sqrt(root) - b) / a if root > 0.0 and c < 0.0 else 0.0
    return times(max(0.0, share), way)


@njit_no_refcount
def _is_free(way, planes, count, least):
    free = True
    for n in range(count):
        free &= dot(way, vector(planes[n])) >= least
    return free


@nb.njit(nogil=True, cache=True)
def clip(rest, planes, count):
    """Return whether a displacement can be clipped, and its longest projection that leads into no plane.

    planes: (p, 3) unit normals that point to the free side; the first `count` count. The candidates are
    the displacement itself, then its projections onto one plane, then those onto the crease of two.
    """
    least = -ROUNDING * norm(rest)
    if _is_free(rest, planes, count, least):
        return True, rest
    best, longest = rest, -1.0
    for n in range(count):
        plane = vector(planes[n])
        way = minus(rest, times(dot(rest, plane), plane))
        if norm(way) > longest and _is_free(way, planes, count, least):
            best, longest = way, norm(way)
    if longest >= 0.0:
        return True, best
    for n in range(count):
        for m in range(n + 1, count):
            crease = cross(vector(planes[n]), vector(planes[m]))
            square = dot(crease, crease)
            if square > 1e-6:
                way = times(dot(rest, crease) / square, crease)
                if norm(way) > longest and _is_free(way, planes, count, least):
                    best, longest = way, norm(way)
    return longest >= 0.0, best


@nb.njit(nogil=True, cache=True)
def slide_command(walk):
    """Slide along what obstructed the motion command, then turn in place."""
    memory = walk.memory
    hit = memory.state[0].blocked
    if hit < 0:
        return
    target, begin = memory.target, place_of(memory.begin)
    command, rest = minus(place_of(target), begin), minus(place_of(target), place_now(walk))
    far = norm(rest)
    if far > 0.0:
        # A turning avatar moves along an arc. With the whole remainder it could move farther than
        # commanded.
        left = norm(command) - norm(minus(place_now(walk), begin))
        rest = times(min(1.0, max(0.0, left) / far), rest)
        slide_along(walk, hit, rest, command, True)
    turned = target.copy()
    for r in range(3):
        turned[r, 3] = pose_now(walk)[r, 3]
    advance(walk, turned)
    keep_rest(walk, 0.0)


@nb.njit(nogil=True, cache=True)
def slide_along(walk, hit, rest, command, upright):
    """Continue a motion along the surface that ended it, and along further ones.

    rest: the rest of the translation [m].  command: the whole translation [m].
    upright: treat a surface that is too steep to walk on as vertical, with `ground`.
    Return the hit that ended the motion, or -1.
    """
    surfaces = walk.settings[0].surfaces
    start, most = minus(place_now(walk), minus(command, rest)), norm(command)
    # Distinct planes touched so far. A plane that is touched again, or that the motion did not lead
    # into, is taken for a bump.
    planes, count = np.empty((surfaces, 3)), 0
    touched = ended = hit  # touched: on the last of the planes
    for _ in range(MOTIONS_PER_SURFACE * surfaces):
        bumps, bump = False, rest
        if ended >= 0:
            known, plane = _surface(walk, ended, upright)
            if not known:
                return ended
            if dot(plane, rest) >= -ROUNDING * norm(rest) or _is_among(plane, planes, count):
                bumps, bump = True, plane
            elif count == surfaces:
                return ended
            else:
                put(planes[count], plane)
                count += 1
                touched = ended
        free, way = clip(rest, planes, count)
        if count == 1 and free and upright and norm(way) < NEARLY_HEAD_ON * norm(rest):
            flat_known, flat, bump_height = _flat_plane(walk, touched, vector(planes[0]))
            if flat_known:
                put(planes[0], flat)
                free, way = clip(rest, planes, 1)
                if not free or norm(way) < max(MIN_FLAT_SHARE * norm(rest), MIN_SLIDE):
                    return ended
                _back_off(walk, flat, min(bump_height, dot(minus(start, place_now(walk)), flat)))
            elif norm(way) < MIN_SLIDE_SHARE * norm(rest):
                return ended
        elif free and norm(way) < MIN_SLIDE_SHARE * norm(rest):
            return ended
        if free:
            way = limit_displacement(minus(place_now(walk), start), way, most)
        if not free or norm(way) < MIN_SLIDE or dot(way, command) <= 0.0:
            return ended
        begin = place_now(walk)
        if not bumps:
            ended = advance_by(walk, way)
        else:
            over, ended = _over_bump(walk, bump, way, command, start)
            if not over:
                return ended
        gone = dot(minus(place_now(walk), begin), way) / dot(way, way)
        rest = times(max(0.0, 1.0 - gone), way)
        if ended < 0:
            return -1
    return ended


@nb.njit(nogil=True, cache=True)
def _is_among(plane, planes, count):
    found = False
    for n in range(count):
        found |= dot(plane, vector(planes[n])) > SAME_PLANE_COSINE
    return found


@nb.njit(nogil=True, cache=True)
def _over_bump(walk, out, way, command, start):
    """Move over a bump of a touched surface: away from it by a little, then on.

    out: normal of the surface.  way, command: displacement to try and that of the motion command
    [m].  start: position where the motion command began.
    Return whether that led farther along the motion command, and the hit that ended it. If not,
    the frame is restored.
    """
    state, before = walk.memory.state[0], pose_now(walk).copy()
    origin, hits, ended = place_of(before), state.hits, -1
    most, least = norm(command), MIN_GAIN * norm(way) * norm(command)
    lift, last = FIRST_LIFT * walk.settings[0].lift, LAST_LIFT * walk.settings[0].lift
    back = -dot(out, command)
    if back > 0.0:
        less = MAX_LIFT_LOSS * dot(way, command) / back
        if less < lift:
            # Nearly head on, a longer way off the surface costs more than the motion gains.
            lift = last = less
    while True:
        advance_by(walk, limit_displacement(minus(origin, start), times(lift, out), most))
        state.hits = hits
        ended = advance_by(walk, limit_displacement(minus(place_now(walk), start), way, most))
        if dot(minus(place_now(walk), origin), command) >= least:
            return True, ended
        move_to(walk, before)
        state.hits = hits
        if lift == last:
            return False, ended
        lift = last


@nb.njit(nogil=True, cache=True)
def _flat_plane(walk, hit, plane):
    """Return whether the scan is flat at a hit, and its more exact normal, from wider surroundings.

    Also return by how much bumps ahead may exceed this point [m]. The normal is unknown unless the
    scan is flat there, and the normal agrees with that of the plane.
    hit: on the plane.  plane: its normal.
    """
    if walk.memory.tape[hit].archive < 0:
        return False, plane, 0.0
    known, normal = hit_normal(walk, hit, FLAT)
    if not known:
        return False, plane, 0.0
    both = np.empty((2, 3))
    put(both[0], normal)
    put(both[1], times(-1.0, normal))
    high, low, _ = scan_heights(walk, hit, both, FLAT)
    wall = _wall(walk, normal)
    reach = min(FLAT_REACH_FACTOR * walk.settings[0].normal_reach, MAX_NORMAL_REACH)
    if max(high, low) > MAX_FLAT_HEIGHT_SHARE * reach or dot(wall, plane) < SAME_PLANE_COSINE:
        return False, plane, 0.0
    return True, wall, high + MORE_BUMP_SHARE * (high + low)


@nb.njit(nogil=True, cache=True)
def _back_off(walk, out, way):
    """Move away from a flat surface, along its normal `out`, by a distance [m].

    A nearly head-on push cannot pass a bump that is steeper than the push is oblique. The avatar
    therefore does not enter the hollows between bumps.
    """
    state = walk.memory.state[0]
    way, hits = min(way, LAST_LIFT * walk.settings[0].lift), state.hits
    if way >= MIN_SLIDE:
        advance_by(walk, times(way, out))
        state.hits = hits


@nb.njit(nogil=True, cache=True)
def _surface(walk, hit, upright):
    """Return whether the normal of a touched plane is known, and it; store it if the hit is the last."""
    memory = walk.memory
    result = memory.tape[hit]
    if result.verdict == UNKNOWN or not result.has_pair:
        return False, (0.0, 0.0, 0.0)
    known, normal = contact_normal(walk, hit)
    last = memory.state[0].hits - 1
    if not known:
        own, cloud = pair_of(walk, hit)
        out = minus(own, cloud)
        across = norm(out)
        if across == 0.0:
            return False, normal
        normal = divided(out, across)
    elif last >= 0 and memory.hits[last].row == hit:
        memory.hits[last].has_normal = True
        put(memory.hits[last].normal, normal)
    return True, _wall(walk, normal) if upright else normal


@nb.njit(nogil=True, cache=True)
def _wall(walk, normal):
    """Return the normal of a plane for a walking avatar: horizontal if it is too steep."""
    up = vector(walk.settings[0].up)
    rises = dot(normal, up)
    if rises >= walk.settings[0].walkable_slide:
        return normal
    level = minus(normal, times(rises, up))
    length = norm(level)
    return normal if length < 0.1 else divided(level, length)
