"""Draw cases as a picture of panels: scan points, paths by what was touched, bodies at equal times."""

import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray
from PIL import Image
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.report.walk.walk_picture import COLOURS, INK, PAPER

from .drawn_case import AXES, Case, Measure, Row
from .made_shapes import RADIUS, body_profile, box, circle
from .simulated_walks import CLEAR, FALL, OTHER, SCAN, Walk

Floats = NDArray[np.float64]

# Colour, line and name of what a frame touched. The colours of the walk in README, which differ in
# lightness.
TOUCHED: dict[int, tuple[str, Any, str]] = {
    CLEAR: (COLOURS[Verdict.CLEAR], "-", "touches nothing"),
    SCAN: (COLOURS[Verdict.CONTACT], "-", "touches the scan"),
    OTHER: (COLOURS[Verdict.UNKNOWN], "-", "touches a user or an object"),
    FALL: (INK, (0, (0.8, 0.8)), "falls"),
}
DOT, BODY, FRAME_COLOUR = "#5b4d40", "#8a8178", "#d9cfc1"
# Size of a panel without its texts, and the room for texts and margins [inches].
WIDE, HIGH = 2.86, 2.4
ABOVE, BELOW, BETWEEN, MARGIN, LEGEND = 0.46, 0.06, 0.12, 0.08, 0.3
COLUMNS, DPI, PALETTE = 3, 200, 256
TITLE, TEXT, SMALL = 11.0, 8.6, 8.2


def draw(cases: Sequence[Case], path: Path) -> None:
    """Draw the cases in panels, three a row, as a PNG with a palette."""
    lines = -(-len(cases) // COLUMNS)
    width = COLUMNS * WIDE + (COLUMNS - 1) * BETWEEN + 2 * MARGIN
    height = lines * (ABOVE + HIGH + BELOW) + LEGEND
    figure = Figure(figsize=(width, height), facecolor=PAPER)
    for number, case in enumerate(cases):
        left = MARGIN + number % COLUMNS * (WIDE + BETWEEN)
        top = height - LEGEND - number // COLUMNS * (ABOVE + HIGH + BELOW)
        _draw_case(figure, case, (left, top, width, height))
    shown = {
        what for case in cases for row in case.rows for walk in row.walks for what in walk.touched.tolist()
    }
    figure.legend(
        handles=_handles(shown), loc="center", bbox_to_anchor=(0.5, 1 - 0.55 * LEGEND / height),
        ncols=len(shown) + 2, frameon=False, fontsize=SMALL, handlelength=1.7, columnspacing=1.3,
        labelcolor=INK,
    )  # fmt: skip
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=DPI, format="png")
    # Without k-means, the few pixels of a crowd's paths lose their colour to the many greys.
    image = (
        Image.open(buffer)
        .convert("RGB")
        .quantize(PALETTE, Image.Quantize.MEDIANCUT, kmeans=2, dither=Image.Dither.NONE)
    )
    image.save(path, optimize=True)


def _draw_case(figure: Figure, case: Case, at: tuple[float, float, float, float]) -> None:
    """Draw one panel. at: its left and top, and the figure's width and height [inches]."""
    left, top, width, height = at
    figure.text(
        left / width, (top - 0.06) / height, case.title, fontsize=TITLE, weight="bold", color=INK, va="top"
    )
    figure.text(left / width, (top - 0.26) / height, case.text, fontsize=TEXT, color=INK, va="top")
    count = len(case.rows)
    wide = (WIDE - (count - 1) * BELOW) / count if case.beside else WIDE
    high = HIGH if case.beside else (HIGH - (count - 1) * BELOW) / count
    for number, row in enumerate(case.rows):
        x = left + number * (wide + BELOW) * case.beside
        y = top - ABOVE - high - number * (high + BELOW) * (not case.beside)
        _draw_row(figure.add_axes((x / width, y / height, wide / width, high / height)), row, wide / high)


def _draw_row(axes: Any, row: Row, ratio: float) -> None:
    """Draw one scene. ratio: of the axes' width to their height."""
    low, high = np.array(row.low), np.array(row.high)
    middle, size = (low + high) / 2, high - low
    size = np.maximum(size, [size[1] * ratio, size[0] / ratio])
    axes.set(
        xlim=(middle[0] - size[0] / 2, middle[0] + size[0] / 2),
        ylim=(middle[1] - size[1] / 2, middle[1] + size[1] / 2),
        autoscale_on=False, xticks=[], yticks=[], facecolor="white",
    )  # fmt: skip
    for side in axes.spines.values():
        side.set(color=FRAME_COLOUR, linewidth=0.8)
    axes.scatter(*row.dots.T, s=1.1, color=DOT, linewidths=0, zorder=2)
    for walk in row.walks:
        _draw_bodies(axes, row, walk)
        _draw_path(axes, row, walk)
    for measure in row.measures:
        _draw_measure(axes, measure)
    if row.label:
        axes.text(
            0.02, 0.05 if row.label_low else 0.96, row.label, transform=axes.transAxes, fontsize=TEXT,
            color=INK, va="bottom" if row.label_low else "top", zorder=7,
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.5},
        )  # fmt: skip
    _draw_scale(axes, size, left=row.scale_left)


def _draw_bodies(axes: Any, row: Row, walk: Walk) -> None:
    """Draw the outlines of the body, and of the crate, at equal times; the last ones darker."""
    last = len(walk.touched)
    frames = list(row.moments or range(0, last - row.every // 2, row.every))
    outlines = [outline(row, walk.places[frame]) for frame in frames]
    style: dict[str, Any] = {"edgecolor": BODY, "linewidth": 0.7}
    axes.add_collection(PolyCollection(outlines, facecolor=(0.54, 0.51, 0.47, 0.10), zorder=3, **style))
    end = [outline(row, walk.places[frames[-1] if row.moments else last])]
    style = {"edgecolor": INK, "linewidth": 0.9}
    axes.add_collection(PolyCollection(end, facecolor=(0.54, 0.51, 0.47, 0.26), zorder=3, **style))
    if row.crate:
        shown, _ = AXES[row.view]
        half = row.crate / 2
        moved = [frame for frame in frames if (walk.objects[frame] != walk.objects[last]).any()]
        places = walk.objects[[*moved, last], 0][:, shown]
        crates = [box((x - half, y - half), (x + half, y + half)) for x, y in places.tolist()]
        colours = [BODY] * len(moved) + [INK]
        tint = (0.945, 0.72, 0.2, 0.14)
        axes.add_collection(
            PolyCollection(crates, facecolor=tint, edgecolor=colours, linewidth=0.8, zorder=3)
        )


def outline(row: Row, place: Floats) -> Floats:
    """Return the outline (k, 2) of the body at a place (3,), in a view."""
    shown, _ = AXES[row.view]
    if row.view == "plan":
        return circle((0.0, 0.0), RADIUS) + place[shown]
    half = body_profile()
    return np.concatenate([half, half[::-1] * [-1.0, 1.0]]) + place[shown]


def _draw_path(axes: Any, row: Row, walk: Walk) -> None:
    """Draw the way of the middle of the body's base, frame by frame, by what was touched."""
    shown, _ = AXES[row.view]
    places = walk.places[:, shown]
    for what, (colour, line, _) in TOUCHED.items():
        parts = [places[begin : end + 1] for begin, end in _runs(walk.touched == what)]
        if parts:
            axes.add_collection(
                LineCollection(
                    parts, colors=colour, linestyles=[line], linewidths=2.0, zorder=4, capstyle="butt"
                )
            )
    axes.plot(*places[0], marker="o", ms=4.2, color=INK, mec="white", mew=0.8, zorder=5)


def _runs(flags: NDArray[np.bool_]) -> Iterable[tuple[int, int]]:
    """Return the first frame of each run of True, and the one after its last."""
    steps = np.diff(np.concatenate([[0], flags.astype(np.int8), [0]]))
    return zip(np.flatnonzero(steps == 1).tolist(), np.flatnonzero(steps == -1).tolist(), strict=True)


def _draw_measure(axes: Any, measure: Measure) -> None:
    """Draw a length with its value beside it."""
    begin, end = np.array(measure.begin), np.array(measure.end)
    mark = "_" if begin[0] == end[0] else "|"
    axes.plot(*np.array([begin, end]).T, color=INK, lw=1.0, zorder=6, marker=mark, ms=5, mew=0.9)
    axes.text(*measure.at, measure.text, fontsize=SMALL, color=INK, ha="center", va="center", zorder=7)


def _draw_scale(axes: Any, size: Floats, *, left: bool) -> None:
    """Draw a bar of half a metre in a lower corner. size: (2,) of what is shown [m]."""
    begin, end = axes.get_xlim()
    x = begin + 0.04 * size[0] if left else end - 0.04 * size[0] - 0.5
    y = axes.get_ylim()[0] + 0.06 * size[1]
    axes.plot([x, x + 0.5], [y, y], color=BODY, lw=2.0, solid_capstyle="butt", zorder=6)
    axes.text(
        x + 0.25, y + 0.02 * size[1], "0.5 m", fontsize=7.0, color=BODY, ha="center", va="bottom", zorder=6
    )


def _handles(shown: set[int]) -> list[Any]:
    """Return the legend of what is shown."""
    lines: list[Any] = [
        Line2D([], [], color=colour, linestyle=line, lw=2.2, label=name)
        for what, (colour, line, name) in TOUCHED.items()
        if what in shown
    ]
    dots = Line2D([], [], marker="o", ms=2, ls="", color=DOT, label="scan points")
    bodies = Patch(facecolor=(0.54, 0.51, 0.47, 0.15), edgecolor=BODY, label="avatar, at equal times")
    return [*lines, bodies, dots]
