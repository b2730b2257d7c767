"""Arrays of poses: one pose or many, wherever a caller gives poses. No numba here."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import BadRequestError

_FLOAT64 = np.dtype("<f8")


def float64_array(values: Any, what: str) -> NDArray[np.float64]:
    """Return numbers as a C-ordered little-endian float64 array. Raise BadRequestError.

    what: name of the numbers, for messages.
    """
    try:
        return np.ascontiguousarray(values, _FLOAT64)
    except (TypeError, ValueError) as error:
        advice = ": solidcloud.poses.from_rotation converts it" if hasattr(values, "as_matrix") else ""
        raise BadRequestError(f"{what}: {error}: expected an array of numbers{advice}") from None


def make_poses(poses: Any, what: str = "poses") -> NDArray[np.float64]:
    """Return one pose (4, 4) or many (k, 4, 4) as an array (k, 4, 4); one is a batch of one.

    what: name of the poses, for messages. Only the shape is checked here. Raise BadRequestError.
    """
    array = float64_array(poses, what)
    if array.ndim != 3 or array.shape[1:] != (4, 4):
        if array.shape == (4, 4):
            return array[None]
        raise _shape_error(array, what, "(4, 4) or (k, 4, 4)")
    return array


def one_pose(pose: Any, what: str = "pose") -> NDArray[np.float64]:
    """Return one pose, given as (4, 4) or (1, 4, 4), as an array (4, 4).

    what: name of the pose, for messages. Only the shape is checked here. Raise BadRequestError.
    """
    array = float64_array(pose, what)
    if array.shape == (4, 4):
        return array
    if array.shape == (1, 4, 4):
        return array[0]
    raise _shape_error(array, what, "one pose, (4, 4) or (1, 4, 4)")


def _shape_error(array: NDArray[np.float64], what: str, expected: str) -> BadRequestError:
    """Return the error for an array that holds no poses."""
    return BadRequestError(
        f"{what} of shape {array.shape}: expected {expected}: solidcloud.poses makes poses from quaternions, "
        "angles and rotations"
    )
