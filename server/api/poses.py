"""Poses from quaternions, Euler angles and rotations, and the rotation nearest to a rounded one.

    pose = solidcloud.poses.from_euler([0.0, 0.0, 1.57], [2.0, 1.0, 0.0], axes="xyz")
    scene.collide("visitor", pose)

A pose is a (4, 4) float64 matrix from the avatar's frame to the world [m], row-major, with the last
row 0 0 0 1. Queries require rotations that are exact to 1e-9 (schemas/NUMERICS.md, N6). Rotations
of float32 numbers are off by about 1e-7 and are refused: `renormalise` returns the nearest ones.

Each function takes one item or many. One returns a pose (4, 4), many return poses (k, 4, 4). One
translation may be given for many rotations, and one rotation for many translations. The functions
raise BadRequestError for values of a wrong shape and for numbers that are not finite.
"""

from itertools import pairwise
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .schemas.archive.pose_arrays import float64_array, make_poses
from .schemas.errors import BadRequestError, BadTransformError

__all__ = ["from_euler", "from_quaternion", "from_rotation", "from_translation", "renormalise"]

Floats = NDArray[np.float64]

ORIGIN: Final = (0.0, 0.0, 0.0)
# A rotation this close to orthonormal is returned unchanged, so that `renormalise` changes nothing
# the second time. Rotations that were computed in float64 are closer.
_ROUNDING = 1e-14
# Least determinant of a matrix for which the nearest rotation is computed. Below it, rounding
# decides which one that is.
_LEAST_VOLUME = 1e-9
# Largest number in a matrix whose nearest rotation is computed.
_LARGEST = 2e3
# Newton's iteration halves a large deviation in a step, and squares a small one. For all matrices
# within the two limits above, it ends after fewer steps.
_MOST_STEPS = 100


def from_translation(translation: ArrayLike) -> Floats:
    """Return the pose without a rotation. translation: (3,) or (k, 3) [m]."""
    return _join(np.eye(3), translation, "rotation")


def from_quaternion(
    quaternion: ArrayLike, translation: ArrayLike = ORIGIN, *, order: Literal["xyzw", "wxyz"]
) -> Floats:
    """Return the pose of a quaternion and a translation.

    quaternion: (4,) or (k, 4), of any length but zero.  translation: (3,) or (k, 3) [m].
    order: "xyzw" as in SciPy, ROS and glTF, "wxyz" as in Eigen's constructor, Blender and the pose
    files of `solidcloud query`. There is no default, because nothing reveals a wrong order.
    """
    if order not in ("xyzw", "wxyz"):
        raise BadRequestError(f"order {order!r}: expected 'xyzw' or 'wxyz'")
    q = _checked(float64_array(quaternion, "quaternion"), "quaternion", 4)
    largest = np.abs(q).max(axis=-1, keepdims=True)
    if not largest.all():
        which = f" {int((largest == 0.0).argmax())}" if q.ndim == 2 else ""
        raise BadRequestError(f"quaternion{which} is zero, which is no rotation: expected any other length")
    # Scaled to components of at most 1, no square overflows, and not all of them underflow.
    q = q / largest
    w, x, y, z = np.moveaxis(np.roll(q, 1, axis=-1) if order == "xyzw" else q, -1, 0)
    # Divided by the squared length, which is exact for quarter turns; dividing the quaternion by
    # its length is not.
    square = w * w + x * x + y * y + z * z
    rows = (
        (w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z),
    )
    rotation = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2) / square[..., None, None]
    return _join(rotation, translation, "quaternion")


def from_euler(angles: ArrayLike, translation: ArrayLike = ORIGIN, *, axes: str) -> Floats:
    """Return the pose of successive rotations about axes, and a translation.

    angles: an angle for each of n axes, (n,) or (k, n) [rad]; for a single axis, one number or (k,).
    translation: (3,) or (k, 3) [m].
    axes: one to three axes, named as by SciPy's `Rotation.from_euler`. "xyz" is extrinsic: about
    the fixed axes x, then y, then z. "XYZ" is intrinsic: about X, then about Y and Z, which rotate
    with the avatar. Yaw, pitch and roll, in this order, are "ZYX".
    """
    if not isinstance(axes, str) or not 1 <= len(axes) <= 3 or not set(axes.lower()) <= set("xyz"):
        raise BadRequestError(f"axes {axes!r}: expected one to three of xyz (extrinsic) or XYZ (intrinsic)")
    if not axes.islower() and not axes.isupper():
        raise BadRequestError(
            f"axes {axes!r}: expected either small letters (extrinsic) or capitals (intrinsic)"
        )
    if any(first == second for first, second in pairwise(axes)):
        raise BadRequestError(f"axes {axes!r}: expected different axes one after the other")
    array = float64_array(angles, "angles")
    if len(axes) == 1 and np.ndim(angles) == 1:
        array = array[:, None]
    array = _checked(array, "angles", len(axes))
    rotation: Floats = np.eye(3)
    for number, axis in enumerate(axes.lower()):
        turn = _about("xyz".index(axis), array[..., number])
        rotation = _product(turn, rotation) if axes.islower() else _product(rotation, turn)
    return _join(rotation, translation, "angles")


def from_rotation(rotation: Any, translation: ArrayLike = ORIGIN) -> Floats:
    """Return the pose of a rotation object and a translation.

    rotation: one or many, with a method `as_matrix` that returns (3, 3) or (k, 3, 3), such as
    `scipy.spatial.transform.Rotation`.  translation: (3,) or (k, 3) [m].
    """
    if not hasattr(rotation, "as_matrix"):
        raise BadRequestError(
            f"rotation of type {type(rotation).__name__}: expected an object with as_matrix, such as SciPy's Rotation"
        )
    matrix = float64_array(rotation.as_matrix(), "as_matrix of the rotation")
    if matrix.ndim not in (2, 3) or matrix.shape[-2:] != (3, 3):
        raise BadRequestError(f"as_matrix of shape {matrix.shape}: expected (3, 3) or (k, 3, 3)")
    # An object that computes in float32 returns a rounded rotation.
    return renormalise(_join(matrix, translation, "rotation"))


def renormalise(poses: ArrayLike, *, within: float = 1e-3) -> Floats:
    """Return poses with each rotation replaced by the nearest one, of the least squared difference.

    poses: (4, 4) or (k, 4, 4), such as those of float32 numbers or of a product of many matrices.
    Translations are not changed. A rotation that is exact to rounding is returned bit for bit, and
    the result is the same on every machine.
    within: largest change of a number in a rotation. At 1e-3, a point 1 m from the avatar's origin
    moves by at most 3 mm.
    Raise BadTransformError for a pose that mirrors, that is farther from a rotation than `within`,
    or whose last row is not 0 0 0 1. The message states the distance.
    """
    array = make_poses(poses)
    given = array[:, :3, :3]
    _refuse(
        np.asarray(~np.isfinite(array).all(axis=(1, 2))), "holds a number that is not finite", BadRequestError
    )
    _refuse(
        (array[:, 3] != (0.0, 0.0, 0.0, 1.0)).any(axis=1),
        "has a last row that is not 0 0 0 1: give row-major 4x4 poses",
    )
    largest = np.abs(given).max(axis=(1, 2))
    _refuse(largest > _LARGEST, "holds {:.3g}: expected a rotation", values=largest)
    determinant = (given[:, 0] * np.cross(given[:, 1], given[:, 2])).sum(axis=-1)
    _refuse(determinant < 0.0, "mirrors (determinant {:.3g}): expected a rotation", values=determinant)
    _refuse(
        determinant < _LEAST_VOLUME, "flattens (determinant {:.3g}): expected a rotation", values=determinant
    )
    nearest = _nearest_rotations(given)
    off = np.abs(nearest - given).max(axis=(1, 2), initial=0.0)
    _refuse(
        ~(off <= within),
        f"is {{:.3g}} from the nearest rotation: expected at most {within:g} (`within`)",
        values=off,
    )
    found = array.copy()
    found[:, :3, :3] = nearest
    return found[0] if np.ndim(poses) == 2 else found


def _nearest_rotations(rotations: Floats) -> Floats:
    """Return the rotations (k, 3, 3) nearest to matrices (k, 3, 3) of positive determinant.

    This is the orthogonal factor of the polar decomposition, by Newton's iteration: the mean of a
    matrix and its inverse transpose. Sums, products and quotients give the same bits on every
    machine; a singular value decomposition does not.
    """
    found = rotations.copy()
    changed = todo = _off(found) > _ROUNDING
    for _ in range(_MOST_STEPS):
        if not todo.any():
            break
        found[todo] = _step(found[todo])
        todo = _off(found) > _ROUNDING
    found[changed] = _step(found[changed])  # from 1e-14 to the last digit
    return found


def _step(m: Floats) -> Floats:
    """Return the means of matrices (k, 3, 3) and their inverse transposes."""
    cofactors = np.stack([np.cross(m[:, i - 2], m[:, i - 1]) for i in range(3)], axis=1)
    determinant = (m[:, 0] * cofactors[:, 0]).sum(axis=-1)
    return (m + cofactors / determinant[:, None, None]) / 2


def _off(m: Floats) -> Floats:
    """Return how far the Gram matrices of matrices (k, 3, 3) are from the identity."""
    gram = _product(m, np.swapaxes(m, -1, -2))
    return np.asarray(np.abs(gram - np.eye(3)).max(axis=(1, 2)))


def _product(a: Floats, b: Floats) -> Floats:
    """Return the products of matrices (..., 3, 3), each sum in the order of its terms."""
    terms = [a[..., :, i, None] * b[..., None, i, :] for i in range(3)]
    return np.asarray((terms[0] + terms[1]) + terms[2])


def _about(axis: int, angles: Floats) -> Floats:
    """Return the rotations (..., 3, 3) about axis 0, 1 or 2 by angles (...) [rad]."""
    second, third = (axis + 1) % 3, (axis + 2) % 3
    found = np.zeros((*angles.shape, 3, 3))
    found[..., axis, axis] = 1.0
    found[..., second, second] = found[..., third, third] = np.cos(angles)
    found[..., third, second] = np.sin(angles)
    found[..., second, third] = -found[..., third, second]
    return found


def _join(rotation: Floats, translation: ArrayLike, what: str) -> Floats:
    """Return the poses of rotations (3, 3) or (k, 3, 3) and translations (3,) or (k, 3).

    what: noun for what the rotations were made from, for messages.
    """
    place = _checked(float64_array(translation, "translation"), "translation", 3)
    counts = [len(each) for each, one in ((rotation, 2), (place, 1)) if each.ndim > one]
    if len(counts) == 2 and counts[0] != counts[1]:
        raise BadRequestError(
            f"{what} for {counts[0]} poses and translation for {counts[1]}: expected equal numbers, or one of either"
        )
    found = np.zeros((*counts[:1], 4, 4))
    found[..., :3, :3], found[..., :3, 3], found[..., 3, 3] = rotation, place, 1.0
    return found


def _checked(array: Floats, what: str, length: int) -> Floats:
    """Return rows (length,) or (k, length) if they are finite. Raise BadRequestError otherwise."""
    if array.ndim not in (1, 2) or array.shape[-1] != length:
        raise BadRequestError(f"{what} of shape {array.shape}: expected ({length},) or (k, {length})")
    if not np.isfinite(array).all():
        where = [int(i) for i in np.argwhere(~np.isfinite(array))[0]]
        raise BadRequestError(f"{what}{where} is {array[tuple(where)]}: expected finite numbers")
    return array


def _refuse(
    wrong: NDArray[np.bool_],
    reason: str,
    error: type[BadRequestError] = BadTransformError,
    values: Floats | None = None,
) -> None:
    """Raise an error that names the first wrong pose, if there is one.

    reason: with a placeholder for the pose's number in `values`, if they are given.
    """
    if wrong.any():
        i = int(wrong.argmax())
        raise error(f"pose {i} {reason if values is None else reason.format(values[i])}")
