"""Effect `ground`: gravity, with feet held slightly above the ground, or falling.

Each frame, the avatar is swept straight down from where it arrived. It stands on what it meets
within reach, if that is no steeper than `slope`. It is held `clearance` above the ground, so that a
floor's bumps do not stop it, and low sills are walked over. Anything steeper is not ground: gravity
continues along it. With nothing below, the avatar falls: v t + g t^2 / 2 in a frame of t, at most
at `fall_speed`, swept like any motion, so that it lands in the frame that reaches the ground.

Scans have holes, above all in floors behind columns and under furniture. An avatar that stood and
has nothing to stand on falls only if its feet would land. Where nothing at all was scanned below,
or where the rest of the body would be caught by a hole's rim or the ledge just left, the avatar
walks on at its height, until there is ground again or it is clear of the ledge.

The vertical part of a motion command is ignored, standing and falling: a body with weight does not
choose its height.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from ....schemas.scene.effect_table import Ground, Slide, Step, Sweep
from ....schemas.wire.answers import Verdict
from ....schemas.wire.motion_messages import GroundReport
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
from ..world.vectors import dot, norm

# Feet this near to their target height stay there [m]: at rest nothing moves.
DEAD_BAND = 1e-4
# A standing avatar that moves keeps its height within this share of `clearance`. A floor's bumps
# would otherwise move it up and down in every frame, each time by a swept motion. Of the 1,200
# frames of the façade's walk, 1,017 take two queries with this band, 558 without it.
HEIGHT_BAND = 0.2
# The same beside a wall, whose bumps are in the way up and down [m].
WALL_BAND = 5e-3
# A frame of gravity lasts no longer than this [s].
LONGEST_FRAME = 0.1
# Radius around the touched point of the points that form the ground's normal [m]. With `slide`, its
# radius is used instead, because an archive keeps normals for one radius.
NORMAL_REACH = 0.08
# Distance past an edge at which the surface behind it is tested, and the radius of that test [m].
EDGE_DISTANCE, EDGE_REACH = 0.08, 0.04
# Anything steeper is not an edge but the side of an object: points of both sides of an edge give
# some 45 degrees.
_EDGE_RISES = 0.15
# Ground is searched for within this many clearances first.
_NEAR_CLEARANCES = 2.0
# Distance from a wall at which ground is searched for [m], and the number of walls tried.
_WALL_OFFSET, _MAX_WALLS = 0.01, 3
# A point within these distances of the plane, and of the place, of the last ground belongs to it
# [m].
_SAME_FLOOR, _SAME_FLOOR_REACH = 5e-3, 0.3
# Normals are stored to a third of a degree: the corresponding error of a cosine.
_ROUNDING = 0.005
# The body is swept down to this distance below the scene's lowest sphere [m]; the tolerance of that
# sweep [m].
_FALL_MARGIN, _FALL_TOLERANCE = 0.1, 1e-2
# Tolerance without `sweep` [m].
_TOLERANCE = 1e-5


class GroundSearch(NamedTuple):
    """Result of a search straight down.

    hit: None: nothing.  reach: distance searched [m].  free: nothing is met before this distance
    [m].
    normal: (3,) of the ground; None: no ground, or too steep.  aside: found slightly aside, where
    nothing steep is met.
    """

    hit: Hit | None
    reach: float
    free: float
    normal: Vec | None
    aside: bool


class GroundRunner:
    """Effect `ground` of one scene. clearance: of `Ground`."""

    name = "ground"

    def __init__(self, effect: Ground, up: Vec, step: float, tolerance: float, sliding: Any) -> None:
        """Create the effect.

        up: unit.  step: how far below the next step may be [m].  sliding: effect `slide`, where the
        scene declares it.
        """
        along = np.flatnonzero(up)
        self._axis = int(along[0]) if len(along) == 1 else None
        self.clearance, self._gravity, self._max_speed = effect.clearance, effect.gravity, effect.fall_speed
        self._down = effect.clearance + max(step, effect.clearance)
        self._tolerance, self._sliding = tolerance, sliding
        self._normal_reach = NORMAL_REACH if sliding is None else sliding.normal_reach
        self._walkable = math.cos(math.radians(effect.slope)) - _ROUNDING

    def begin(self, frame: Frame) -> None:
        """Remove the vertical part of the motion command."""
        up, begin = frame.world.up, frame.body.pose[:3, 3]
        if self._axis is not None:
            if frame.target[self._axis, 3] != begin[self._axis]:
                frame.target = frame.target.copy()
                frame.target[self._axis, 3] = begin[self._axis]
            return
        way = frame.target[:3, 3] - begin
        rises = dot(way, up)
        if rises == 0.0:
            return
        level = way - rises * up
        if norm(level) <= 1e-12 * abs(rises):  # rounding alone
            level[:] = 0.0
        frame.target = frame.target.copy()
        frame.target[:3, 3] = begin + level

    def run(self, frame: Frame) -> None:
        """Stand, or fall."""
        stood, seconds = frame.body.on_ground, min(frame.seconds, LONGEST_FRAME)
        speed = 0.0 if stood else frame.body.fall_speed
        after = min(speed + self._gravity * seconds, self._max_speed)
        fall = 0.5 * (speed + after) * seconds
        below = self.search_below(frame, max(self._down if stood else 0.0, fall + self.clearance))
        hit = below.hit
        frame.on_ground, frame.fall_speed = False, after
        if hit is None and not self._would_land(frame, below.reach, stood=stood):
            frame.on_ground, frame.fall_speed = stood, 0.0
        elif hit is None:
            self.lower(frame, below, fall)
        elif hit.verdict == Verdict.UNKNOWN:
            # It is not known whether there is ground: nothing falls into the unknown.
            record_hit(frame, hit)
            self.lower(frame, below, min(fall, below.free - self.clearance))
            frame.on_ground, frame.fall_speed = stood, 0.0
        elif below.normal is not None:
            frame.on_ground, frame.fall_speed = True, 0.0
            lower = below.free - self.clearance
            self._store_ground(frame, hit, below.normal)
            band = max(DEAD_BAND, HEIGHT_BAND * self.clearance) if stood else DEAD_BAND
            if below.aside:
                band = max(band, WALL_BAND)
            if lower > band:
                self.lower(frame, below, lower)
            elif lower < -band:
                self.slide(frame, -lower * frame.world.up)
        else:
            self._fall_along(frame, fall, seconds)
        normal = None if below.normal is None else tuple(below.normal.tolist())
        frame.reports["ground"] = GroundReport(frame.on_ground, frame.fall_speed, normal)

    def _store_ground(self, frame: Frame, hit: Hit, normal: Vec) -> None:
        """Store what the avatar stands on, unless that plane is stored already."""
        stood = frame.body.effect_state.get(self.name)
        if hit.archive >= 0 and hit.cloud is not None and (stood is None or normal is not stood[1]):
            frame.effect_state[self.name] = hit.cloud, normal

    def search_below(self, frame: Frame, reach: float) -> GroundSearch:
        """Find what is met first straight down from frame.pose within a reach [m].

        Beside a wall, its bumps are in the way down: the search is repeated slightly away from
        anything too steep.
        """
        first: GroundSearch | None = None
        aside = np.zeros(3)
        for met in frame.hits[-_MAX_WALLS:]:  # what the avatar stands beside now
            if met.normal is not None and abs(dot(met.normal, frame.world.up)) < _EDGE_RISES:
                aside = _WALL_OFFSET * met.normal
        beside = bool(aside.any())
        for _ in range(_MAX_WALLS):
            begin = frame.pose
            if beside or first is not None:
                frame.pose = translated(begin, aside)
            # Ground is nearly always near, and a short sweep takes half the time.
            far = min(reach, _NEAR_CLEARANCES * self.clearance)
            hit = self._first_below(frame, far)
            if hit is None and far < reach:
                far = reach
                hit = self._first_below(frame, far)
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
            aside = aside + _WALL_OFFSET * away
        assert first is not None
        return first

    def _first_below(self, frame: Frame, reach: float) -> Hit | None:
        return find_first_hit(frame, translated(frame.pose, -reach * frame.world.up), self._tolerance)

    def _away(self, frame: Frame, hit: Hit) -> Vec | None:
        """Return the level direction away from something steep."""
        if hit.avatar is None or hit.cloud is None:
            return None
        out = frame.world.normal(hit, self._normal_reach)
        if out is None:
            out = hit.avatar - hit.cloud
        level = out - dot(out, frame.world.up) * frame.world.up
        length = norm(level)
        return None if length == 0.0 else level / length

    def lower(self, frame: Frame, below: GroundSearch, way: float) -> None:
        """Move straight down by a distance `way` [m], within what was found free."""
        assert frame.advance is not None
        if way <= 0.0:
            return
        if not below.aside:
            down = translated(frame.pose, -below.reach * frame.world.up)
            settle_before(frame, down, way / below.reach, below.free / below.reach if below.hit else 1.0)
            return
        self.slide(frame, -way * frame.world.up)

    def slide(self, frame: Frame, way: Vec) -> None:
        """Move by a displacement `way` (3,) [m], sliding along what is met."""
        assert frame.advance is not None
        begin, hits = frame.pose[:3, 3], len(frame.hits)
        hit = frame.advance(frame, translated(frame.pose, way))
        if hit is not None and self._sliding is not None:
            self._sliding.slide_along(frame, hit, way - (frame.pose[:3, 3] - begin), way, upright=False)
        del frame.hits[hits:]

    def _would_land(self, frame: Frame, reach: float, *, stood: bool) -> bool:
        """Return whether an avatar with nothing within reach below its feet would or may land."""
        world, avatar, up = frame.world, frame.body.avatar, frame.world.up
        if not len(avatar.points):
            return False
        feet = lowest_height(avatar, frame.pose, up)
        deep = feet - world.lowest_height() + _FALL_MARGIN
        if deep <= reach:
            return False
        swept = world.sweep(
            avatar, frame.pose, translated(frame.pose, -deep * up), _FALL_TOLERANCE, frame.budget
        )
        if swept.verdict != Verdict.CONTACT:
            return bool(swept.verdict == Verdict.UNKNOWN)
        # A hole's rim, or the ledge behind it, is met by the parts above the feet, which are wider.
        return not stood or dot(swept.cloud, up) < feet - reach

    def walkable_normal(self, frame: Frame, hit: Hit) -> Vec | None:
        """Return the normal of what was met, if it can be stood on; None: it is too steep.

        The points around an edge, for example of a stair, have a slanting normal. An avatar can
        stand on an edge if the surface farther in, at its height, is ground.
        """
        if hit.avatar is None or hit.cloud is None:
            return None
        stood = frame.body.effect_state.get(self.name)
        if stood is not None and hit.archive >= 0:
            way = hit.cloud - stood[0]
            if abs(dot(way, stood[1])) <= _SAME_FLOOR and norm(way) <= _SAME_FLOOR_REACH:
                return stood[1]  # the last ground: a normal takes as long as half a sweep
        up, out = frame.world.up, hit.avatar - hit.cloud
        length = norm(out)
        normal: Vec | None = frame.world.normal(hit, self._normal_reach)
        if normal is None:
            normal = out / length if length > 0.0 else up
        rises = dot(normal, up)
        if rises >= self._walkable:
            return normal
        level = normal - rises * up
        steep = norm(level)
        if hit.archive < 0 or rises <= _EDGE_RISES or steep == 0.0:
            return None
        inner = frame.world.nearest(hit.cloud - EDGE_DISTANCE / steep * level, EDGE_REACH, frame.budget)
        if inner is None:
            return None
        top = frame.world.normal(
            hit._replace(avatar=inner.cloud + up, cloud=inner.cloud, archive=inner.archive),
            self._normal_reach,
        )
        return top if top is not None and dot(top, up) >= self._walkable else None

    def _fall_along(self, frame: Frame, fall: float, seconds: float) -> None:
        """Fall onto something steep, and along it; distance not fallen reduces the speed."""
        begin = frame.pose[:3, 3]
        self.slide(frame, -fall * frame.world.up)
        fell = -dot(frame.pose[:3, 3] - begin, frame.world.up)
        if seconds > 0.0:
            frame.fall_speed = min(frame.fall_speed, max(fell, 0.0) / seconds)


def make(effect: Ground, world: World) -> GroundRunner:
    """Create the effect of a scene."""
    declared = {type(each): each for each in world.file.effects}
    with world as seen:
        warm(seen[0].data)
    step, sweep, slide = declared.get(Step), declared.get(Sweep), declared.get(Slide)
    sliding = None
    if isinstance(slide, Slide):
        # Imported here: what no effect needs is not imported.
        from .slide_effect import make as make_sliding

        sliding = make_sliding(slide, world)
    return GroundRunner(
        effect,
        world.up,
        step.height if isinstance(step, Step) else 0.0,
        sweep.tolerance if isinstance(sweep, Sweep) else _TOLERANCE,
        sliding,
    )
