"""Frame of the page: the world, moved near the origin and turned so that z is up.

A graphics card computes in float32, which has steps of half a metre at map coordinates. All that
the page receives is therefore relative to a place in the middle of the scene.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]


class ViewFrame:
    """Frame of the page, and transformations from and to the world.

    origin: of the frame, world [m].  axes: (3, 3), its axes as rows, world.
    """

    def __init__(self, bounds: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0)) -> None:
        """Make the frame of a scene. bounds: (2, 3), low and high [m].  up: against gravity."""
        low, high = np.asarray(bounds, np.float64)
        finite = np.isfinite(low).all() and np.isfinite(high).all()
        # Whole metres: an addition of the origin then rounds least.
        self.origin: Floats = np.round((low + high) / 2) if finite else np.zeros(3)
        self.axes = _axes(np.asarray(up, np.float64))
        self._matrix = np.eye(4)
        self._matrix[:3, :3] = self.axes
        self._matrix[:3, 3] = -self.axes @ self.origin

    def points(self, world: ArrayLike) -> Floats:
        """Return points (k, 3) or (3,) of the world in this frame [m]."""
        moved: Floats = (np.asarray(world, np.float64) - self.origin) @ self.axes.T
        return moved

    def directions(self, world: ArrayLike) -> Floats:
        """Return directions (k, 3) or (3,) of the world in this frame."""
        turned: Floats = np.asarray(world, np.float64) @ self.axes.T
        return turned

    def to_world(self, points: ArrayLike) -> Floats:
        """Return points (k, 3) or (3,) of this frame in the world [m]."""
        moved: Floats = np.asarray(points, np.float64) @ self.axes + self.origin
        return moved

    def directions_to_world(self, directions: ArrayLike) -> Floats:
        """Return directions (k, 3) or (3,) of this frame in the world."""
        turned: Floats = np.asarray(directions, np.float64) @ self.axes
        return turned

    def pose(self, to_world: ArrayLike) -> Floats:
        """Return a pose (4, 4), anything to world, as one to this frame."""
        pose = np.asarray(to_world, np.float64)
        made: Floats = np.eye(4)
        made[:3, :3] = self.axes @ pose[:3, :3]
        made[:3, 3] = self.points(pose[:3, 3])
        return made

    def poses_to_world(self, poses: ArrayLike) -> Floats:
        """Return poses (k, 4, 4), anything to this frame, as ones to the world."""
        made: Floats = np.array(poses, np.float64)
        made[:, :3, 3] = self.to_world(made[:, :3, 3])
        made[:, :3, :3] = self.axes.T @ made[:, :3, :3]
        return made

    def standing(self, place: ArrayLike, yaw: float) -> Floats:
        """Return the pose (4, 4), avatar to world, of an avatar upright at a place of the world.

        yaw: direction that it faces, about the up axis from this frame's x [rad]. Avatars face +y.
        """
        turn = yaw - np.pi / 2
        c, s = np.cos(turn), np.sin(turn)
        local = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        made: Floats = np.eye(4)
        # The avatar's z is the scene's up axis.
        made[:3, :3] = self.axes.T @ local
        made[:3, 3] = np.asarray(place, np.float64)
        return made

    def yaw(self, to_world: ArrayLike) -> float:
        """Return the direction that an avatar faces, about the up axis from this frame's x [rad]."""
        x, y, _ = self.directions(np.asarray(to_world, np.float64)[:3, 1])
        return float(np.arctan2(y, x))

    def boxes(self, poses: Floats, low: Floats, high: Floats) -> tuple[Floats, Floats]:
        """Return boxes of this frame around boxes of archives.

        poses: (k, 4, 4), archive to world.  low, high: (k, 3), corners in the archive's frame [m].
        """
        matrices = self._matrix @ poses
        middle, half = (low + high) / 2, (high - low) / 2
        centre = np.einsum("kij,kj->ki", matrices[:, :3, :3], middle) + matrices[:, :3, 3]
        reach = np.einsum("kij,kj->ki", np.abs(matrices[:, :3, :3]), half)
        return centre - reach, centre + reach

    def description(self) -> dict[str, Any]:
        """Return the frame for the page."""
        return {"origin": self.origin.tolist(), "axes": self.axes.tolist()}


def _axes(up: Floats) -> Floats:
    """Return orthonormal axes (3, 3) as rows, the last along `up`; the identity for z."""
    length = np.linalg.norm(up)
    z: Floats = np.array([0.0, 0.0, 1.0]) if not length else up / length
    if z[2] == 1.0:
        return np.eye(3)
    x = np.cross([0.0, 1.0, 0.0], z)
    if np.linalg.norm(x) < 1e-6:
        x = np.cross(z, [1.0, 0.0, 0.0])
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])
