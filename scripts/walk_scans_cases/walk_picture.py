"""Picture of a walk: the plan of the scan with the route, and the histogram of the feet's heights."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from solidcloud.server.report.common.sphere_pictures import load_pyplot

from .floor_heights import BINS, FeetHeights
from .route_walk import Walked
from .routes import Route, Scan

Floats = NDArray[np.float64]

_INK, _FREE, _WALL, _BUMPS = "#5f5140", "#2f7391", "#a50f26", "#9ad1ea"
# Heights of the points of the plan above the feet, and margin around the walk [m].
_LOW, _HIGH, _MARGIN = 0.2, 1.7, 1.5


def draw(
    scan: Scan, route: Route, walked: Walked, points: Floats, feet: Floats, heights: FeetHeights, target: Path
) -> None:
    """Write the picture as PNG. points: (n, 3), of the scan.  feet: (k,) heights of the feet [m]."""
    pyplot = load_pyplot()
    plan = list(scan.plan())
    places = walked.poses[:, plan, 3]
    low, high = places.min(axis=0) - _MARGIN, places.max(axis=0) + _MARGIN
    up = points[:, scan.up]
    near = ((points[:, plan] >= low) & (points[:, plan] <= high)).all(axis=1)
    stones = points[near & (up > feet.min() + _LOW) & (up < feet.max() + _HIGH)][:, plan]
    figure, (left, right) = pyplot.subplots(
        1, 2, figsize=(15, 7), dpi=110, layout="constrained", width_ratios=[1.7, 1]
    )
    left.plot(*stones.T, ",", color=_INK, alpha=0.3)
    touching = walked.touching()
    left.plot(*places[~touching].T, ".", color=_FREE, markersize=4, label="free")
    left.plot(*places[touching].T, ".", color=_WALL, markersize=4, label="along walls")
    left.plot(*np.array([leg.to for leg in route.legs]).T, "+", color="black", markersize=10)
    left.set(aspect="equal", xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    left.set_title(f"{scan.file}, {route.name}: {walked.why}, {len(places)} frames", loc="left")
    left.legend(frameon=False)
    right.hist(heights.median, BINS, color=_FREE, label="over the median of the points below")
    right.hist(
        heights.bumps, BINS, histtype="step", linewidth=2, color=_BUMPS, label="over their 95th percentile"
    )
    right.set(xlabel="height of the feet [m]", ylabel="frames")
    right.set_title("height of the feet over the floor", loc="left")
    right.legend(frameon=False)
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(target)
    pyplot.close(figure)
