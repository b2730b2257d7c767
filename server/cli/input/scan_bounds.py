"""Detection of poses, motions, rays and points of a query that lie outside the scan.

`solidcloud query` warns about them. An answer's `outside` says that the reach of the query extends
beyond the scan's bounds. Lying outside is stronger: the box of the body, enlarged by the reach,
does not intersect the bounds. No point of the scan can then decide the answer: `clear` is correct,
but it is rarely the intended query.
"""

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ....schemas.wire.answers import Verdict
from ....schemas.wire.scene_messages import SceneInfo

Vec = NDArray[np.float64]
Mask = NDArray[np.bool_]

# The hint that coordinates may be in millimetres is given if at least the share _MOST of the
# outside places lies inside after division by 1000, and if the largest coordinate is then at least
# _LEAST of the scan's largest: near the origin, any coordinate lies inside after a large enough
# division.
_MOST, _LEAST = 0.9, 0.05


class Places(Protocol):
    """Positions of the items of a query."""

    def outside(self, low: Vec, high: Vec, scale: float = 1.0) -> Mask:
        """Return the mask (k,) of the places that do not intersect the box low, high (3,) [m].

        Positions are multiplied by `scale` first.
        """
        ...

    def largest_coordinate(self) -> float:
        """Return the largest absolute coordinate of all positions [m]."""
        ...


class BodyPlaces(NamedTuple):
    """Avatars at poses, or on motions between two poses.

    boxes: (k, 2, 3) or (1, 2, 3), low and high corner of each avatar's points, in its own frame
    [m].
    radius: (k,) or (1,), of the avatars' points [m].  reach: of the query, beyond the radius [m].
    pose_from, pose_to: (k, 4, 4), avatar to world; the same array for avatars that do not move.
    """

    boxes: Vec
    radius: Vec
    reach: float
    pose_from: Vec
    pose_to: Vec

    def outside(self, low: Vec, high: Vec, scale: float = 1.0) -> Mask:
        """Return the mask of bodies that miss the box low, high (3,) [m] during their motion."""
        poses = [_scaled(pose, scale) for pose in (self.pose_from, self.pose_to)]
        ends = [self._boxes_at(pose) for pose in poses]
        # A point on a screw motion stays in the box around its two end positions, enlarged by half
        # their distance: the bulge of an arc of up to half a turn. Of a box's points, a corner has
        # the largest displacement.
        way = np.einsum("kij,kcj->kci", (poses[1] - poses[0])[:, :3, :3], self._corners())
        way += (poses[1] - poses[0])[:, None, :3, 3]
        bulge = np.linalg.norm(way, axis=2).max(axis=1, initial=0.0)[:, None] / 2
        least = np.minimum(ends[0][0], ends[1][0]) - bulge
        most = np.maximum(ends[0][1], ends[1][1]) + bulge
        return np.asarray(((least > high) | (most < low)).any(axis=1))

    def largest_coordinate(self) -> float:
        """Return the largest absolute coordinate of the poses [m]."""
        return _largest(self.pose_from[:, :3, 3], self.pose_to[:, :3, 3])

    def _boxes_at(self, poses: Vec) -> tuple[Vec, Vec]:
        """Return the corners (k, 3) of world boxes around the bodies at poses (k, 4, 4)."""
        turn = poses[:, :3, :3]
        middle, half = (self.boxes[:, 0] + self.boxes[:, 1]) / 2, (self.boxes[:, 1] - self.boxes[:, 0]) / 2
        center = np.einsum("kij,kj->ki", turn, np.broadcast_to(middle, (len(poses), 3))) + poses[:, :3, 3]
        extent = np.einsum("kij,kj->ki", np.abs(turn), np.broadcast_to(half, (len(poses), 3)))
        extent += (self.radius + self.reach)[:, None]
        return center - extent, center + extent

    def _corners(self) -> Vec:
        """Return the eight corners (k, 8, 3) of each box."""
        chosen = np.array([[(i >> axis) & 1 for axis in range(3)] for i in range(8)])
        corners = self.boxes[:, chosen, np.arange(3)]
        return np.broadcast_to(corners, (len(self.pose_from), 8, 3))


class RayPlaces(NamedTuple):
    """Rays of a query.

    origins, directions: (k, 3), world frame [m]; directions of any length except 0.
    reach: length of the rays [m].
    """

    origins: Vec
    directions: Vec
    reach: float

    def outside(self, low: Vec, high: Vec, scale: float = 1.0) -> Mask:
        """Return the mask of rays that miss the box low, high (3,) [m] within their reach."""
        origins = self.origins * scale
        unit = self.directions / np.linalg.norm(self.directions, axis=1)[:, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            ends = np.stack([(low - origins) / unit, (high - origins) / unit])
        level = unit == 0
        within = (low <= origins) & (origins <= high)
        near = np.where(level, np.where(within, -np.inf, np.inf), ends.min(axis=0)).max(axis=1)
        far = np.where(level, np.where(within, np.inf, -np.inf), ends.max(axis=0)).min(axis=1)
        return np.asarray(np.maximum(near, 0.0) > np.minimum(far, self.reach))

    def largest_coordinate(self) -> float:
        """Return the largest absolute coordinate of the origins [m]."""
        return _largest(self.origins)


class PointPlaces(NamedTuple):
    """Points of a query. points: (k, 3), world frame [m].  reach: search radius around each [m]."""

    points: Vec
    reach: float

    def outside(self, low: Vec, high: Vec, scale: float = 1.0) -> Mask:
        """Return the mask of the points farther than the reach from the box low, high (3,) [m]."""
        points = self.points * scale
        apart = np.maximum(np.maximum(low - points, points - high), 0.0)
        return np.asarray(np.linalg.norm(apart, axis=1) > self.reach)

    def largest_coordinate(self) -> float:
        """Return the largest absolute coordinate of the points [m]."""
        return _largest(self.points)


def box_of(points: Vec) -> Vec:
    """Return the box (2, 3) of points (n, 3); without points, the origin."""
    return np.stack([points.min(axis=0), points.max(axis=0)]) if len(points) else np.zeros((2, 3))


def lying_outside(places: Places, leaves: Mask, verdicts: NDArray[np.uint8], info: SceneInfo) -> Mask:
    """Return the mask (k,) of the places outside the scan that `info` describes.

    A place in contact is never outside.
    leaves: (k,), the answers' `outside`: their reach leaves the bounds.
    verdicts: (k,), of the answers.
    """
    return places.outside(*_bounds(info)) & leaves & (verdicts != Verdict.CONTACT)


def outside_line(places: Places, outside: Mask, info: SceneInfo, word: str) -> str:
    """Return a sentence with the number of places outside, and a hint about millimetres.

    The hint is given if most places would lie inside after division by 1000.
    word: plural noun for the places.
    """
    low, high = (" ".join(f"{value:.3f}" for value in corner) for corner in info.bounds)
    count = int(outside.sum())
    largest = _largest(np.array(info.bounds))
    line = f"{count} of {len(outside)} {word} lie outside the scan (its bounds: {low} .. {high} m)"
    inside = int((outside & ~places.outside(*_bounds(info), 1e-3)).sum())
    if inside >= _MOST * count and places.largest_coordinate() * 1e-3 >= _LEAST * largest:
        which = "they" if inside == count else f"{inside} of them"
        line += f"; divided by 1000 {which} would lie inside: expected metres, not millimetres?"
    return line


def _bounds(info: SceneInfo) -> tuple[Vec, Vec]:
    """Return the corners of the box that encloses the spheres of the scan's points [m]."""
    low, high = np.array(info.bounds, np.float64)
    return low - info.radius, high + info.radius


def _largest(*positions: Vec) -> float:
    """Return the largest absolute coordinate."""
    return max(float(np.abs(each).max(initial=0.0)) for each in positions)


def _scaled(poses: Vec, scale: float) -> Vec:
    """Return poses (k, 4, 4) with their translations multiplied by `scale`."""
    found = poses.copy()
    found[:, :3, 3] *= scale
    return found
