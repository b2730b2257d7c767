"""Effect `stop`: contact blocks motion; the avatar stays at the last clear pose.

Alone it is discrete: the avatar takes the commanded pose if nothing is touched there, and otherwise
stays. With `sweep`, it moves up to the first contact.

An avatar that touches something before it moves (because it was placed there, or the archive was
hot-reloaded) first escapes. The candidates are the displacement of the motion command, if it does
not lead deeper into the deepest contact, and displacements of up to MAX_ESCAPE along the contact
normal and upwards, shortest first. The first with a clear end is taken. The way to it is not
tested, because an avatar in a wall has no clear side to stay on. If no end is clear, the avatar
stays, and the verdict reports the contact. It also stays if its pose or a candidate is unknown
because voxels are not in memory yet, for a frame that does not wait for them.
"""

from ....schemas.scene.effect_table import Stop, Sweep
from ..world.collision_world import World
from ..world.frame import Frame, Hit, Vec, find_touched, is_clear, record_hit, translated
from ..world.frame_walk import FOLLOW
from ..world.vectors import dot, norm

# Longest displacement of an escape from contact [m], and the distances that are tried.
MAX_ESCAPE = 0.5
_ESCAPE_DISTANCES = (0.005, 0.01, 0.02, 0.04, 0.08, 0.16, 0.32, MAX_ESCAPE)


class StopRunner:
    """Effect `stop` of one scene."""

    name = "stop"

    def __init__(self, continuous: bool) -> None:
        """Create the effect. continuous: whether the effect `sweep` follows the motion command."""
        self._continuous = continuous

    def run(self, frame: Frame) -> None:
        """Escape from contact if necessary; without `sweep`, move to the commanded pose."""
        frame.clear = frame.body.clear and frame.body.generations == frame.generations
        if not frame.clear:
            escape_contact(frame)
        if not self._continuous:
            frame.world.walker.run(frame, FOLLOW)


def escape_contact(frame: Frame) -> None:
    """Move to a near clear pose if anything is touched at frame.pose."""
    hit = find_touched(frame, frame.pose)
    frame.clear = hit is None
    if hit is None:
        return
    if hit.unloaded:
        record_hit(frame, hit)  # it may be clear: nothing pushes it before that is known
        return
    for way in _escape_displacements(frame, hit):
        pose, lacked = translated(frame.pose, way), frame.lacked
        clear = is_clear(frame, pose)
        if frame.lacked > lacked and not clear:
            break  # a frame that waits might take this one
        if clear:
            frame.pose, frame.clear = pose, True
            return
    frame.verdict = hit.verdict


def _escape_displacements(frame: Frame, hit: Hit) -> list[Vec]:
    """Return the displacements (3,) [m] to try, the commanded one first, then shortest first."""
    directions: list[Vec] = [frame.world.up]
    commanded = frame.target[:3, 3] - frame.pose[:3, 3]
    deeper = False
    if hit.avatar is not None and hit.cloud is not None:
        out = hit.avatar - hit.cloud
        across = norm(out)
        if across > 0.0:
            directions.insert(0, out / across)
            deeper = dot(commanded, out) < 0.0  # it might lead through the touched surface
    ways = [way * direction for way in _ESCAPE_DISTANCES for direction in directions]
    if not deeper and 0.0 < norm(commanded) <= MAX_ESCAPE:
        ways.insert(0, commanded)
    return ways


def make(effect: Stop, world: World) -> StopRunner:
    """Create the effect of a scene."""
    world.walker.warm()
    return StopRunner(any(isinstance(each, Sweep) for each in world.file.effects))
