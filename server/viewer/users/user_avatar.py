"""The avatar of the viewer's users: a file, or a generated figure."""

from pathlib import Path
from typing import Any

from ....builder.synthetic.figure import figure_points
from ...avatars.avatar_shape import avatar_shape
from ...scene_interface import AvatarShape

# Points of the generated figure: enough for a round body, and found in a moment.
FIGURE_POINTS = 1500


def load_avatar(file: Path | None, **options: Any) -> AvatarShape:
    """Return the avatar of a file, or the figure: z up, facing +y.

    options: `up`, `units` and `hollow` of the file, see `avatar_shape`. Raise its errors.
    """
    if file is None:
        return AvatarShape(figure_points(FIGURE_POINTS))
    return avatar_shape(file, **options)


def height_of(avatar: AvatarShape) -> float:
    """Return the height of an avatar's highest point above its origin [m]."""
    return float(avatar.surface[:, 2].max())
