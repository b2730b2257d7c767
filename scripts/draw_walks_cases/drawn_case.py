"""Content of one panel: simulated walks over scan points, and what its caption claims of them."""

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .made_shapes import SPACING
from .simulated_walks import Walk

Floats = NDArray[np.float64]
View = Literal["plan", "side"]
# Axes of the world that a view shows, and the one that it looks along.
AXES: dict[View, tuple[list[int], int]] = {"plan": ([0, 1], 2), "side": ([0, 2], 1)}
# A plan shows the scan points of a layer at this height [m], a side view those around y = 0.
_LAYER, _DEPTH = 1.0, 1.5 * SPACING


class Measure(NamedTuple):
    """A measured length. begin, end: (2,) of the view [m].  text: its value.  at: (2,) of the text."""

    begin: tuple[float, float]
    end: tuple[float, float]
    text: str
    at: tuple[float, float]


class Row(NamedTuple):
    """One scene in a panel.

    dots: (n, 2), scan points of the view.  low, high: (2,) corners of what is shown [m].
    every: number of frames between two outlines of the body.  moments: frames of the outlines
    instead, the last of them darker.
    label: says which value of the option this is.
    crate: side of the scene's object [m]; 0: none.  scale_left: the scale is at the left.
    label_low: the label is at the bottom.
    """

    view: View
    dots: Floats
    walks: list[Walk]
    low: tuple[float, float]
    high: tuple[float, float]
    every: int = 6
    label: str = ""
    measures: tuple[Measure, ...] = ()
    crate: float = 0.0
    moments: tuple[int, ...] = ()
    scale_left: bool = False
    label_low: bool = False


class Case(NamedTuple):
    """One panel.

    title, text: what it shows.  rows: from top to bottom; beside: from left to right.
    claims: what the caption says of the walks, and whether it is so.
    """

    name: str
    title: str
    text: str
    rows: tuple[Row, ...]
    claims: dict[str, bool]
    beside: bool = False


def section(view: View, points: Floats) -> Floats:
    """Return the scan points (n, 2) that a view shows, of points (n, 3)."""
    shown, across = AXES[view]
    middle = _LAYER if view == "plan" else 0.0
    return points[np.abs(points[:, across] - middle) < _DEPTH][:, shown]
