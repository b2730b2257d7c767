"""Effect `stop`: contact blocks motion; the avatar stays at the last clear pose.

Alone it is discrete: the avatar takes the commanded pose if nothing is touched there, and otherwise
stays. With `sweep`, it moves up to the first contact.

An avatar that touches something before it moves (because it was placed there, or the archive was
hot-reloaded) first escapes. The candidates are the displacement of the motion command, and
displacements of up to MAX_ESCAPE away from what is touched and upwards, shortest first. The first
with a clear end is taken, if the rule for users in contact permits the way to it
(schemas/SCENE.md). If there is none, the avatar moves by that rule as far as its motion command
leads, also without `sweep`, and the verdict reports whether it is still in contact. It stays if its
pose or a candidate is unknown because voxels are not in memory yet, for a frame that does not wait
for them.
"""

from ....schemas.scene.effect_table import Stop, Sweep
from ....schemas.wire.answers import Verdict
from ..world.collision_world import World
from ..world.frame import Frame, Vec, find_touched, is_clear, record_hit, translated
from ..world.frame_walk import FOLLOW
from ..world.leaving import leave, leaving_pose
from ..world.vectors import norm

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
    touches = hit.verdict == Verdict.CONTACT
    for way in _escape_displacements(frame, touches=touches):
        pose, lacked = translated(frame.pose, way), frame.lacked
        clear = is_clear(frame, pose) and (not touches or leave(frame, pose) is None)
        if frame.lacked > lacked and not clear:
            break  # a frame that waits might take this one
        if clear:
            frame.pose, frame.clear = pose, True
            return
    frame.verdict = hit.verdict


def _escape_displacements(frame: Frame, *, touches: bool) -> list[Vec]:
    """Return the displacements (3,) [m] to try, the commanded one first, then shortest first."""
    directions: list[Vec] = [frame.world.up]
    out = leaving_pose(frame, MAX_ESCAPE).out if touches else None
    if out is not None:
        directions.insert(0, out)
    ways = [way * direction for way in _ESCAPE_DISTANCES for direction in directions]
    commanded = frame.target[:3, 3] - frame.pose[:3, 3]
    if 0.0 < norm(commanded) <= MAX_ESCAPE:
        ways.insert(0, commanded)
    return ways


def make(effect: Stop, world: World) -> StopRunner:
    """Create the effect of a scene."""
    world.walker.warm()
    return StopRunner(any(isinstance(each, Sweep) for each in world.file.effects))
