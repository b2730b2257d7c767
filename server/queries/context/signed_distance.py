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
from ...kernels.nearest.nearest_search import AVATAR, CLOUD, COLUMNS, LOWER, NORMAL, SIGNED, write_results
from .query_context import SceneData


def signed_from_square(square: NDArray[np.int64], radii: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the signed distances (k,) [m] of pairs.

    square: |a - b|^2.  radii: r_a + r_b. Both are in exact units.
    """
    above = (square - radii * radii).astype(np.float64)
    both = np.sqrt(square.astype(np.float64)) + radii.astype(np.float64)
    return np.divide(above, both, out=np.zeros(len(square)), where=both > 0) / UNITS_PER_METRE


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
    k = len(nearest.square)
    results, exact = np.empty((k, COLUMNS)), np.empty(k, bool)
    write_results(nearest, reach.units - reach_units, farthest, data.arrays, results, exact)
    signed, lower = results[:, SIGNED].copy(), results[:, LOWER].copy()
    clear = np.where(exact | (lower > 0), Verdict.CLEAR, Verdict.UNKNOWN)
    return {
        "verdict": np.where(signed <= 0, Verdict.CONTACT, clear).astype(np.uint8), "signed_distance": signed,
        "lower": lower, "upper": signed.copy(), "exact": exact, "witness_avatar": results[:, AVATAR:CLOUD].copy(),
        "witness_cloud": results[:, CLOUD:].copy(), "normal": results[:, NORMAL:AVATAR].copy(),
        "outside": reach.outside, "voxels_missing": counts[0], "node_visits": counts[1], "point_tests": counts[2],
    }  # fmt: skip
