"""Contact by definition: every pair of points, in integers.

Plain numpy without code of the project, so that a mistake is not made twice (NUMERICS.md N5,
"Contract"). A scan point is its lattice point as an integer in units of 2^-26 m. An avatar point is
the integer of its position under the pose. Two spheres touch if |a - b|^2 <= (r_a + r_b +
margin)^2.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

UNITS = 2.0**26  # exact units per metre


def lattice_of(points: ArrayLike, origin: ArrayLike, step: float) -> NDArray[np.int64]:
    """Return lattice integers (n, 3) of source points (n, 3), world [m]."""
    return np.rint((np.asarray(points, np.float64) - np.asarray(origin, np.float64)) / step).astype(np.int64)


def scan_units(lattice: NDArray[np.int64], step: float) -> NDArray[np.int64]:
    """Return lattice integers (n, 3) in exact units: one product, rounded half to even."""
    return np.rint(lattice.astype(np.float64) * (step * UNITS)).astype(np.int64)


def placed_units(
    avatar: NDArray[np.float64], pose: NDArray[np.float64], origin: ArrayLike
) -> NDArray[np.int64]:
    """Return avatar points (m, 3) under a pose (4, 4) in exact units from the dataset's origin."""
    columns = []
    for r in range(3):
        shift = pose[r, 3] - np.float64(origin[r])
        metres = ((pose[r, 0] * avatar[:, 0] + pose[r, 1] * avatar[:, 1]) + pose[r, 2] * avatar[:, 2]) + shift
        columns.append(np.rint(metres * UNITS).astype(np.int64))
    return np.stack(columns, axis=1)


def reach_units(avatar_radius: float, scan_radius: float, margin: float) -> int:
    """Return r_a + r_b + margin in exact units, each rounded once."""
    return (
        int(np.rint(avatar_radius * UNITS)) + int(np.rint(scan_radius * UNITS)) + int(np.rint(margin * UNITS))
    )


def touches(a: NDArray[np.int64], b: NDArray[np.int64], reach: int) -> bool:
    """Return whether any pair of a (m, 3) and b (n, 3), exact units, is within or at the reach."""
    rows = max(1, 2_000_000 // max(1, len(b)))
    for start in range(0, len(a), rows):
        apart = np.abs(a[start : start + rows, None, :] - b[None, :, :])
        # A pair farther apart than the reach on one axis does not touch; the squares of all others
        # fit into 63 bits.
        near = apart[(apart <= reach).all(axis=2)]
        if ((near * near).sum(axis=1) <= reach * reach).any():
            return True
    return False


def least_square(a: NDArray[np.int64], b: NDArray[np.int64]) -> int:
    """Return the least |a - b|^2 over all pairs, in Python integers."""
    apart = (a[:, None] - b).reshape(-1, 3)
    nearly = (apart.astype(np.float64) ** 2).sum(axis=1)
    # The error of float64 is below 10^-15 of a square: the least square is among those within 10^-9
    # of the apparent least.
    candidates = apart[nearly <= nearly.min() * (1 + 1e-9)]
    return min(sum(d * d for d in row) for row in candidates.tolist())


def collide(
    points: ArrayLike,
    origin: ArrayLike,
    step: float,
    scan_radius: float,
    avatar: ArrayLike,
    avatar_radius: float,
    poses: NDArray[np.float64],
    margin: float = 0.0,
) -> NDArray[np.bool_]:
    """Return whether the avatar touches the scan under each of the poses (k, 4, 4)."""
    b = scan_units(lattice_of(points, origin, step), step)
    body = np.asarray(avatar, np.float64).reshape(-1, 3)
    found = np.zeros(len(poses), bool)
    for i, pose in enumerate(poses):
        reach = reach_units(avatar_radius, scan_radius, margin)
        a = placed_units(body, pose, origin)
        if not len(a):
            continue
        # Scan points outside the avatar's box enlarged by the reach are farther than the reach on
        # one axis.
        near = ((b >= a.min(axis=0) - reach) & (b <= a.max(axis=0) + reach)).all(axis=1)
        found[i] = touches(a, b[near], reach)
    return found
