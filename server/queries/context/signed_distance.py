"""Signed distances in metres from integer squares, and bounds of what was not examined.

The definition uses the integers of NUMERICS.md N5. Let D2 = |a - b|^2 and r = r_a + r_b for a pair
of placed avatar centre a and scan point b, with the pair's own radii, each rounded once to exact
units. Of all pairs, take the one with the least separation sqrt(D2) - r, compared exactly. Its
signed distance is

    (D2 - r^2) / (sqrt(D2) + r) / 2^26 m

with the difference in int64 and the rest in float64, in this order; it is 0 if D2 and r are 0. This
equals sqrt(D2) - r without cancellation. It is negative if the spheres overlap, zero if they touch
and positive if they do neither. No pair has a smaller separation, so the signed distance is
positive exactly if no pair of spheres is in contact. If all scan points have the same radius, the
pair is that with the least D2.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ....schemas.archive.units import UNITS_PER_METRE
from ....schemas.wire.answers import Verdict
from ...kernels.core.voxels_in_reach import VoxelsInReach
from ...kernels.nearest.nearest_pair import NearestPairs
from .query_context import SceneData


def signed_from_square(square: NDArray[np.int64], radii: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the signed distances (k,) [m] of pairs.

    square: |a - b|^2.  radii: r_a + r_b. Both are in exact units.
    """
    above = (square - radii * radii).astype(np.float64)
    both = np.sqrt(square.astype(np.float64)) + radii.astype(np.float64)
    return np.divide(above, both, out=np.zeros(len(square)), where=both > 0) / UNITS_PER_METRE


def signed_bound(
    steps: NDArray[np.float64], data: SceneData, radii: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return lower bounds (k,) of the signed distance [m] for centres at least `steps` apart.

    radii: (k,) sum of the largest radii of avatar and scan, exact units.
    """
    metres = steps * data.arrays.step * (1.0 - 1e-12)
    return metres - radii / UNITS_PER_METRE - 2.0 / UNITS_PER_METRE


def unknown_gaps(data: SceneData, reach: VoxelsInReach) -> NDArray[np.float64]:
    """Return lower bounds (k,) of the distance of centres from regions left out [steps].

    The bound is inf without regions of scans that were left out.
    """
    k = len(reach.units)
    if data.nothing_clear:
        return np.zeros(k)
    # The boxes enclose the avatar's centres and the reach around them.
    own = (reach.units / data.arrays.units_per_step)[:, None]
    low, high = reach.boxes[:, 0] + own, reach.boxes[:, 1] - own
    gaps = np.full(k, np.inf)
    for region_low, region_high in data.unknown:
        apart = np.maximum(np.maximum(region_low - high, low - region_high), 0.0)
        gaps = np.minimum(gaps, np.sqrt((apart * apart).sum(axis=1)) * (1.0 - 1e-9))
    return gaps


def distance_columns(
    data: SceneData,
    reach: VoxelsInReach,
    farthest: float,
    reach_units: int,
    nearest: NearestPairs,
    counts: NDArray[np.uint32],
) -> dict[str, Any]:
    """Return the fields of `DistanceAnswers` except the cost of the request.

    farthest: the requested reach [m].  reach_units: the same, exact units.
    nearest: the pairs found; its gap includes missing voxels, unknown regions and what was not
    examined.
    """
    radii = reach.units - reach_units  # of the largest spheres
    found = nearest.square >= 0
    signed = np.where(
        found, signed_from_square(np.maximum(nearest.square, 0), radii - nearest.deficit), np.inf
    )
    floor = np.maximum(signed_bound(nearest.missing_bound, data, radii), -radii / UNITS_PER_METRE)
    # `farthest` may exceed the reach in exact units by a rounding.
    exact = floor >= np.where(found, signed, farthest)
    lower = np.where(exact, np.minimum(signed, farthest), np.minimum(np.minimum(signed, floor), farthest))
    verdict = np.where(signed <= 0, Verdict.CONTACT, np.where(lower > 0, Verdict.CLEAR, Verdict.UNKNOWN))
    verdict[exact & (signed > 0)] = Verdict.CLEAR
    origin = data.arrays.origin
    difference = (nearest.pair[:, 3:] - _units_of(data, nearest.pair[:, :3])).astype(np.float64)
    length = np.sqrt(np.maximum(nearest.square, 0).astype(np.float64))[:, None]
    normal = np.divide(difference, length, out=np.zeros((len(found), 3)), where=length > 0)
    nowhere = ~found
    witness_avatar = nearest.pair[:, 3:] / UNITS_PER_METRE + origin
    witness_cloud = (
        nearest.pair[:, :3] * data.arrays.step + origin
    )  # as schemas/archive/voxel_grid.py Lattice.to_world
    for column in (normal, witness_avatar, witness_cloud):
        column[nowhere] = np.nan
    return {
        "verdict": verdict.astype(np.uint8), "signed_distance": signed, "lower": lower, "upper": signed.copy(),
        "exact": exact, "witness_avatar": witness_avatar, "witness_cloud": witness_cloud, "normal": normal,
        "outside": reach.outside, "voxels_missing": counts[0], "node_visits": counts[1], "point_tests": counts[2],
    }  # fmt: skip


def _units_of(data: SceneData, lattice: NDArray[np.int64]) -> NDArray[np.int64]:
    """Convert lattice points to exact units (k, 3): one product, half to even (NUMERICS.md N5)."""
    return np.rint(lattice.astype(np.float64) * data.arrays.units_per_step).astype(np.int64)
