"""Effect `step`: climb steps of at most `height`, and descend them without falling.

A standing avatar whose motion was stopped moves up by `height`, as far as nothing is touched, then
forward by the rest of the motion command, and down. The result is kept if it led farther along the
motion command than sliding did, ends on ground, and rose by no more than `height`. Otherwise the
frame is restored. The effect `ground` handles steps down: it searches for ground down to `height`.
"""

from ....schemas.scene.effect_table import Ground, Step
from ..world.collision_world import World
from ..world.frame import MIN_MOTION, Frame, Pose, Vec, lowest_height
from ..world.vectors import dot, norm
from .ground_effect import DEAD_BAND, GroundRunner
from .ground_effect import make as make_ground

# The climb must lead this much farther than sliding [m], and by this share of the remainder.
_MIN_GAIN, _MIN_GAIN_SHARE = 2e-4, 0.02
# If sliding led along this share of the motion command, only its first obstacle may be a step.
_SLID_SHARE = 0.5


class StepRunner:
    """Effect `step` of one scene."""

    name = "step"

    def __init__(self, height: float, ground: GroundRunner) -> None:
        self._height, self._ground = height, ground

    def run(self, frame: Frame) -> None:
        """Climb the obstacle that stopped the motion command, if possible."""
        hit, blocked_pose = frame.blocked, frame.blocked_pose
        if hit is None or blocked_pose is None or not frame.body.on_ground or hit.cloud is None:
            return
        begin = frame.body.pose[:3, 3]
        command = frame.target[:3, 3] - begin
        length = norm(command)
        if length < MIN_MOTION:
            return
        along = command / length
        so_far = dot(frame.pose[:3, 3] - begin, along)
        # Beside a wall that is touched first, a step is touched while sliding.
        obstacles = [hit] if so_far > _SLID_SHARE * length else [hit, *frame.hits]
        top = lowest_height(frame.body.avatar, blocked_pose, frame.world.up) + self._height
        if all(each.cloud is None or dot(each.cloud, frame.world.up) > top for each in obstacles):
            return  # walls
        least = so_far + max(_MIN_GAIN, _MIN_GAIN_SHARE * (length - so_far))
        if least >= length:
            return
        before, hits, verdict = frame.pose, len(frame.hits), frame.verdict
        frame.pose = blocked_pose
        rose = self._climb(frame, along, length, least)
        if rose is None:
            frame.pose, frame.verdict = before, verdict
        else:
            frame.reports["stepped"] = max(rose, 0.0)
            frame.remaining = frame.target[:3, 3] + rose * frame.world.up - frame.pose[:3, 3]
        del frame.hits[hits:]

    def _climb(self, frame: Frame, along: Vec, length: float, least: float) -> float | None:
        """Move up, forward and down from frame.pose.

        along: (3,) unit, horizontal direction.  length: [m].  least: least gain along it [m].
        Return the height gained [m]; None if the motion does not end on ground, or rose too far.
        """
        assert frame.advance is not None
        up, begin, start = frame.world.up, frame.body.pose[:3, 3], frame.pose
        self._ground.slide(frame, self._height * up)  # sliding avoids the bumps of the riser
        rose = self._rise(start, frame.pose, up)
        if rose < MIN_MOTION:
            return None
        self._ground.slide(
            frame, (length - dot(frame.pose[:3, 3] - begin, along)) * along, upright=True
        )  # along a jamb beside the step
        if dot(frame.pose[:3, 3] - begin, along) < least:
            return None
        below = self._ground.search_below(frame, rose + 2.0 * self._ground.clearance)
        if below.normal is None:
            return None
        lower = below.free - self._ground.clearance
        if rose - lower > self._height + DEAD_BAND:
            return None
        self._ground.lower(frame, below, lower)
        # Sliding down along a surface may have moved the avatar back.
        if dot(frame.pose[:3, 3] - begin, along) < least:
            return None
        return self._rise(start, frame.pose, up)

    @staticmethod
    def _rise(start: Pose, pose: Pose, up: Vec) -> float:
        return dot(pose[:3, 3] - start[:3, 3], up)


def make(effect: Step, world: World) -> StepRunner:
    """Create the effect of a scene."""
    ground = next(each for each in world.file.effects if isinstance(each, Ground))
    return StepRunner(effect.height, make_ground(ground, world))
