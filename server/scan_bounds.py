"""Which poses, motions, rays and points of a query lie outside a scan, for `solidcloud query` to say so.

An answer's `outside` says that the reach of a question leaves the bounds of the scan. Lying outside says more: the box
of the body, grown by what the question reaches beyond it, does not meet the bounds at all, so no point of the scan can
decide the answer. `clear` is right there, and rarely what was meant.
"""

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ..schemas.answers import Verdict
from ..schemas.messages import SceneInfo

Vec = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Before millimetres are suggested, this share of the places outside must lie inside by them, and the largest coordinate
# must be this part of the scan's largest: about the origin anything lies inside once it is divided by enough.
_MOST, _LEAST = 0.9, 0.05


class Places(Protocol):
    """Where the parts of a question lie."""

    def outside(self, low: Vec, high: Vec, scale: float = 1.0) -> Mask:
        """Return which of the k places do not meet the box low, high (3,) [m]; positions are multiplied by `scale`."""
        ...

    def farthest(self) -> float:
        """Return the largest coordinate of all positions, without sign [m]."""
        ...


class Bodies(NamedTuple):
    """Avatars at poses, or on their way between two.

    boxes: (k, 2, 3) or (1, 2, 3), low and high corner of each avatar's points, in its own frame [m].
    radius: (k,) or (1,), of the avatars' points [m].  reach: beyond these [m].
    pose_from, pose_to: (k, 4, 4), avatar to world; the same array for avatars that do not move.
    """

    boxes: Vec
    radius: Vec
    reach: float
    pose_from: Vec
    pose_to: Vec

    def outside(self, low: Vec, high: Vec, scale: float = 1.0) -> Mask:
        """Return which bodies do not meet the box low, high (3,) [m] anywhere on their way."""
        poses = [_scaled(pose, scale) for pose in (self.pose_from, self.pose_to)]
        ends = [self._boxes_at(pose) for pose in poses]
        # A point on a screw motion stays within half the way between its ends of the box around these: the bulge of an
        # arc of up to half a turn. Of the points of a box, a corner goes farthest.
        way = np.einsum("kij,kcj->kci", (poses[1] - poses[0])[:, :3, :3], self._corners())
        way += (poses[1] - poses[0])[:, None, :3, 3]
        bulge = np.linalg.norm(way, axis=2).max(axis=1, initial=0.0)[:, None] / 2
        least = np.minimum(ends[0][0], ends[1][0]) - bulge
        most = np.maximum(ends[0][1], ends[1][1]) + bulge
        return np.asarray(((least > high) | (most < low)).any(axis=1))

    def farthest(self) -> float:
        """Return the largest coordinate of the poses."""
        return _largest(self.pose_from[:, :3, 3], self.pose_to[:, :3, 3])

    def _boxes_at(self, poses: Vec) -> tuple[Vec, Vec]:
        """Return the low and high corners (k, 3) of world boxes that hold the bodies at poses (k, 4, 4)."""
        turn = poses[:, :3, :3]
        middle, half = (self.boxes[:, 0] + self.boxes[:, 1]) / 2, (self.boxes[:, 1] - self.boxes[:, 0]) / 2
        grown = self.radius * np.linalg.norm(turn[:, :, 0], axis=1) + self.reach
        center = np.einsum("kij,kj->ki", turn, np.broadcast_to(middle, (len(poses), 3))) + poses[:, :3, 3]
        extent = np.einsum("kij,kj->ki", np.abs(turn), np.broadcast_to(half, (len(poses), 3)))
        extent += grown[:, None]
        return center - extent, center + extent

    def _corners(self) -> Vec:
        """Return the eight corners (k, 8, 3) of each box."""
        chosen = np.array([[(i >> axis) & 1 for axis in range(3)] for i in range(8)])
        corners = self.boxes[:, chosen, np.arange(3)]
        return np.broadcast_to(corners, (len(self.pose_from), 8, 3))


class Rays(NamedTuple):
    """Rays. origins, directions: (k, 3), world [m]; directions of any length but 0.  reach: of the rays [m]."""

    origins: Vec
    directions: Vec
    reach: float

    def outside(self, low: Vec, high: Vec, scale: float = 1.0) -> Mask:
        """Return which rays end before they meet the box low, high (3,) [m], or pass it."""
        origins = self.origins * scale
        unit = self.directions / np.linalg.norm(self.directions, axis=1)[:, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            ends = np.stack([(low - origins) / unit, (high - origins) / unit])
        level = unit == 0
        within = (low <= origins) & (origins <= high)
        near = np.where(level, np.where(within, -np.inf, np.inf), ends.min(axis=0)).max(axis=1)
        far = np.where(level, np.where(within, np.inf, -np.inf), ends.max(axis=0)).min(axis=1)
        return np.asarray(np.maximum(near, 0.0) > np.minimum(far, self.reach))

    def farthest(self) -> float:
        """Return the largest coordinate of the origins."""
        return _largest(self.origins)


class Points(NamedTuple):
    """Loose points. points: (k, 3), world [m].  reach: around each [m]."""

    points: Vec
    reach: float

    def outside(self, low: Vec, high: Vec, scale: float = 1.0) -> Mask:
        """Return which points are farther than their reach from the box low, high (3,) [m]."""
        points = self.points * scale
        apart = np.maximum(np.maximum(low - points, points - high), 0.0)
        return np.asarray(np.linalg.norm(apart, axis=1) > self.reach)

    def farthest(self) -> float:
        """Return the largest coordinate of the points."""
        return _largest(self.points)


def box_of(points: Vec) -> Vec:
    """Return the box (2, 3) of points (n, 3); of none, that of the origin."""
    return np.stack([points.min(axis=0), points.max(axis=0)]) if len(points) else np.zeros((2, 3))


def lying_outside(places: Places, leaves: Mask, verdicts: NDArray[np.uint8], info: SceneInfo) -> Mask:
    """Return which places (k,) lie outside the scan that `info` describes; one in contact never does.

    leaves: (k,), the answers' `outside`: their reach leaves the bounds.  verdicts: (k,), the answers'.
    """
    return places.outside(*_bounds(info)) & leaves & (verdicts != Verdict.CONTACT)


def outside_line(places: Places, outside: Mask, info: SceneInfo, word: str) -> str:
    """Return the sentence that says how many places lie outside, and whether they would not in millimetres.

    word: plural of what a place is.
    """
    low, high = (" ".join(f"{value:.3f}" for value in corner) for corner in info.bounds)
    count = int(outside.sum())
    farthest = _largest(np.array(info.bounds))
    line = f"{count} of {len(outside)} {word} lie outside the scan (its bounds: {low} .. {high} m)"
    inside = int((outside & ~places.outside(*_bounds(info), 1e-3)).sum())
    if inside >= _MOST * count and places.farthest() * 1e-3 >= _LEAST * farthest:
        which = "they" if inside == count else f"{inside} of them"
        line += f"; divided by 1000 {which} would lie inside: expected metres, not millimetres?"
    return line


def _bounds(info: SceneInfo) -> tuple[Vec, Vec]:
    """Return the corners of the box that holds the spheres of the scan's points [m]."""
    low, high = np.array(info.bounds, np.float64)
    return low - info.radius, high + info.radius


def _largest(*positions: Vec) -> float:
    """Return the largest of some coordinates, without sign."""
    return max(float(np.abs(each).max(initial=0.0)) for each in positions)


def _scaled(poses: Vec, scale: float) -> Vec:
    """Return poses (k, 4, 4) with translations multiplied."""
    found = poses.copy()
    found[:, :3, 3] *= scale
    return found
