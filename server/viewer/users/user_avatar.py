"""The avatar of the viewer's users where no file is given, and the height of any."""

from ....builder.synthetic.figure import figure_points
from ...scene_interface import AvatarShape

# Points of the generated figure: enough for a round body, and found in a moment.
_FIGURE_POINTS = 1500


def figure_avatar() -> AvatarShape:
    """Return a generated human figure, z up, facing +y."""
    return AvatarShape(figure_points(_FIGURE_POINTS))


def height_of(avatar: AvatarShape) -> float:
    """Return the height of an avatar's highest point above its origin [m]."""
    return float(avatar.surface[:, 2].max())
