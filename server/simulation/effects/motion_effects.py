"""Effects that move an avatar: `stop`, `sweep`, `slide`, `step` and `ground`.

In a scene that declares `stop` and none of the others, nor bodies, this file follows the motion command.
In others the kernel `walk_frame` does, which only they import and compile.

Effect `stop`: contact blocks motion; the avatar stays at the last clear pose.

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

Effect `sweep`: continuous motion, so that no avatar passes through anything at any speed.

The avatar follows the screw motion of server/queries/sweep.py from one pose to the next. It stops
`skin` (of `stop`) before the first contact, at a pose that is clear by `collide`. The sweep proves
the pose clear if the pose is one of the sweep's bit for bit; otherwise `collide` is queried.

Effect `slide`: continue a stopped motion along the touched surfaces, their creases and corners.

The method is "collide and slide" with the planes of one frame. The remaining translation is clipped
against every surface touched in the frame, so that it leads into none of them: it follows the
crease of two, and is zero between three. It is never directed against the motion command, and never
longer than the remainder.

A surface is a plane with the smoothed normal of the scan points around the touched one, or at an
edge that of the avatar (kernels/walk/queries.py). The scan's spheres make a flat wall bumpy, by up to
their radius. If a motion touches a plane that the frame has touched before, a bump obstructs it.
The avatar then moves off the surface by a few millimetres and continues; the result is kept if it
led farther along the motion command. Repeated frames of one motion command therefore improve the
position or keep it, and an avatar that keeps pushing does not tremble.

In a nearly head-on push, the remainder along the surface may be mostly the error of the normal. The
avatar then slides only if the surface is flat in a wider neighbourhood, by that neighbourhood's
normal, which is more exact (MIN_FLAT_SHARE). Otherwise it stays, as by friction (MIN_SLIDE_SHARE).

If the command turns the avatar, its screw motion is tried first. The rest of its translation then
slides at the orientation reached. Finally, the rest of the rotation is tried in place.

Effect `step`: climb steps of at most `height`, and descend them without falling.

A standing avatar whose motion was stopped moves up by `height`, as far as nothing is touched, then
forward by the rest of the motion command, and down. The result is kept if it led farther along the
motion command than sliding did, ends on ground, and rose by no more than `height`. Otherwise the
frame is restored. The effect `ground` handles steps down: it searches for ground down to `height`.

Effect `ground`: gravity; the avatar stands slightly above the ground, or falls.

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

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from ....schemas.scene.effect_table import (
    Contacts,
    Ground,
    Proximity,
    Slide,
    Step,
    Stop,
    Sweep,
    Through,
    Uncertainty,
)
from ....schemas.scene.scene_file import sweep_tolerance
from ....schemas.wire.answers import Verdict
from ...avatars.avatar_model import make_avatar
from ..world.collision_world import World
from ..world.first_hits import (
    find_first_hit,
    find_touched,
    is_clear,
    leave,
    leaving_pose,
    record_hit,
    settle_before,
)
from ..world.frame import Body, Frame, Hit, Pose, Run, Vec, dot, norm, translated

# Longest displacement of an escape from contact [m], and the distances that are tried.
MAX_ESCAPE = 0.5
_ESCAPE_DISTANCES = (0.005, 0.01, 0.02, 0.04, 0.08, 0.16, 0.32, MAX_ESCAPE)
# Effects that neither move an avatar nor obstruct it.
_STILL = (Stop, Proximity, Contacts, Uncertainty, Through)


def make(effect: Stop | Sweep | Slide | Step | Ground, world: Any) -> Run:
    """Create `stop`, or all other effects of this file that a scene declares: one call of the kernel runs them."""
    effects = world.file.effects
    if isinstance(effect, Stop):
        return StopRunner(world, effect, walks=not all(isinstance(each, _STILL) for each in effects)).run
    from ..world import walker

    bits = {Sweep: walker.FOLLOW, Slide: walker.SLIDE, Step: walker.STEP, Ground: walker.GROUND}
    parts = sum(bit for kind, bit in bits.items() if any(isinstance(each, kind) for each in effects))
    return partial(walker.walker_of(world).run, parts=parts)


class StopRunner:
    """Effect `stop` of one scene."""

    def __init__(self, world: World, effect: Stop, *, walks: bool) -> None:
        """Create the effect, and compile what its frames need.

        walks: whether the kernel `walk_frame` follows the motion command.
        """
        self._skin, self._tolerance = float(effect.skin), float(sweep_tolerance(world.file))
        declared = {type(each) for each in world.file.effects}
        self._levels = Ground in declared
        self._follow: Callable[[Frame], None] | None = self._follow_alone
        if walks:
            from ..world.walker import FOLLOW, walker_of

            walker = walker_of(world)
            walker.warm()
            self._follow = None if Sweep in declared else partial(walker.run, parts=FOLLOW)
        else:
            self._warm(world)

    def run(self, frame: Frame) -> None:
        """Escape from contact if necessary; without `sweep`, move to the commanded pose."""
        if self._levels:
            level_command(frame)
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


def level_command(frame: Frame) -> None:
    """Remove the vertical part of the motion command, for `ground`."""
    up, begin = frame.world.up, frame.body.pose[:3, 3]
    axes = [axis for axis, part in enumerate(up.tolist()) if part]
    if len(axes) == 1:
        axis = axes[0]
        frame.target[axis, 3] = begin[axis]  # one number: an array of indices takes 5 µs more
        return
    way = frame.target[:3, 3] - begin
    rises = dot(way, up)
    if rises == 0.0:
        return
    level = way - rises * up
    if norm(level) <= 1e-12 * abs(rises):  # rounding alone
        level[:] = 0.0
    frame.target[:3, 3] = begin + level
