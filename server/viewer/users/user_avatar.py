"""The avatar of the viewer's users: a file, or a generated figure."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....builder.synthetic.figure import figure_points
from ...avatars.avatar_shape import avatar_shape

# Points of the generated figure: enough for a round body, and found in a moment.
FIGURE_POINTS = 1500


class UserAvatar(NamedTuple):
    """Avatar of all users of the viewer.

    points: (n, 3), avatar frame, z up, facing +y [m].  radius: of each point [m]; None: measured by
    the server.
    """

    points: NDArray[np.float64]
    radius: float | None

    @property
    def height(self) -> float:
        """Return the height of its highest point above its origin [m]."""
        return float(self.points[:, 2].max())


def load_avatar(file: Path | None) -> UserAvatar:
    """Return the avatar of a file, or the figure. Raise ScanError for a file that cannot be read."""
    if file is None:
        return UserAvatar(figure_points(FIGURE_POINTS), None)
    shape = avatar_shape(file)
    return UserAvatar(np.asarray(shape.points, np.float64), shape.radius)
