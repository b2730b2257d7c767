"""Effect `slide`: continue a stopped motion along the touched surfaces, their creases and corners.

The method is "collide and slide" with the planes of one frame. The remaining translation is clipped
against every surface touched in the frame, so that it leads into none of them: it follows the
crease of two, and is zero between three. It is never directed against the motion command, and never
longer than the remainder.

A surface is a plane with the smoothed normal of the scan points around the touched one, or at an
edge that of the avatar (contact_normal.py). The scan's spheres make a flat wall bumpy, by up to
their radius. If a motion touches a plane that the frame has touched before, a bump obstructs it.
The avatar then moves off the surface by a few millimetres and continues; the result is kept if it
led farther along the motion command. Repeated frames of one motion command therefore improve the
position or keep it, and an avatar that keeps pushing does not tremble.

In a nearly head-on push, the remainder along the surface may be mostly the error of the normal. The
avatar then slides only if the surface is flat in a wider neighbourhood, by that neighbourhood's
normal, which is more exact (MIN_FLAT_SHARE). Otherwise it stays, as by friction (MIN_SLIDE_SHARE).

If the command turns the avatar, its screw motion is tried first. The rest of its translation then
slides at the orientation reached. Finally, the rest of the rotation is tried in place.
"""

import math
from itertools import combinations

import numpy as np

from ....schemas.archive.normal_reach import MAX_NORMAL_REACH
from ....schemas.scene.effect_table import Ground, Slide, Stop
from ....schemas.wire.answers import Verdict
from ...queries.surface_normals import warm
from ..world.collision_world import World
from ..world.contact_normal import contact_normal, warm_patch
from ..world.frame import Frame, Hit, Vec, translated
from ..world.vectors import dot, norm

# Least share of the remainder that must lie along the surfaces to slide: 6 degrees off head on.
# Smoothed normals are wrong by a few degrees: at 0.02, an avatar pushed straight at a flat wall
# crept along it.
MIN_SLIDE_SHARE = 0.1
# Below this share, 11 degrees, a push is nearly head on: the normals of flat surfaces are estimated
# more exactly. With 2 mm of noise, bumps stopped half of the pushes of 6 to 8 degrees before.
NEARLY_HEAD_ON = 0.2
# Least share on flat surfaces, whose normal is estimated from points within FLAT_REACH_FACTOR times the
# reach: a degree. With 2 mm of noise, normals of points within 8 cm are wrong by up to 0.5 degrees
# at 5 mm spacing, 1.4 at 2 cm and 3.9 at 4 cm; within 24 cm by up to 0, 0.2 and 0.7. The code of a
# normal adds up to 0.6.
MIN_FLAT_SHARE, FLAT_REACH_FACTOR = 0.02, 3.0
# A surface is flat if its points are this near to its plane, as a share of the reach: 2.4 cm.
MAX_FLAT_HEIGHT_SHARE = 0.1
# Bumps farther on may be higher than those in the neighbourhood, by this share of its thickness. With
# noise that is 1.5 standard deviations.
MORE_BUMP_SHARE = 0.25
# Least length of a sliding motion [m]. With shorter ones an avatar in a corner would tremble.
MIN_SLIDE = 5e-5
# Least cosine between the normals of one plane: 8 degrees.
SAME_PLANE_COSINE = 0.99
# Distances to move off a surface with a bump, as multiples of `skin`, tried in turn, and the least
# distance [m].
LIFT_FACTORS, MIN_LIFT = (1.0, 3.0), 5e-4
# Nearly head on, moving off a surface may cost at most this share of the gain along the command.
MAX_LIFT_LOSS = 0.9
# Least gain along the motion command for which moving over a bump is kept, as a share of the way.
MIN_GAIN = 1e-3
# Limit of motions in a frame, for each of `surfaces`. Moving over bumps takes some of them.
_MOTIONS_PER_SURFACE = 2
# A displacement may lead into a surface by this share of its length, which is rounding.
_ROUNDING = 1e-9


class SlideRunner:
    """Effect `slide` of one scene. surfaces, normal_reach: as in `Slide`."""

    name = "slide"

    def __init__(
        self, surfaces: int, normal_reach: float, skin: float, slope: float | None, world: World
    ) -> None:
        """Create the effect.

        skin: distance that `stop` keeps [m].  slope: surfaces steeper than this are walls
        [degrees]; None: the scene has no effect `ground`.
        """
        self._lift = max(skin, MIN_LIFT)
        self.surfaces, self.normal_reach = surfaces, normal_reach
        self._up = world.up
        self._walkable = None if slope is None else math.cos(math.radians(slope))

    def run(self, frame: Frame) -> None:
        """Slide, then turn in place."""
        hit = frame.blocked
        if hit is None or frame.advance is None:
            return
        begin = frame.body.pose[:3, 3]
        command, rest = frame.target[:3, 3] - begin, frame.target[:3, 3] - frame.pose[:3, 3]
        far = norm(rest)
        if far > 0.0:
            # A turning avatar moves along an arc. With the whole remainder it could move farther
            # than commanded.
            rest = rest * min(1.0, max(0.0, norm(command) - norm(frame.pose[:3, 3] - begin)) / far)
            self.slide_along(frame, hit, rest, command, upright=True)
        if frame.pose[:3, :3].tobytes() != frame.target[:3, :3].tobytes():
            turned = frame.target.copy()
            turned[:3, 3] = frame.pose[:3, 3]
            frame.advance(frame, turned)
        frame.remaining = frame.target[:3, 3] - frame.pose[:3, 3]

    def slide_along(self, frame: Frame, hit: Hit, rest: Vec, command: Vec, *, upright: bool) -> Hit | None:
        """Continue a motion along the surface that ended it, and along further ones.

        rest: (3,), the rest of the translation [m].  command: (3,), the whole translation [m].
        upright: treat a surface that is too steep to walk on as vertical, with `ground`.
        Return the hit that ended the motion, or None.
        """
        assert frame.advance is not None
        start, most = frame.pose[:3, 3] - (command - rest), norm(command)
        # Distinct planes touched so far. A plane that is touched again, or that the motion did not
        # lead into, is taken for a bump.
        planes: list[Vec] = []
        touched = hit  # on the last of the planes
        ended: Hit | None = hit
        for _ in range(_MOTIONS_PER_SURFACE * self.surfaces):
            bump: Vec | None = None
            if ended is not None:
                plane = self._surface(frame, ended, upright=upright)
                if plane is None:
                    return ended
                if dot(plane, rest) >= -_ROUNDING * norm(rest) or any(
                    dot(plane, each) > SAME_PLANE_COSINE for each in planes
                ):
                    bump = plane
                elif len(planes) == self.surfaces:
                    return ended
                else:
                    planes.append(plane)
                    touched = ended
            way = clip(rest, planes)
            if len(planes) == 1 and way is not None and upright and norm(way) < NEARLY_HEAD_ON * norm(rest):
                flat, bump_height = self._flat_plane(frame, touched, planes[0])
                flat_way = None if flat is None else clip(rest, [flat])
                if (
                    flat is not None
                    and flat_way is not None
                    and norm(flat_way) >= max(MIN_FLAT_SHARE * norm(rest), MIN_SLIDE)
                ):
                    way, planes = flat_way, [flat]
                    self._back_off(frame, flat, min(bump_height, dot(start - frame.pose[:3, 3], flat)))
                elif norm(way) < MIN_SLIDE_SHARE * norm(rest) or flat is not None:
                    return ended
            elif way is not None and norm(way) < MIN_SLIDE_SHARE * norm(rest):
                return ended
            if way is not None:
                way = limit_displacement(frame.pose[:3, 3] - start, way, most)
            if way is None or norm(way) < MIN_SLIDE or dot(way, command) <= 0.0:
                return ended
            begin = frame.pose
            if bump is None:
                ended = frame.advance(frame, translated(begin, way))
            else:
                over, ended = self._over_bump(frame, bump, way, command, start)
                if not over:
                    return ended
            gone = dot(frame.pose[:3, 3] - begin[:3, 3], way) / dot(way, way)
            rest = way * max(0.0, 1.0 - gone)
            if ended is None:
                return None
        return ended

    def _over_bump(
        self, frame: Frame, out: Vec, way: Vec, command: Vec, start: Vec
    ) -> tuple[bool, Hit | None]:
        """Move over a bump of a touched surface: away from it by a little, then on.

        out: (3,), normal of the surface.  way, command: (3,), displacement to try and that of the
        motion command [m].  start: (3,), position where the motion command began.
        Return whether that led farther along the motion command, and the hit that ended it. If not,
        the frame is restored.
        """
        assert frame.advance is not None
        before, hits, ended = frame.pose, len(frame.hits), None
        most, least = norm(command), MIN_GAIN * norm(way) * norm(command)
        lifts = [factor * self._lift for factor in LIFT_FACTORS]
        back = -dot(out, command)
        if back > 0.0 and (less := MAX_LIFT_LOSS * dot(way, command) / back) < lifts[0]:
            # Nearly head on, a longer way off the surface costs more than the motion gains.
            lifts = [less]
        for lift in lifts:
            off = limit_displacement(before[:3, 3] - start, lift * out, most)
            frame.advance(frame, translated(before, off))
            del frame.hits[hits:]
            on = limit_displacement(frame.pose[:3, 3] - start, way, most)
            ended = frame.advance(frame, translated(frame.pose, on))
            if dot(frame.pose[:3, 3] - before[:3, 3], command) >= least:
                return True, ended
            frame.pose = before
            del frame.hits[hits:]
        return False, ended

    def _flat_plane(self, frame: Frame, hit: Hit, plane: Vec) -> tuple[Vec | None, float]:
        """Return the more exact normal (3,) of a plane, from wider surroundings of the touched point.

        Also return by how much bumps ahead may exceed this point [m]. The normal is None unless the
        scan is flat there, and the normal agrees with that of the plane.
        hit: on the plane.  plane: (3,), its normal.
        """
        reach = min(FLAT_REACH_FACTOR * self.normal_reach, MAX_NORMAL_REACH)
        normal = None if hit.archive < 0 else frame.world.normal(hit, reach, frame.budget)
        if normal is None:
            return None, 0.0
        high, low = frame.world.highest(hit, np.array([normal, -normal]), reach, frame.budget).tolist()
        wall = self._wall(normal)
        if max(high, low) > MAX_FLAT_HEIGHT_SHARE * reach or dot(wall, plane) < SAME_PLANE_COSINE:
            return None, 0.0
        return wall, high + MORE_BUMP_SHARE * (high + low)

    def _back_off(self, frame: Frame, out: Vec, way: float) -> None:
        """Move away from a flat surface, along its normal `out` (3,), by a distance [m].

        A nearly head-on push cannot pass a bump that is steeper than the push is oblique. The
        avatar therefore does not enter the hollows between bumps.
        """
        assert frame.advance is not None
        way, hits = min(way, LIFT_FACTORS[-1] * self._lift), len(frame.hits)
        if way >= MIN_SLIDE:
            frame.advance(frame, translated(frame.pose, way * out))
            del frame.hits[hits:]

    def _surface(self, frame: Frame, hit: Hit, *, upright: bool) -> Vec | None:
        """Return the unit normal (3,) of a touched plane, stored in the hit; None if unknown."""
        if hit.verdict == Verdict.UNKNOWN or hit.avatar is None or hit.cloud is None:
            return None
        normal = contact_normal(frame, hit, self.normal_reach)
        if normal is None:
            out = hit.avatar - hit.cloud
            across = norm(out)
            if across == 0.0:
                return None
            normal = out / across
        elif frame.hits and frame.hits[-1] is hit:
            frame.hits[-1] = hit._replace(normal=normal)
        return self._wall(normal) if upright else normal

    def _wall(self, normal: Vec) -> Vec:
        """Return the normal (3,) of a plane for a walking avatar: horizontal if it is too steep."""
        rises = dot(normal, self._up)
        if self._walkable is None or rises >= self._walkable:
            return normal
        level = normal - rises * self._up
        length = norm(level)
        return normal if length < 0.1 else level / length


def limit_displacement(gone: Vec, way: Vec, most: float) -> Vec:
    """Shorten a displacement so that its sum with `gone` is at most `most` long [m].

    gone, way: (3,). The direction of `way` is kept.
    """
    a, b, c = dot(way, way), dot(gone, way), dot(gone, gone) - most * most * (1.0 - 1e-12)
    if a + 2.0 * b + c <= 0.0:
        return way
    root = b * b - a * c
    share = (math.sqrt(root) - b) / a if root > 0.0 and c < 0.0 else 0.0
    shortened: Vec = max(0.0, share) * way
    return shortened


def clip(rest: Vec, planes: list[Vec]) -> Vec | None:
    """Return the longest projection of a displacement (3,) that leads into none of the planes.

    planes: unit normals (3,) that point to the free side. The candidates are the displacement
    itself, then its projections onto one plane, then those onto the crease of two. Return None if
    all lead into a plane.
    """
    least = -_ROUNDING * norm(rest)

    def free(way: Vec) -> bool:
        return all(dot(way, each) >= least for each in planes)

    if free(rest):
        return rest
    ways = [rest - dot(rest, each) * each for each in planes]
    found = [way for way in ways if free(way)]
    if not found:
        for one, other in combinations(planes, 2):
            (a, b, c), (x, y, z) = one.tolist(), other.tolist()
            crease = np.array([b * z - c * y, c * x - a * z, a * y - b * x])
            square = dot(crease, crease)
            if square > 1e-6:
                found.append(crease * (dot(rest, crease) / square))
        found = [way for way in found if free(way)]
    return max(found, key=norm, default=None)


def make(effect: Slide, world: World) -> SlideRunner:
    """Create the effect of a scene."""
    slope = next((each.slope for each in world.file.effects if isinstance(each, Ground)), None)
    with world as seen:
        warm(seen[0].data)
    warm_patch()
    skin = next(each.skin for each in world.file.effects if isinstance(each, Stop))
    return SlideRunner(effect.surfaces, effect.normal_reach, skin, slope, world)
