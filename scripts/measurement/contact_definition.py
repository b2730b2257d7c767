"""Definition of contact over every pair of points in integers (NUMERICS.md N5).

It uses no voxel, no tree and no float32.
"""

from collections.abc import Sequence

import numba as nb
import numpy as np
from numpy.typing import NDArray

UNITS = 2.0**26  # exact units per metre


@nb.njit
def pairs_touch(a: NDArray[np.int64], b: NDArray[np.int64], reach: int) -> bool:
    """Return whether any of a (m, 3) and any of b (n, 3) are within reach.

    All values are in exact units; tangency counts.
    """
    for i in range(a.shape[0]):
        for j in range(b.shape[0]):
            x, y, z = a[i, 0] - b[j, 0], a[i, 1] - b[j, 1], a[i, 2] - b[j, 2]
            # A pair farther apart along one axis is farther apart; the squares of the other pairs
            # fit into 63 bits.
            if (
                abs(x) <= reach
                and abs(y) <= reach
                and abs(z) <= reach
                and x * x + y * y + z * z <= reach * reach
            ):
                return True
    return False


@nb.njit
def least_distance(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Return the least distance of any of a (m, 3) and any of b (n, 3) over all pairs, float64."""
    least = np.inf
    for i in range(a.shape[0]):
        for j in range(b.shape[0]):
            x, y, z = a[i, 0] - b[j, 0], a[i, 1] - b[j, 1], a[i, 2] - b[j, 2]
            least = min(least, x * x + y * y + z * z)
    return least**0.5


class Judge:
    """Definition of contact, over the points of a scan.

    points: (n, 3) float64 world [m].
    origin, step, scan_radius: as the archive declares them [m].
    pairs: number of pairs that the box around the avatar does not rule out; they are tested until
    one touches.
    """

    def __init__(self, points: NDArray[np.float64], origin: Sequence[float], step: float, scan_radius: float):
        lattice = np.rint((points - np.array(origin)) / step)
        units = np.rint(lattice * (step * UNITS)).astype(np.int64)
        self._units = units[units[:, 0].argsort(kind="stable")]
        self._origin = origin
        self._scan_radius = int(np.rint(scan_radius * UNITS))
        self.pairs = 0

    def touches(
        self,
        avatar: NDArray[np.float64],
        radius: float,
        pose: NDArray[np.float64],
        *,
        all_pairs: bool = False,
    ) -> bool:
        """Return whether the avatar (m, 3) [m] touches under a rigid pose (4, 4).

        radius: of the avatar's spheres [m].
        all_pairs: also test pairs that the box around the avatar rules out; the answer is the same.
        """
        reach = int(np.rint(radius * UNITS)) + self._scan_radius
        placed = np.empty((len(avatar), 3), np.int64)
        for r in range(3):
            turned = (pose[r, 0] * avatar[:, 0] + pose[r, 1] * avatar[:, 1]) + pose[r, 2] * avatar[:, 2]
            placed[:, r] = np.rint((turned + (pose[r, 3] - self._origin[r])) * UNITS)
        near = self._units
        if not all_pairs:
            low, high = placed.min(axis=0) - reach, placed.max(axis=0) + reach
            first, past = np.searchsorted(near[:, 0], [low[0], high[0] + 1])
            near = near[first:past]
            near = near[((near >= low) & (near <= high)).all(axis=1)]
        self.pairs += len(near) * len(placed)
        return bool(pairs_touch(placed, near, reach))
