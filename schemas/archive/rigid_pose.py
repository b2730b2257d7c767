"""Check that a pose is rigid: a rotation and a translation (NUMERICS.md N6).

It applies to poses of archives, of objects, of users in frames, and in scene files. A kernel checks
the thousands of poses of a query (server/kernels/core/reach.py).
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import BadRequestError, BadTransformError
from .pose_arrays import one_pose
from .voxel_grid import MAX_COORDINATE

# Largest deviation of a rotation's Gram matrix from the identity.
RIGID_TOLERANCE = 1e-9
# Advice about a rotation that is off by rounding; those of float32 numbers are off by about 1e-7.
RENORMALISE = "solidcloud.poses.renormalise returns the nearest rotation"
# Largest deviation of a Gram matrix for which that advice is given; beyond it, the pose is a
# mistake.
_ROUNDED = 1e-2


def gram(pose: Sequence[Sequence[float]]) -> list[list[float]]:
    """Return the Gram matrix (3, 3) of the rows of a pose's rotation, the identity if exact."""
    return [[a * d + b * e + c * f for d, e, f, _ in pose[:3]] for a, b, c, _ in pose[:3]]


def rigid_fault(pose: Sequence[Sequence[float]], tolerance: float = RIGID_TOLERANCE) -> str | None:
    """Return a description of the fault of a pose of 4 rows of 4; None if the pose is rigid."""
    # In Python's numbers, which takes a fifth of numpy's time for one pose.
    (a, b, c, _), (d, e, f, _), (g, h, i, _), last = pose
    off = (
        abs(a * a + b * b + c * c - 1), abs(d * d + e * e + f * f - 1), abs(g * g + h * h + i * i - 1),
        abs(a * d + b * e + c * f), abs(a * g + b * h + c * i), abs(d * g + e * h + f * i),
    )  # fmt: skip
    if list(last) != [0.0, 0.0, 0.0, 1.0]:
        reason = f"its last row is {list(last)}"
    elif not sum(off) <= tolerance and not all(each <= tolerance for each in off):  # true for NaN
        reason = f"off by {np.max(off):.2g}"
    elif a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) < 0:
        reason = "it mirrors"
    else:
        return None
    advice = f": {RENORMALISE}" if reason.startswith("off") and np.max(off) <= _ROUNDED else ""
    return (
        f"not rigid, {reason}: expected a row-major 4x4 pose of a rotation, within {tolerance:g}, and a "
        f"translation, last row 0 0 0 1{advice}"
    )


def check_rigid(
    pose: NDArray[np.float64], where: str, tolerance: float = RIGID_TOLERANCE
) -> NDArray[np.float64]:
    """Return a pose (4, 4) if it is rigid, else raise BadTransformError. where: for the message."""
    fault = rigid_fault(pose.tolist(), tolerance)
    if fault is not None:
        raise BadTransformError(f"{where}: {fault}")
    return pose


def rigid_pose(pose: Any, where: str, tolerance: float = RIGID_TOLERANCE) -> NDArray[np.float64]:
    """Return a copy (4, 4) of a rigid pose, given as (4, 4) or (1, 4, 4), after checking it.

    where: start of error messages. Raises BadRequestError for a wrong shape, a number that is not
    finite or a translation of over 1e9 m, BadTransformError for a pose that is not rigid.
    """
    array = one_pose(pose, where).copy()
    if not np.isfinite(array).all() or np.abs(array[:3, 3]).max() > MAX_COORDINATE:
        raise BadRequestError(f"{where}: expected finite numbers, and a translation within 1e9 m")
    return check_rigid(array, where, tolerance)
