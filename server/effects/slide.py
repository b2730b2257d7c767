"""`slide`: what is left of a stopped motion goes along the surface touched, several of them, creases and corners.

Collide and slide with the planes of a frame: what is left of the translation is clipped against every surface met in
it, so that the way goes into none of them; along the crease of two, and nowhere between three. It never goes against
the wish, and never farther than what was left: no energy appears.

A surface is a plane by the smoothed normal of the scan points around the one that was touched. The scan's spheres make
a flat wall bumpy, by up to their radius: where the plane is one that the frame has met already, a bump is in the way,
and the plane square to the two spheres' centres leads over it, a short way. Nearly head on, what is left along a
surface is mostly what the normal is off: an avatar that pushes so stays (STICK).

Turning: the wish's screw motion is tried first; what is left of its translation slides at the orientation reached, and
then what is left of the turn is tried on the spot.
"""

import math
from itertools import combinations

import numpy as np

from ...schemas.answers import Verdict
from ...schemas.effects import Ground, Slide, Stop
from ..normals import warm
from ..world import World
from .frame import Frame, Hit, Vec, dot, moved_by, size

# Of what is left, a smaller share along the surfaces is not gone: a degree off head on, or less.
STICK = 0.02
# Nor is a shorter way [m]: an avatar in a corner would tremble.
LEAST_SLIDE = 5e-5
# Normals so close are of one plane: 8 degrees.
SAME_PLANE = 0.99
# Over a bump it goes no farther than so many times the two spheres' radii: the wall goes on behind it.
_OVER = 1.0
# And is lifted off it, so that it does not graze the next one [m].
LEAST_LIFT = 5e-4
_SAME_BUMP = 0.9999
# Motions of a frame for each surface: bumps take some, too.
_MOTIONS = 2
# A way that goes into a surface by no more than rounding, as a share of it, does not.
_ROUNDING = 1e-9


class Sliding:
    """The effect of one scene. surfaces, normal_reach: as `Slide` has them."""

    name = "slide"

    def __init__(
        self, surfaces: int, normal_reach: float, skin: float, slope: float | None, world: World
    ) -> None:
        """skin: of `stop` [m].  slope: what is steeper is a wall [degrees]; None: there is no ground."""
        self._lift = max(skin, LEAST_LIFT)
        self.surfaces, self.normal_reach = surfaces, normal_reach
        self._up = world.up
        self._walkable = None if slope is None else math.cos(math.radians(slope))

    def run(self, frame: Frame) -> None:
        """Slide, and turn on the spot."""
        hit = frame.blocked
        if hit is None or frame.go is None:
            return
        begin = frame.body.pose[:3, 3]
        wish, left = frame.wish[:3, 3] - begin, frame.wish[:3, 3] - frame.pose[:3, 3]
        far = size(left)
        if far > 0.0:
            # Who turns goes by an arc: with all that is left it could get farther than it wished.
            left = left * min(1.0, max(0.0, size(wish) - size(frame.pose[:3, 3] - begin)) / far)
            self.along(frame, hit, left, wish, upright=True)
        if frame.pose[:3, :3].tobytes() != frame.wish[:3, :3].tobytes():
            turned = frame.wish.copy()
            turned[:3, 3] = frame.pose[:3, 3]
            frame.go(frame, turned)
        frame.left = frame.wish[:3, 3] - frame.pose[:3, 3]

    def along(self, frame: Frame, hit: Hit, left: Vec, wish: Vec, *, upright: bool) -> Hit | None:
        """Go on along what ended a motion. left: of its translation, wish: all of it (3,) [m].

        upright: what is too steep to be walked is a wall, where there is ground. Returns what ended it in the end;
        None: nothing did.
        """
        assert frame.go is not None
        met: list[Vec] = []
        planes: list[Vec] = []
        bumps: list[Vec] = []
        ended: Hit | None = hit
        for _ in range(_MOTIONS * self.surfaces):
            if ended is not None:
                if ended.verdict == Verdict.UNKNOWN or ended.avatar is None or ended.cloud is None:
                    return ended
                normal = self._surface(frame, ended, left, met)
                if normal is None:
                    out = ended.avatar - ended.cloud
                    across = size(out)
                    if across == 0.0:
                        return ended
                    out /= across
                    if any(dot(out, each) > _SAME_BUMP for each in bumps):
                        return ended  # no way over it
                    bumps.append(out)
                elif len(met) == self.surfaces:
                    return ended
                else:
                    met.append(normal)
                    planes.append(self._wall(normal) if upright else normal)
            far = size(left)
            way = clip(left, planes + bumps)
            if way is None or size(way) < max(STICK * far, LEAST_SLIDE):
                return ended
            if bumps:
                way = way * min(1.0, _OVER * across / size(way)) + self._lift * bumps[-1]
                way *= min(1.0, far / size(way))
            if dot(way, wish) <= 0.0:
                return ended
            begin = frame.pose
            ended = frame.go(frame, moved_by(begin, way))
            gone = frame.pose[:3, 3] - begin[:3, 3]
            left = left * max(0.0, 1.0 - size(gone) / far) if bumps else way - gone
            if ended is None:
                if not bumps:
                    return None
                bumps.clear()
        return ended

    def _surface(self, frame: Frame, hit: Hit, left: Vec, met: list[Vec]) -> Vec | None:
        """The normal of the surface that was met, noted; None: a bump, of one met before, or of none that is known."""
        normal: Vec | None = frame.world.normal(hit, self.normal_reach)
        if normal is None:
            return None
        if frame.hits and frame.hits[-1] is hit:
            frame.hits[-1] = hit._replace(normal=normal)
        if dot(normal, left) >= 0.0 or any(dot(normal, each) > SAME_PLANE for each in met):
            return None
        return normal

    def _wall(self, normal: Vec) -> Vec:
        """A plane as it is to who has weight: what is too steep to be walked is upright."""
        rises = dot(normal, self._up)
        if self._walkable is None or rises >= self._walkable:
            return normal
        level = normal - rises * self._up
        length = size(level)
        return normal if length < 0.1 else level / length


def clip(left: Vec, planes: list[Vec]) -> Vec | None:
    """The part of a way (3,) that goes into none of the planes (unit normals, on the free side), as long as may be.

    All of it; else along one plane; else along the crease of two; None: there is none.
    """
    least = -_ROUNDING * size(left)

    def free(way: Vec) -> bool:
        return all(dot(way, each) >= least for each in planes)

    if free(left):
        return left
    ways = [left - dot(left, each) * each for each in planes]
    found = [way for way in ways if free(way)]
    if not found:
        for one, other in combinations(planes, 2):
            crease = np.cross(one, other)
            square = dot(crease, crease)
            if square > 1e-6:
                found.append(crease * (dot(left, crease) / square))
        found = [way for way in found if free(way)]
    return max(found, key=size, default=None)


def make(effect: Slide, world: World) -> Sliding:
    """The effect of a scene."""
    slope = next((each.slope for each in world.file.effects if isinstance(each, Ground)), None)
    with world as seen:
        warm(seen[0].data)
    skin = next(each.skin for each in world.file.effects if isinstance(each, Stop))
    return Sliding(effect.surfaces, effect.normal_reach, skin, slope, world)
