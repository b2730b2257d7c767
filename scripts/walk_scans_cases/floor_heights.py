"""Height of the feet over the floor, from the points of the scan alone."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

# The floor below a person: the points within these distances of the feet, horizontally and downwards
# [m], if there are at least _FEWEST. Its height is their median, or that of its highest bumps.
ASIDE, BELOW, _FEWEST, BUMPS = 0.25, 0.3, 5, 95
# Bins of the histogram [m].
BINS = np.round(np.arange(-0.02, 0.3001, 0.01), 2)


class FeetHeights(NamedTuple):
    """Heights of the feet (k,) [m]; NaN where too few points are below.

    median: over the median of the points below.  bumps: over their 95th percentile.
    """

    median: Floats
    bumps: Floats


def feet_heights(points: Floats, feet: Floats, up: int) -> FeetHeights:
    """Return the heights of feet (k, 3) over the scan's points (n, 3), world [m].

    up: number of the vertical axis.
    """
    right, ahead = (axis for axis in range(3) if axis != up)
    ordered = points[points[:, right].argsort(kind="stable")]
    found = np.full((len(feet), 2), np.nan)
    firsts = np.searchsorted(ordered[:, right], feet[:, right] - ASIDE)
    pasts = np.searchsorted(ordered[:, right], feet[:, right] + ASIDE)
    for number, (place, first, past) in enumerate(zip(feet, firsts, pasts, strict=True)):
        near = ordered[first:past] - place
        depth = -near[:, up]
        inside = (np.hypot(near[:, right], near[:, ahead]) <= ASIDE) & (depth >= 0.0) & (depth <= BELOW)
        if inside.sum() >= _FEWEST:
            found[number] = np.median(depth[inside]), np.percentile(depth[inside], 100 - BUMPS)
    return FeetHeights(found[:, 0], found[:, 1])


def summary(heights: Floats) -> dict[str, object]:
    """Return quartiles, extremes and histogram of heights (k,) [m] as plain values."""
    known = heights[np.isfinite(heights)]
    low, middle, high = np.percentile(known, [25, 50, 75]).round(4).tolist()
    counts = np.histogram(known, BINS)[0]
    return {
        "frames": len(known),
        "frames without floor": len(heights) - len(known),
        "quartiles_m": [low, middle, high],
        "least_m": round(float(known.min()), 4),
        "most_m": round(float(known.max()), 4),
        "histogram": {
            f"{low:.2f}": int(count) for low, count in zip(BINS[:-1], counts, strict=True) if count
        },
    }
