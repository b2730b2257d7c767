"""An archive that lies at a pose in the world: points carried out to the world, poses carried in to the archive.

Every sum is of four float64 products in one order, so that all who carry a point get the same bits.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...schemas.archive.voxel_grid import MAX_COORDINATE
from ...schemas.errors import BadRequestError, BadTransformError

Pose = NDArray[np.float64]  # (4, 4), archive to world

# How far a pose may be from rigid: that of kernels/core/pose_transform.py, which an avatar's pose
# and this one share between them.
RIGID_WITHIN = 5e-10


def archive_pose(pose: ArrayLike | None, where: str = "pose of the archive") -> Pose | None:
    """The pose (4, 4) of an archive, archive to world; None for one at the identity.

    Raises BadRequestError, BadTransformError for what is not rigid. where: for messages.
    """
    if pose is None:
        return None
    found = np.array(pose, np.float64)
    if found.shape != (4, 4):
        raise BadRequestError(f"{where}: shape {found.shape}: expected (4, 4), archive to world")
    if not np.isfinite(found).all() or np.abs(found[:3, 3]).max() > MAX_COORDINATE:
        raise BadRequestError(f"{where}: expected finite numbers, and a translation within 1e9 m")
    if np.array_equal(found, np.eye(4)):
        return None
    turn = found[:3, :3]
    off = float(np.abs(turn @ turn.T - np.eye(3)).max())
    if off > RIGID_WITHIN or np.linalg.det(turn) < 0 or not np.array_equal(found[3], [0, 0, 0, 1]):
        raise BadTransformError(
            f"{where}: not rigid (off by {off:g}): expected a rotation and a translation, last row 0 0 0 1: an archive "
            "is neither scaled nor mirrored"
        )
    return found


def inverse_of(pose: Pose) -> Pose:
    """World to archive, of a rigid pose: transposed, which is exact; the translation rounded as `to_world` rounds."""
    found = np.eye(4)
    found[:3, :3] = pose[:3, :3].T
    found[:3, 3] = -turned(found, pose[None, :3, 3])[0]
    found[:3, 3] += 0.0  # never -0.0
    return found


def turned(pose: Pose, vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Vectors (n, 3) turned by a pose, not moved."""
    x, y, z = vectors.T
    return np.stack([(m[0] * x + m[1] * y) + m[2] * z for m in pose[:3]], axis=1)


def moved(pose: Pose, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points (n, 3) carried by a pose: ((m0 x + m1 y) + m2 z) + m3."""
    return np.asarray(turned(pose, points) + pose[:3, 3])


def under(pose: Pose, poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Poses (k, 4, 4) followed by a pose: pose @ poses. What makes them no poses, such as a last row, stays."""
    found = poses.copy()
    for column in range(4):
        carry = moved if column == 3 else turned
        found[:, :3, column] = carry(pose, poses[:, :3, column])
    return found


def moved_boxes(
    pose: Pose, low: NDArray[np.float64], high: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The boxes low, high (n, 3) around the eight corners of each of the boxes low, high (n, 3) carried by a pose."""
    chosen = [[(low, high)[i >> k & 1][:, k] for k in range(3)] for i in range(8)]
    corners = np.array([moved(pose, np.stack(corner, axis=1)) for corner in chosen])
    return corners.min(axis=0), corners.max(axis=0)
