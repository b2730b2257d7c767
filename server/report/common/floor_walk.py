"""Straight walk through the middle of an unknown scan, over its floor; z is up."""

import numpy as np
from numpy.typing import NDArray

from ....schemas.errors import BadDataError

FRAMES, RATE = 1200, 30.0
# Height of the feet above the detected floor [m], as on the façade's walk.
SOLE = 0.03
# Half width of the squares in which the floor is detected, and their spacing along the path [m].
HALF, SPACING = 0.75, 0.25
# Height of a layer [m], and the minimum number of points of a dense layer, as a share of the
# fullest layer's.
LAYER, DENSE = 0.05, 0.2
# Share of points at either end of an axis that is ignored as outliers.
OUTLIERS = 0.02


def floor_walk(
    points: NDArray[np.float64], quantile: float = 0.5
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the times (1200,) [s] and poses (1200, 4, 4) of a walk through points (n, 3) [m].

    Poses are avatar to world. The walk has 30 poses per second. It follows the longer horizontal
    axis, at a quantile of the points along the other. The avatar faces its direction of motion, with its feet SOLE
    above the lowest dense layer of points around it.
    Raises BadDataError if there are too few points to detect a floor.
    """
    low, high = (
        np.quantile(points[:, :2], [OUTLIERS, 1 - OUTLIERS], axis=0) if len(points) else np.zeros((2, 2))
    )
    along = int(np.argmax(high - low))
    across = 1 - along
    middle = float(np.quantile(points[:, across], quantile)) if len(points) else 0.0
    near = points[np.abs(points[:, across] - middle) < HALF]
    places = np.arange(low[along], high[along] + SPACING, SPACING)
    floors = np.array([floor_height(near[np.abs(near[:, along] - place) < HALF, 2]) for place in places])
    known = np.isfinite(floors)
    if not known.any():
        raise BadDataError(
            f"{len(points)} points, too few around the middle to detect a floor: expected a floor: "
            "give scans of a place to walk in"
        )
    floors = _smooth(np.interp(places, places[known], floors[known]))
    at = np.linspace(places[0], places[-1], FRAMES)
    poses = np.zeros((FRAMES, 4, 4))
    # The avatar faces +y; for a walk along x it is turned right by 90 degrees.
    poses[:, :3, :3] = np.eye(3) if along == 1 else np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    poses[:, along, 3], poses[:, across, 3] = at, middle
    poses[:, 2, 3] = np.interp(at, places, floors) + SOLE
    poses[:, 3, 3] = 1.0
    return np.arange(FRAMES) / RATE, poses


def floor_height(heights: NDArray[np.float64]) -> float:
    """Return the top of the lowest dense layer of heights (n,) [m]; NaN if there are too few."""
    if len(heights) < 5:
        return np.nan
    start = heights.min()
    layer = ((heights - start) / LAYER).astype(np.int64)
    layers, counts = np.unique(layer, return_counts=True)
    lowest = layers[np.argmax(counts >= max(3, DENSE * counts.max()))]
    return float(start + (lowest + 1) * LAYER)


def _smooth(floors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Smooth the heights of the floor along the path.

    Medians of five remove single holes and boxes; then means of five make ramps.
    """
    padded = np.pad(floors, 2, mode="edge")
    medians = np.median(np.lib.stride_tricks.sliding_window_view(padded, 5), axis=1)
    padded = np.pad(medians, 2, mode="edge")
    return np.lib.stride_tricks.sliding_window_view(padded, 5).mean(axis=1)
