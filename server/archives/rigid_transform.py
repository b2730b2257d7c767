"""Transforms between the world and the frame of an archive that has a pose.

All sums are of float64 products in one order, so that every caller gets the same bits.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...schemas.archive.rigid_pose import RIGID_TOLERANCE, rigid_pose

Pose = NDArray[np.float64]  # (4, 4), archive to world

# How far the pose of an archive may be from rigid: half of what an avatar's pose may be
# (kernels/core/voxels_in_reach.py). A query's pose in the archive's frame is off by both.
_TOLERANCE = RIGID_TOLERANCE / 2


def archive_pose(pose: ArrayLike | None, where: str = "pose of the archive") -> Pose | None:
    """Return the pose (4, 4) of an archive, archive to world; None for the identity.

    where: for messages. Raises BadRequestError or BadTransformError unless the pose is rigid.
    """
    found = None if pose is None else rigid_pose(pose, where, _TOLERANCE)
    return None if found is None or np.array_equal(found, np.eye(4)) else found


def inverse_pose(pose: Pose) -> Pose:
    """Return the inverse of a rigid pose, world to archive.

    The rotation is transposed, which is exact; the translation is rounded as by `transform_points`.
    """
    found = np.eye(4)
    found[:3, :3] = pose[:3, :3].T
    found[:3, 3] = -rotate_vectors(found, pose[None, :3, 3])[0]
    found[:3, 3] += 0.0  # never -0.0
    return found


def rotate_vectors(pose: Pose, vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return vectors (n, 3) rotated by a pose."""
    x, y, z = vectors.T
    return np.stack([(m[0] * x + m[1] * y) + m[2] * z for m in pose[:3]], axis=1)


def transform_points(pose: Pose, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return points (n, 3) transformed by a pose: ((m0 x + m1 y) + m2 z) + m3."""
    return np.asarray(rotate_vectors(pose, points) + pose[:3, 3])


def transform_poses(pose: Pose, poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return pose @ poses for poses (k, 4, 4). Faults of theirs, such as a last row, are kept."""
    found = poses.copy()
    for column in range(4):
        carry = transform_points if column == 3 else rotate_vectors
        found[:, :3, column] = carry(pose, poses[:, :3, column])
    return found


def transform_boxes(
    pose: Pose, low: NDArray[np.float64], high: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the boxes low, high (n, 3) around the eight corners of each box low, high (n, 3), transformed."""
    chosen = [[(low, high)[i >> k & 1][:, k] for k in range(3)] for i in range(8)]
    corners = np.array([transform_points(pose, np.stack(corner, axis=1)) for corner in chosen])
    return corners.min(axis=0), corners.max(axis=0)
