"""Parts of charts with lines: names beside the lines' ends, and plain numbers at logarithmic axes."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

# Distance of names from the axes, as a share of these, and height of a line of text, as a multiple
# of its font's size.
LABEL_AT, LINE = 1.03, 1.3


def label_ends(axes: Any, ends: Sequence[tuple[float, float, str, str]], font: float) -> None:
    """Write the name of each line beside the axes at the height of its end, with a thin line to it.

    ends: x and y of a line's last point, its name and its colour. Names keep a distance from one
    another, so that none overlaps another or a line. The limits of the axes must be final,
    and the figure drawn.
    font: size of the names, in points.
    """
    to_axes = axes.transData + axes.transAxes.inverted()
    known = [end for end in ends if np.isfinite(end[1])]
    lines = max((name.count("\n") + 1 for _, _, name, _ in known), default=1)
    height = axes.get_window_extent().height / axes.figure.dpi * 72  # in points
    gap = LINE * font * lines / height
    heights = np.array([to_axes.transform(end[:2])[1] for end in known])
    for (x, y, name, colour), at in zip(known, spread(heights, gap), strict=True):
        axes.annotate(
            name, (x, y), xytext=(LABEL_AT, float(at)), textcoords="axes fraction", fontsize=font,
            color=colour, va="center", ha="left", annotation_clip=False,
            arrowprops={
                "arrowstyle": "-", "lw": 0.6, "color": colour, "shrinkA": 1, "shrinkB": 3, "relpos": (0.0, 0.5),
            },
        )  # fmt: skip


def spread(heights: Floats, gap: float) -> Floats:
    """Return heights (k,) in the same order, at least `gap` apart, moved as little as is simple."""
    found = heights.astype(np.float64)
    order = np.argsort(found, kind="stable")
    for _ in range(100):
        apart = np.diff(found[order])
        close = np.flatnonzero(apart < gap - 1e-9)
        if not len(close):
            break
        for k in close:
            missing = (gap - (found[order[k + 1]] - found[order[k]])) / 2
            if missing > 0:
                found[order[k]] -= missing
                found[order[k + 1]] += missing
    return found


def plain_ticks(axis: Any) -> None:
    """Format a logarithmic axis with plain numbers, at 1, 2 and 5."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())
