"""Effect `slide`: continue a stopped motion along the touched surfaces, their creases and corners.

The method is "collide and slide" with the planes of one frame. The remaining translation is clipped
against every surface touched in the frame, so that it leads into none of them: it follows the
crease of two, and is zero between three. It is never directed against the motion command, and never
longer than the remainder.

A surface is a plane with the smoothed normal of the scan points around the touched one, or at an
edge that of the avatar (kernels/walk/contact_normal.py). The scan's spheres make a flat wall bumpy, by up to
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

from typing import Any

from ....schemas.scene.effect_table import Slide
from ..world.frame import Frame
from ..world.frame_walk import SLIDE


class SlideRunner:
    """Effect `slide`: slides along what obstructed the motion command (kernels/walk/slide_along.py)."""

    name, part = "slide", SLIDE

    def run(self, frame: Frame) -> None:
        """Slide, then turn in place."""
        frame.world.walker.run(frame, self.part)


def make(effect: Slide, world: Any) -> SlideRunner:
    """Create the effect of a scene."""
    return SlideRunner()
