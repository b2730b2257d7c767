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

In a scene where no other effect moves avatars or obstructs them, this file follows the motion command.
In others the kernel `walk_frame` does, which this file neither imports nor compiles.
"""

from collections.abc import Callable
from functools import partial

import numpy as np

from ....schemas.scene.effect_table import Contacts, Ground, Proximity, Stop, Sweep, Through, Uncertainty
from ....schemas.scene.scene_file import sweep_tolerance
from ....schemas.wire.answers import Verdict
from ...avatars.avatar_model import make_avatar
from ..world.collision_world import World
from ..world.frame import (
    Body,
    Frame,
    Hit,
    Pose,
    Run,
    Vec,
    find_touched,
    is_clear,
    record_hit,
    translated,
)
from ..world.leaving import find_first_hit, leave, leaving_pose, settle_before
from ..world.vectors import norm

# Longest displacement of an escape from contact [m], and the distances that are tried.
MAX_ESCAPE = 0.5
_ESCAPE_DISTANCES = (0.005, 0.01, 0.02, 0.04, 0.08, 0.16, 0.32, MAX_ESCAPE)
# Effects that neither move an avatar nor obstruct it.
_STILL = (Stop, Proximity, Contacts, Uncertainty, Through)


def make(effect: Stop, world: World) -> Run:
    """Create the effect of a scene."""
    walks = not all(isinstance(each, _STILL) for each in world.file.effects)
    return StopRunner(world, effect, walks=walks).run


class StopRunner:
    """Effect `stop` of one scene."""

    def __init__(self, world: World, effect: Stop, *, walks: bool) -> None:
        """Create the effect, and compile what its frames need.

        walks: whether the kernel `walk_frame` follows the motion command.
        """
        self._skin, self._tolerance = float(effect.skin), float(sweep_tolerance(world.file))
        declared = {type(each) for each in world.file.effects}
        self._level: Callable[[Frame], None] | None = None
        self._follow: Callable[[Frame], None] | None = self._follow_alone
        if walks:
            from ..world.walker import FOLLOW, walker_of

            walker = walker_of(world)
            walker.warm()
            self._follow = None if Sweep in declared else partial(walker.run, parts=FOLLOW)
        else:
            self._warm(world)
        if Ground in declared:
            from .motion_effects import level_command

            self._level = level_command

    def run(self, frame: Frame) -> None:
        """Escape from contact if necessary; without `sweep`, move to the commanded pose."""
        if self._level is not None:
            self._level(frame)
        frame.clear = frame.body.clear and frame.body.generations == frame.generations
        if not frame.clear:
            escape_contact(frame)
        if self._follow is not None:
            self._follow(frame)

    def _warm(self, world: World) -> None:
        """Compile the kernels of a motion that begins in contact."""
        body = Body("", make_avatar([[0.0, 0.0, 0.0]], 0.1), np.eye(4))
        frame, to = Frame(body, np.eye(4), 0.0, world, pose=body.pose), translated(body.pose, world.up)
        hit = Hit(0.5, Verdict.CONTACT, world.up, -world.up)
        with world:
            find_first_hit(frame, to, self._tolerance, self._skin)
            settle_before(frame, to, hit, self._skin)

    def _follow_alone(self, frame: Frame) -> None:
        """Move towards the commanded pose; an avatar in contact that cannot do both moves, then turns."""
        hit = self._advance(frame, frame.target)
        if hit is not None and frame.verdict == Verdict.CONTACT:
            moved = frame.pose.copy()
            moved[:3, 3] = frame.target[:3, 3]
            if (moved != frame.target).any():
                frame.hits.pop()
                if self._advance(frame, moved) is None:
                    self._advance(frame, frame.target)
        frame.remaining = frame.target[:3, 3] - frame.pose[:3, 3]
        if frame.verdict == Verdict.CONTACT and not frame.clear:  # it began in contact
            frame.verdict = frame.world.collide(frame.body.avatar, frame.pose, frame.budget)
            frame.clear = frame.verdict == Verdict.CLEAR

    def _advance(self, frame: Frame, to: Pose) -> Hit | None:
        """Move to a pose if nothing is touched there, in contact as far as possible; return what ended it."""
        if frame.pose.tobytes() == to.tobytes():
            return None
        leaves = frame.verdict == Verdict.CONTACT
        hit = find_first_hit(frame, to, self._tolerance, self._skin) if leaves else find_touched(frame, to)
        if hit is None:
            frame.pose, frame.clear = to.copy(), frame.clear or not leaves
            return None
        if leaves and hit.end is not None:
            frame.pose = hit.end.copy()
        elif leaves:
            settle_before(frame, to, hit, self._skin)
        if hit.unloaded:
            hit = hit._replace(rest=norm(to[:3, 3] - frame.pose[:3, 3]))
        record_hit(frame, hit)
        return hit


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
