"""Stand on the ground or fall; see effects/motion_effects.py."""

from ....schemas.kernels import compiling as nb
from ..motion.sweep_resident import LOWER
from .ground_plane import is_held_above_ground, is_last_ground, old_plane, store_ground
from .ground_search import first_below, lower_by, move_by, search_below
from .walk_motions import record_hit
from .walk_queries import lands
from .walk_state import (
    ANSWER,
    ARCHIVE,
    BLOCKED,
    FALL_SPEED,
    FELL,
    GROUNDED,
    HAS_PAIR,
    HAS_STOOD_ON,
    HITS,
    RAISED,
    RAISED_AT,
    SECONDS,
    STANDS,
    STOOD,
    STOOD_ON,
    UNKNOWN,
    UNLOADED,
    VERDICT,
    WAS_RAISED,
    pose_now,
)
from .walk_vectors import dot, minus, norm, place_of, times, vector

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
# Longest time for which gravity acts in one frame [s].
LONGEST_FRAME = 0.1


@nb.njit(nogil=True, cache=True)
def stand_on_ground(walk):
    """Move the avatar to its height above the ground, or let it fall."""
    memory, settings = walk.memory, walk.settings
    numbers, values, inputs = memory.numbers, memory.values, memory.inputs
    stood, up = inputs[STOOD] != 0.0, vector(settings.up)
    near_known, near = False, -1
    if stood and numbers[HITS] == 0:
        near_known, near = True, first_below(walk, settings.near_reach)
        if near >= 0 and _keeps_height(walk, near):
            return
    seconds = min(inputs[SECONDS], LONGEST_FRAME)
    speed = 0.0 if stood else inputs[FELL]
    after = min(speed + settings.gravity * seconds, settings.max_speed)
    fall = 0.5 * (speed + after) * seconds
    below = search_below(
        walk, max(settings.down if stood else 0.0, fall + settings.clearance), near_known, near
    )
    hit, stands, fall_speed = below.hit, False, after
    has_normal, normal = below.stands, below.normal
    if hit < 0 and not _would_land(walk, below.reach, stood):
        stands, fall_speed = stood, 0.0
    elif hit < 0:
        lower_by(walk, below, fall)
    elif memory.tape[hit, VERDICT] == UNKNOWN:
        # Something below is unknown, so there may be ground: the avatar does not fall.
        _record_unknown(walk, hit)
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
            numbers[RAISED] = 1
            for r in range(3):
                values[RAISED_AT + r] = pose_now(walk)[r, 3]
    elif stood and is_held_above_ground(walk, hit, settings.down):
        stands, fall_speed = True, 0.0
        has_normal, (_, normal) = True, old_plane(walk)
    else:
        begin = place_of(pose_now(walk))
        move_by(walk, times(-fall, up), False)
        fell = -dot(minus(place_of(pose_now(walk)), begin), up)
        if seconds > 0.0:
            fall_speed = min(fall_speed, max(fell, 0.0) / seconds)
    _report(walk, stands, fall_speed, has_normal, normal)


@nb.njit(nogil=True, cache=True)
def _report(walk, stands, fall_speed, has_normal, normal):
    """Write the results of the effect."""
    numbers, values = walk.memory.numbers, walk.memory.values
    numbers[GROUNDED], numbers[STANDS] = 1, 1 if stands else 0
    numbers[HAS_STOOD_ON] = 1 if has_normal else 0
    values[FALL_SPEED] = fall_speed
    for r in range(3):
        values[STOOD_ON + r] = normal[r]


@nb.njit(nogil=True, cache=True)
def _keeps_height(walk, hit):
    """Finish the frame of an avatar that stands on its last ground at its height, as most do.

    hit: the first contact straight down, within the near reach. Return False if the avatar has to
    move, or stands on other ground.
    """
    settings, result = walk.settings, walk.memory.tape[hit]
    lower = result[LOWER] * settings.near_reach - settings.clearance
    if result[VERDICT] == UNKNOWN or abs(lower) > max(DEAD_BAND, HEIGHT_BAND * settings.clearance):
        return False
    if not is_last_ground(walk, hit):
        return False
    _, normal = old_plane(walk)
    store_ground(walk, hit, normal, True)
    _report(walk, True, 0.0, True, normal)
    return True


@nb.njit(nogil=True, cache=True)
def _record_unknown(walk, hit):
    """Record a hit below whose motion had no commanded end."""
    result = walk.memory.tape[hit]
    unloaded = result[UNLOADED]
    result[UNLOADED] = 0.0  # nothing of the motion command was left for it
    record_hit(walk, hit, pose_now(walk))
    result[UNLOADED] = unloaded


@nb.njit(nogil=True, cache=True)
def _would_land(walk, reach, stood):
    """Return whether an avatar without ground within `reach` [m] of its feet may land."""
    row = lands(walk, reach, stood)
    result = walk.memory.tape[row]
    if result[UNLOADED] != 0.0:
        # Whether it would land is not known until the voxels below are in memory: it waits there.
        result[VERDICT], result[ARCHIVE], result[HAS_PAIR], result[LOWER] = UNKNOWN, -1.0, 0.0, 0.0
        _record_unknown(walk, row)
        return False
    return result[ANSWER] != 0.0


@nb.njit(nogil=True, cache=True)
def _was_raised_here(walk):
    """Return whether the avatar pushes against something where it was raised before."""
    memory = walk.memory
    if memory.inputs[WAS_RAISED] == 0.0 or memory.numbers[BLOCKED] < 0 or memory.inputs[STOOD] == 0.0:
        return False
    place = vector(memory.old_raised)
    return norm(minus(place_of(pose_now(walk)), place)) <= SAME_PLACE
