"""Placement of labels beside the points of a chart, without overlaps."""

from collections.abc import Sequence
from typing import Any

import numpy as np

FONT = 9.0
# Distances of a label from its anchor, in points: beside it first, then farther away with a line to
# it, until it covers no other.
NEAR = 11.0
DISTANCES = (NEAR, 27.0, 45.0, 65.0, 90.0, 120.0, 155.0, 195.0)
TURNS = 16
# Half the size of a star or a ring, in points.
MARK = 8.0


def place_labels(
    panel: Any, anchors: Sequence[tuple[float, float]], labels: Sequence[str], colours: Sequence[str]
) -> None:
    """Place each label near its anchor, in the given order: the first may choose among all places.

    The figure must have been drawn before, because its layout may move the panels.
    """
    from matplotlib.patheffects import withStroke

    figure = panel.figure
    renderer = figure.canvas.get_renderer()
    scale = figure.dpi / 72
    spots = panel.transData.transform(np.asarray(anchors, float))
    frame = panel.get_window_extent(renderer)
    half = MARK * scale
    taken = [(x - half, y - half, x + half, y + half) for x, y in spots]
    for (x, y), anchor, label, colour in zip(spots, anchors, labels, colours, strict=True):
        text = panel.annotate(
            label, anchor, xytext=(0, 0), textcoords="offset points", fontsize=FONT, color=colour, ha="center",
            va="center", zorder=6, arrowprops={"arrowstyle": "-", "lw": 0.5, "color": colour, "shrinkA": 0},
        )  # fmt: skip
        text.set_path_effects(
            [withStroke(linewidth=4.0, foreground="white")]
        )  # keeps the label legible over lines
        box = text.get_window_extent(renderer)
        half_width, half_height = box.width / 2, box.height / 2
        best, least = (0.0, 0.0), np.inf
        for step, distance in enumerate(DISTANCES):
            for k in range(TURNS):
                turn = 2 * np.pi * k / TURNS
                dx = np.cos(turn) * (distance * scale + half_width)
                dy = np.sin(turn) * (distance * scale + half_height)
                rect = (x + dx - half_width, y + dy - half_height, x + dx + half_width, y + dy + half_height)
                cost = 300.0 * step + 20.0 * (1 - np.cos(turn)) + _outside(rect, frame) * 50
                cost += 6.0 * sum(_shared(rect, other) for other in taken)
                if cost < least:
                    best, least = (dx / scale, dy / scale), cost
        text.set_position(best)
        if np.hypot(*best) < NEAR + half_width / scale + 2:
            text.arrow_patch.set_visible(False)
        x0, y0 = x + best[0] * scale - half_width, y + best[1] * scale - half_height
        taken.append((x0, y0, x0 + 2 * half_width, y0 + 2 * half_height))


def _shared(one: tuple[float, ...], other: tuple[float, ...]) -> float:
    """Return the area of the intersection of two rectangles (left, low, right, high), in pixels."""
    width = min(one[2], other[2]) - max(one[0], other[0])
    height = min(one[3], other[3]) - max(one[1], other[1])
    return max(width, 0.0) * max(height, 0.0)


def _outside(one: tuple[float, ...], frame: Any) -> float:
    """Return how far a rectangle extends beyond the frame, summed over its sides, in pixels."""
    return float(
        max(frame.x0 - one[0], 0.0)
        + max(frame.y0 - one[1], 0.0)
        + max(one[2] - frame.x1, 0.0)
        + max(one[3] - frame.y1, 0.0)
    )
