"""Effects that move an avatar: `sweep`, `slide`, `step` and `ground`, by the kernel `walk_frame`.

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

from functools import partial
from typing import Any

from ....schemas.scene.effect_table import Ground, Slide, Step, Sweep
from ..world.frame import Frame, Run
from ..world.vectors import dot, norm
from ..world.walker import FOLLOW, GROUND, SLIDE, STEP, walker_of

_PARTS: dict[type, int] = {Sweep: FOLLOW, Slide: SLIDE, Step: STEP, Ground: GROUND}


def make(effect: Sweep | Slide | Step | Ground, world: Any) -> Run:
    """Create all effects of this file that a scene declares: one call of the kernel runs them."""
    parts = sum(_PARTS.get(type(each), 0) for each in world.file.effects)
    return partial(walker_of(world).run, parts=parts)


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
