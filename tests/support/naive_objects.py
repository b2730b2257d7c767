"""Contacts of objects by brute force: every pair of points of every pair of objects, in integers."""

from collections.abc import Sequence

import naive
import numpy as np
from numpy.typing import ArrayLike, NDArray


def touching_pairs(
    bodies: Sequence[NDArray[np.float64]],
    radii: Sequence[float],
    poses: NDArray[np.float64],
    groups: Sequence[int],
    masks: Sequence[int],
    origin: ArrayLike,
    margin: float = 0.0,
) -> list[list[int]]:
    """Return the pairs of objects in contact, lesser number first, ascending.

    bodies: (m, 3) points of each object, avatar frame.
    """
    placed = [naive.placed_units(body, pose, origin) for body, pose in zip(bodies, poses, strict=True)]
    units = [naive.reach_units(radius, 0.0, 0.0) for radius in radii]
    more = int(np.rint(margin * naive.UNITS))
    found = []
    for i in range(len(placed)):
        for j in range(i + 1, len(placed)):
            if not (groups[i] & masks[j] and groups[j] & masks[i]):
                continue
            if _touch(placed[i], placed[j], units[i] + units[j] + more):
                found.append([i, j])
    return found


def touching_scene(
    lattice: NDArray[np.int64],
    step: float,
    scan_radii: NDArray[np.int64],
    bodies: Sequence[NDArray[np.float64]],
    radii: Sequence[float],
    poses: NDArray[np.float64],
    origin: ArrayLike,
    margin: float = 0.0,
) -> list[bool]:
    """Return which objects touch scan points (n, 3), lattice, each with a radius (n,), exact units."""
    b, more = naive.scan_units(lattice, step), int(np.rint(margin * naive.UNITS))
    found = []
    for body, radius, pose in zip(bodies, radii, poses, strict=True):
        a, own = naive.placed_units(body, pose, origin), naive.reach_units(radius, 0.0, 0.0) + more
        # All points of one radius at a time.
        found.append(any(_touch(a, b[scan_radii == r], own + int(r)) for r in np.unique(scan_radii)))
    return found


def _touch(a: NDArray[np.int64], b: NDArray[np.int64], reach: int) -> bool:
    """Return whether any pair is within reach.

    Points outside the other's box enlarged by the reach are skipped.
    """
    for _ in range(2):
        if not len(a) or not len(b):
            return False
        a, b = b[((b >= a.min(axis=0) - reach) & (b <= a.max(axis=0) + reach)).all(axis=1)], a
    return naive.touches(a, b, reach)
