"""Effect `ground`: gravity; the avatar stands slightly above the ground, or falls.

In each frame, the avatar is swept straight down from the pose that the earlier effects gave it. It
stands on the first surface within reach, if that is no steeper than `slope`. It is held `clearance`
above the ground, so that bumps of a floor do not stop it and it walks over low sills. A steeper
surface is not ground: the avatar slides down along it. Without ground, the avatar falls by
v t + g t^2 / 2 in a frame of duration t, with a speed of at most `fall_speed`. The fall is swept
like any motion, so the avatar lands in the frame in which it reaches the ground.

Scans have holes, above all in floors behind columns and under furniture. An avatar that stood in
the last frame and has no ground below falls only if its feet would land. It keeps its height
instead if nothing below was scanned, or if the rim of a hole, or the ledge just left, would catch
the rest of the body. It then falls or stands again when there is ground or it has left the ledge.

An avatar that pushes against something, and was raised where it is, is not lowered again: it would
rise and sink in turn where the heights of the ground differ nearby, as at the edge of a sheet.

The vertical part of a motion command is ignored, both when standing and when falling. A body whose
top is above the middle of the avatar stands beside it and is no ground: a user pressed between two
others would otherwise fall.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from ....schemas.scene.effect_table import Ground, Slide, Step
from ....schemas.scene.scene_file import sweep_tolerance
from ....schemas.wire.answers import Verdict
from ....schemas.wire.motion_messages import GroundReport
from ...queries.resident_fast_path import SweepResult
from ...queries.surface_normals import warm
from ..world.collision_world import World
from ..world.frame import (
    Frame,
    Hit,
    Vec,
    find_first_hit,
    lowest_height,
    record_hit,
    settle_before,
    translated,
)
from ..world.ground_plane import held_above_ground, last_normal, store_ground
from ..world.vectors import dot, norm

# Feet this near to their target height are not moved [m], so that an avatar at rest stays at rest.
DEAD_BAND = 1e-4
# A standing avatar that moves keeps its height within this share of `clearance`. A floor's bumps
# would otherwise move it up and down in every frame, each time by a swept motion. Of the 1,200
# frames of the façade's walk, 1,017 take two queries with this band, 558 without it.
HEIGHT_BAND = 0.2
# The same band beside a wall, whose bumps obstruct motion up and down [m].
WALL_BAND = 5e-3
# An avatar that pushes against something is not lowered again within this distance of the place where
# it was raised [m], which is kept under the name RAISED. With a part wedged under a slope or over the
# edge of a sheet, the heights of the ground a millimetre apart may differ by centimetres. It would
# rise and sink in turn.
SAME_PLACE, RAISED = 5e-3, "ground raised"
# Longest time for which gravity acts in one frame [s].
LONGEST_FRAME = 0.1
# Points within this distance of the touched point determine the ground's normal [m]. With `slide`,
# its distance is used instead, because an archive stores normals for one distance.
NORMAL_REACH = 0.08
# Distance past an edge at which the surface behind it is tested, and the radius of that test [m].
# Points of treads of scanned stairs were 47 and 64 mm from there (scripts/walk_scans).
EDGE_DISTANCE, EDGE_REACH = 0.08, 0.08
# Least vertical component of a normal at an edge. A normal that is nearer to level belongs to the
# side of an object: points of both sides of an edge give a normal of some 45 degrees.
_EDGE_RISES = 0.15
# Where a scan has few points of a tread, the normal at its edge is the riser's. It is an edge all the
# same if the touching sphere is above the touched one: least vertical component of their direction.
_EDGE_ABOVE = 0.5
# The first search for ground extends this many clearances down.
_NEAR_CLEARANCES = 2.0
# Distances from a wall at which ground is searched for, one after the other [m]. Feet pushed against
# the foot of a slope that is too steep are above it by their clearance: with 3 cm, the floor is 5 cm
# aside at 30 degrees.
_WALL_OFFSETS = (0.01, 0.05)
_MAX_WALLS = 3
# Error of a cosine that results from storing normals to a third of a degree.
_ROUNDING = 0.005
# A search for any landing place extends to this distance below the scene's lowest sphere [m]; the
# tolerance of that sweep [m].
_FALL_MARGIN, _FALL_TOLERANCE = 0.1, 1e-2


class GroundSearch(NamedTuple):
    """Result of a search for ground straight down.

    hit: end of the downward motion; None if nothing is touched.  reach: distance searched [m].
    free: distance within which nothing is touched [m].
    normal: (3,) unit, of the ground; None if there is none or it is too steep.
    aside: whether the ground was found slightly aside, away from a steep surface.
    """

    hit: Hit | None
    reach: float
    free: float
    normal: Vec | None
    aside: bool


class GroundRunner:
    """Effect `ground` of one scene.

    clearance: height of the feet above the ground [m].  near_reach: of the first search [m].
    """

    name = "ground"

    def __init__(self, effect: Ground, up: Vec, step: float, tolerance: float, sliding: Any) -> None:
        """Create the effect.

        up: (3,) unit vector.  step: height of `step`, 0 without it [m].
        tolerance: of sweeps [m].  sliding: runner of the effect `slide`, or None.
        """
        along = np.flatnonzero(up)
        self._axis = int(along[0]) if len(along) == 1 else None
        self.clearance, self._gravity, self._max_speed = effect.clearance, effect.gravity, effect.fall_speed
        snap = step if effect.snap is None else effect.snap
        self._down = effect.clearance + max(snap, effect.clearance)
        self.near_reach = _NEAR_CLEARANCES * effect.clearance
        self._tolerance, self._sliding = tolerance, sliding
        self._normal_reach = NORMAL_REACH if sliding is None else sliding.normal_reach
        self._walkable = math.cos(math.radians(effect.slope)) - _ROUNDING

    def begin(self, frame: Frame) -> None:
        """Remove the vertical part of the motion command."""
        if self._axis is not None:
            frame.target[self._axis, 3] = frame.body.pose[self._axis, 3]
            return
        up, begin = frame.world.up, frame.body.pose[:3, 3]
        way = frame.target[:3, 3] - begin
        rises = dot(way, up)
        if rises == 0.0:
            return
        level = way - rises * up
        if norm(level) <= 1e-12 * abs(rises):  # rounding alone
            level[:] = 0.0
        frame.target[:3, 3] = begin + level

    def run(self, frame: Frame) -> None:
        """Move the avatar to its height above the ground, or let it fall."""
        near: tuple[Hit | None] | None = None
        if frame.body.on_ground and not frame.hits:
            # The answer is known if the motion command was completed (free_walk.py).
            swept = frame.walked[1] if frame.pose is frame.target else None
            first = self.first_below(frame, self.near_reach, swept)
            if first is not None and self.keeps_height(frame, first):
                return
            near = (first,)
        stood, seconds = frame.body.on_ground, min(frame.seconds, LONGEST_FRAME)
        speed = 0.0 if stood else frame.body.fall_speed
        after = min(speed + self._gravity * seconds, self._max_speed)
        fall = 0.5 * (speed + after) * seconds
        below = self.search_below(frame, max(self._down if stood else 0.0, fall + self.clearance), near)
        hit = below.hit
        frame.on_ground, frame.fall_speed = False, after
        if hit is None and not self._would_land(frame, below.reach, stood=stood):
            frame.on_ground, frame.fall_speed = stood, 0.0
        elif hit is None:
            self.lower(frame, below, fall)
        elif hit.verdict == Verdict.UNKNOWN:
            # Something below is unknown, so there may be ground: the avatar does not fall.
            record_hit(frame, hit)
            self.lower(frame, below, min(fall, below.free - self.clearance))
            frame.on_ground, frame.fall_speed = stood, 0.0
        elif below.normal is not None:
            frame.on_ground, frame.fall_speed = True, 0.0
            lower = below.free - self.clearance
            store_ground(frame, hit, below.normal)
            band = max(DEAD_BAND, HEIGHT_BAND * self.clearance) if stood else DEAD_BAND
            if below.aside:
                band = max(band, WALL_BAND)
            if lower > band:
                if not _was_raised_here(frame):
                    self.lower(frame, below, lower)
            elif lower < -band:
                self.slide(frame, -lower * frame.world.up)
                frame.effect_state[RAISED] = frame.pose[:3, 3].copy()
        elif stood and (held := held_above_ground(frame, hit, self._down)) is not None:
            frame.on_ground, frame.fall_speed = True, 0.0
            below = below._replace(normal=held)
        else:
            self._fall_along(frame, fall, seconds)
        normal = None if below.normal is None else tuple(below.normal.tolist())
        frame.reports["ground"] = GroundReport(frame.on_ground, frame.fall_speed, normal)

    def keeps_height(self, frame: Frame, hit: Hit) -> bool:
        """Finish the frame of an avatar that stands on its last ground at its height, as most do.

        hit: the first contact straight down from frame.pose, within the near reach. Return False if
        the avatar has to move, or stands on other ground.
        """
        lower = hit.fraction * self.near_reach - self.clearance
        if hit.verdict == Verdict.UNKNOWN or abs(lower) > max(DEAD_BAND, HEIGHT_BAND * self.clearance):
            return False
        normal = last_normal(frame, hit)
        if normal is None:
            return False
        frame.on_ground, frame.fall_speed = True, 0.0
        store_ground(frame, hit, normal)
        frame.reports["ground"] = GroundReport(True, 0.0, tuple(normal.tolist()))
        return True

    def search_below(self, frame: Frame, reach: float, near: tuple[Hit | None] | None = None) -> GroundSearch:
        """Find the first contact straight down from frame.pose within `reach` [m].

        near: result of the search within the near reach, if the caller has made it.
        Bumps of a wall beside the avatar may end the motion. After a contact that is too steep, the
        search is therefore repeated slightly away from it.
        """
        first: GroundSearch | None = None
        aside = np.zeros(3)
        for met in frame.hits[-_MAX_WALLS:]:  # walls beside the avatar
            if met.normal is not None and abs(dot(met.normal, frame.world.up)) < _EDGE_RISES:
                aside = _WALL_OFFSETS[0] * met.normal
        beside = bool(aside.any())
        for offset in (*_WALL_OFFSETS, 0.0):  # away from the contact before
            begin = frame.pose
            if beside or first is not None:
                frame.pose = translated(begin, aside)
            # Ground is nearly always near, and a short sweep takes half the time.
            far = min(reach, self.near_reach)
            hit = self.first_below(frame, far) if near is None else near[0]
            near = None
            if hit is None and far < reach:
                far = reach
                hit = self.first_below(frame, far)
            frame.pose = begin
            found = GroundSearch(hit, far, far, None, beside or first is not None)
            if hit is None:
                return found
            found = found._replace(free=hit.fraction * far)
            if hit.verdict == Verdict.UNKNOWN:
                return found
            found = found._replace(normal=self.walkable_normal(frame, hit))
            if found.normal is not None:
                return found
            first = first or found
            away = self._away(frame, hit)
            if away is None:
                break
            aside = aside + offset * away
        assert first is not None
        return first

    def first_below(self, frame: Frame, reach: float, swept: SweepResult | None = None) -> Hit | None:
        """Return the first hit straight down from frame.pose within `reach` [m]. swept: the scan's, if known."""
        to = translated(frame.pose, -reach * frame.world.up)
        return find_first_hit(frame, to, self._tolerance, below=True, swept=swept)

    def _away(self, frame: Frame, hit: Hit) -> Vec | None:
        """Return the horizontal unit vector (3,) away from a steep surface; None if unknown."""
        if hit.avatar is None or hit.cloud is None:
            return None
        out = frame.world.normal(hit, self._normal_reach, frame.budget)
        if out is None:
            out = hit.avatar - hit.cloud
        level = out - dot(out, frame.world.up) * frame.world.up
        length = norm(level)
        return None if length == 0.0 else level / length

    def lower(self, frame: Frame, below: GroundSearch, way: float) -> None:
        """Move straight down by a distance `way` [m], within the distance found free."""
        assert frame.advance is not None
        if way <= 0.0:
            return
        if not below.aside and not frame.obstacles:  # the search left out bodies beside the avatar
            down = translated(frame.pose, -below.reach * frame.world.up)
            settle_before(frame, down, way / below.reach, below.free / below.reach if below.hit else 1.0)
            return
        self.slide(frame, -way * frame.world.up)

    def slide(self, frame: Frame, way: Vec, *, upright: bool = False) -> None:
        """Move by a displacement `way` (3,) [m], sliding along touched surfaces; upright: as in `slide_along`."""
        assert frame.advance is not None
        begin, hits = frame.pose[:3, 3], len(frame.hits)
        hit = frame.advance(frame, translated(frame.pose, way))
        if hit is not None and self._sliding is not None:
            self._sliding.slide_along(frame, hit, way - (frame.pose[:3, 3] - begin), way, upright=upright)
        del frame.hits[hits:]

    def _would_land(self, frame: Frame, reach: float, *, stood: bool) -> bool:
        """Return whether an avatar without ground within `reach` [m] of its feet may land.

        stood: whether it stood in the last frame.
        """
        world, avatar, up = frame.world, frame.body.avatar, frame.world.up
        if not len(avatar.points):
            return False
        feet = lowest_height(avatar, frame.pose, up)
        deep = feet - world.lowest_height() + _FALL_MARGIN
        if deep <= reach:
            return False
        lacked = frame.lacked
        swept = world.sweep(
            avatar, frame.pose, translated(frame.pose, -deep * up), _FALL_TOLERANCE, frame.budget
        )
        if frame.lacked > lacked and not (swept.verdict == Verdict.CONTACT and swept.exact):
            # Whether it would land is not known until the voxels below are in memory: it waits there.
            record_hit(frame, Hit(0.0, Verdict.UNKNOWN, None, None, unloaded=True))
            return False
        if swept.verdict != Verdict.CONTACT:
            return bool(swept.verdict == Verdict.UNKNOWN)
        # The rim of a hole, or the ledge behind, stops the parts above the feet, which are wider.
        return not stood or dot(swept.cloud, up) < feet - reach

    def walkable_normal(self, frame: Frame, hit: Hit) -> Vec | None:
        """Return the normal (3,) of a touched surface that can be stood on; None if too steep.

        The points around an edge, for example of a stair, have a slanting normal. An avatar can
        stand on an edge if the surface farther in, at its height, is ground.
        """
        if hit.avatar is None or hit.cloud is None:
            return None
        last = last_normal(frame, hit)
        if last is not None:
            return last  # estimating a normal takes half a sweep's time
        up, out = frame.world.up, hit.avatar - hit.cloud
        length = norm(out)
        normal: Vec | None = frame.world.normal(hit, self._normal_reach, frame.budget)
        if normal is None:
            normal = out / length if length > 0.0 else up
        rises = dot(normal, up)
        if rises >= self._walkable:
            return normal
        level = normal - rises * up
        steep = norm(level)
        if hit.archive < 0 or steep == 0.0:
            return None
        if rises <= _EDGE_RISES and dot(out, up) < _EDGE_ABOVE * length:
            return None
        inner = frame.world.nearest(hit.cloud - EDGE_DISTANCE / steep * level, EDGE_REACH, frame.budget)
        if inner is None:
            return None
        top = frame.world.normal(
            hit._replace(avatar=inner.cloud + up, cloud=inner.cloud, archive=inner.archive),
            self._normal_reach,
            frame.budget,
        )
        return top if top is not None and dot(top, up) >= self._walkable else None

    def _fall_along(self, frame: Frame, fall: float, seconds: float) -> None:
        """Fall onto a steep surface and along it; a shorter fall reduces the speed.

        fall: distance of a free fall in this frame [m].  seconds: duration of the frame.
        """
        begin = frame.pose[:3, 3]
        self.slide(frame, -fall * frame.world.up)
        fell = -dot(frame.pose[:3, 3] - begin, frame.world.up)
        if seconds > 0.0:
            frame.fall_speed = min(frame.fall_speed, max(fell, 0.0) / seconds)


def _was_raised_here(frame: Frame) -> bool:
    """Return whether the avatar pushes against something where it was raised before."""
    place = frame.body.effect_state.get(RAISED)
    if place is None or frame.blocked is None or not frame.body.on_ground:
        return False
    return norm(frame.pose[:3, 3] - place) <= SAME_PLACE


def make(effect: Ground, world: World) -> GroundRunner:
    """Create the effect of a scene."""
    declared = {type(each): each for each in world.file.effects}
    with world as seen:
        warm(seen[0].data)
    step, slide = declared.get(Step), declared.get(Slide)
    sliding = None
    if isinstance(slide, Slide):
        # Imported here, so that scenes without `slide` do not import it.
        from .slide_effect import make as make_sliding

        sliding = make_sliding(slide, world)
    return GroundRunner(
        effect,
        world.up,
        step.height if isinstance(step, Step) else 0.0,
        sweep_tolerance(world.file),
        sliding,
    )
