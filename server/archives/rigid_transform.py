"""Transforms between the world and the frame of an archive that has a pose.

Every sum adds float64 products in the same order, so that all callers get the same bits.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...schemas.archive.rigid_pose import RIGID_TOLERANCE, rigid_pose

Pose = NDArray[np.float64]  # (4, 4), archive to world

# Largest deviation of an archive's pose from a rigid one: half that of an avatar's pose
# (kernels/core/reach.py), because a pose in the archive's frame has both deviations.
_TOLERANCE = RIGID_TOLERANCE / 2


def archive_pose(pose: ArrayLike | None, where: str = "pose of the archive") -> Pose | None:
    """Check and return the pose (4, 4) of an archive, archive to world; None for the identity.

    where: start of error messages. Raise BadRequestError or BadTransformError for a pose that is
    not rigid.
    """
    found = None if pose is None else rigid_pose(pose, where, _TOLERANCE)
    return None if found is None or np.array_equal(found, np.eye(4)) else found


def inverse_pose(pose: Pose) -> Pose:
    """Return the inverse of a rigid pose, world to archive.

    The rotation is transposed, which is exact. The translation is rounded as in `transform_points`.
    """
    found = np.eye(4)
    found[:3, :3] = pose[:3, :3].T
    found[:3, 3] = -rotate_vectors(found, pose[None, :3, 3])[0]
    found[:3, 3] += 0.0  # never -0.0
    return found


def rotate_vectors(pose: Pose, vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotate vectors (n, 3) by the rotation of a pose (4, 4)."""
    x, y, z = (vectors[:, axis, None] * pose[:3, axis] for axis in range(3))
    return np.asarray((x + y) + z)


def transform_points(pose: Pose, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Transform points (n, 3) by a pose; each coordinate is ((m0 x + m1 y) + m2 z) + m3."""
    return np.asarray(rotate_vectors(pose, points) + pose[:3, 3])


def transform_poses(pose: Pose, poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return pose @ poses for poses (k, 4, 4).

    An invalid pose, such as one with a wrong last row, stays invalid, so that the query refuses it.
    """
    found = poses.copy()
    for column in range(4):
        carry = transform_points if column == 3 else rotate_vectors
        found[:, :3, column] = carry(pose, poses[:, :3, column])
    return found


def transform_boxes(
    pose: Pose, low: NDArray[np.float64], high: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Transform boxes low, high (n, 3) each; return the axis-aligned boxes that enclose them."""
    chosen = [[(low, high)[i >> k & 1][:, k] for k in range(3)] for i in range(8)]
    corners = np.array([transform_points(pose, np.stack(corner, axis=1)) for corner in chosen])
    return corners.min(axis=0), corners.max(axis=0)
