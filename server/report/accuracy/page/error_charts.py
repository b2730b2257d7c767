"""Charts of the accuracy report: time against error, with labelled settings and Pareto front."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ...common.sphere_pictures import load_pyplot
from ..measurement.setting_results import (
    BUDGET,
    ERRORS,
    NODES,
    RADIUS,
    SHEET,
    SHOWN,
    STEP,
    TOLERANCE,
    Row,
    error_of,
    knobs,
    pareto_front,
)
from .bar_charts import MODEL_COLOURS, draw_knob, draw_sheet, save_picture
from .chart_labels import place_labels

INK, FRONT = "#2f2a26", "#1b7f3b"
COLOURS = {
    TOLERANCE: "#c8553d", BUDGET: "#7a5195", RADIUS: "#1f7a8c", STEP: "#b8860b", NODES: "#444444",
}  # fmt: skip
# Legend texts of knobs, where the knob's name is not clear enough.
NAMES = {
    TOLERANCE: "search that may stop within a tolerance",
    BUDGET: "search with a budget",
    NODES: "bounding volume of a node",
}
# Background of texts that lines may cross.
PAPER = {"facecolor": "white", "edgecolor": "none", "alpha": 0.85, "pad": 1.5}
MARKERS = {TOLERANCE: "o", BUDGET: "s", RADIUS: "D", STEP: "^", NODES: "P"}
# Points of the radius models closer than this in both errors share a label [mm].
SAME = 0.8
# Extent of the leak axis below zero, relative to that above. Points below it are drawn at its end.
BELOW = 0.4
# Errors that may be exactly 0, and the value below which their axis is linear.
LEAST = {"wrong": 1e-3, "distance": 1e-2}


TITLES = {
    "doorway": "Door: extra width that the figure needs",
    "leak": "Wall: depth to which a ball of 5 cm radius enters it",
    "wrong": "Verdicts that differ from the exact ones",
    "distance": "Distances that differ from the exact ones",
}
# Labels of a panel: positions of their points, texts, colours.
Wanted = tuple[list[tuple[float, float]], list[str], list[str]]


class Point(NamedTuple):
    """A row in a chart. time: [us].  label: text beside the point."""

    row: Row
    time: float
    error: float
    label: str


def draw_charts(rows: Sequence[Row], scene_name: str, out: Path) -> dict[str, Path]:
    """Write all charts into `out`.

    Returns name -> file: "main", "verdicts" (with ground truth only), and one per knob.
    """
    pyplot = load_pyplot()
    pyplot.rcParams.update(
        {"font.size": 10, "text.color": INK, "axes.edgecolor": "#8a8178", "axes.labelcolor": INK}
    )
    charts = {}
    errors: tuple[str, ...] = ("wrong", "distance")
    if points_of(rows, "doorway") and points_of(rows, "leak"):
        charts["verdicts"] = draw_scatter(rows, errors, scene_name, out / "accuracy_verdicts.png")
        errors = ("doorway", "leak")
    charts["main"] = draw_scatter(rows, errors, scene_name, out / "accuracy.png")
    for knob in knobs(rows):
        name = "".join(letter if letter.isalnum() else "_" for letter in knob)
        own = [row for row in rows if row.knob == knob]
        target = out / f"accuracy_{name}.png"
        charts[knob] = draw_sheet(own, target) if knob == SHEET else draw_knob(knob, own, target)
    return charts


def points_of(rows: Sequence[Row], error: str) -> list[Point]:
    """Return the points of a chart of time against an error.

    They contain the default once and first.
    Radius models are included without factors: a factor trades one felt error for the other, which
    another panel shows.
    """
    found: list[Point] = []
    for row in sorted(rows, key=lambda r: not r.default):
        size = error_of(row, error)
        if row.knob not in SHOWN or row.mean_us is None or size is None:
            continue
        if row.default and any(point.row.default for point in found):
            continue
        if row.knob == RADIUS and not row.default and is_scaled(row):
            continue
        shown = float(getattr(row, ERRORS[error][1])) if error == "leak" else size
        found.append(Point(row, row.mean_us, shown, "default" if row.default else label_of(row)))
    return found


def is_scaled(row: Row) -> bool:
    """Return whether a radius model has a factor, or is a fixed radius far from the mean."""
    return row.factor not in (None, 1.0)


def label_of(row: Row) -> str:
    """Return the label of a setting."""
    if row.knob == NODES:
        return "spheres with slab" if row.value else "spheres without slab"
    return f"lattice {row.setting}" if row.knob == STEP else row.setting


def draw_scatter(rows: Sequence[Row], errors: tuple[str, ...], scene_name: str, target: Path) -> Path:
    """Draw time against two errors.

    For the errors that users notice, also draw one against the other.
    """
    pyplot = load_pyplot()
    felt = "leak" in errors
    figure = pyplot.figure(figsize=(11.2, 9.6 if felt else 5.6), layout="constrained")
    panels = figure.subplot_mosaic([list(errors), ["radius", "radius"]] if felt else [list(errors)])
    wanted: list[tuple[Any, Wanted]] = []
    for error in errors:
        wanted.append((panels[error], _scatter(panels[error], points_of(rows, error), error)))
    if felt:
        radius_rows = [row for row in rows if row.knob == RADIUS]
        wanted.append((panels["radius"], _trade(panels["radius"], radius_rows)))
    shown = {p.row.knob for error in errors for p in points_of(rows, error) if not p.row.default}
    handles = [
        pyplot.Line2D([], [], color="black", marker="*", linestyle="", markersize=13, label="default: exact, mean"),
        *(
            pyplot.Line2D([], [], color=COLOURS[knob], marker=MARKERS[knob], linestyle="", label=NAMES.get(knob, knob))
            for knob in SHOWN
            if knob in shown
        ),
        pyplot.Line2D(
            [], [], color=FRONT, lw=2.5, alpha=0.6, marker="o", markersize=11, markerfacecolor="none",
            label="Pareto front: no setting is both faster and better",
        ),
    ]  # fmt: skip
    figure.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False)
    figure.suptitle(f"Cost and errors of a collision test: {scene_name}", fontsize=13)
    # Labels last: the layout moves the panels.
    figure.canvas.draw()
    for panel, labels in wanted:
        place_labels(panel, *labels)
    save_picture(figure, target)
    pyplot.close(figure)
    return target


def _scatter(panel: Any, points: list[Point], error: str) -> Wanted:
    """Draw the points and the Pareto front of one panel; return its labels."""
    stuck = [p.label for p in points if not math.isfinite(p.error)]
    points = [p for p in points if math.isfinite(p.error)]
    sizes = [p.error for p in points]
    panel.set_xscale("log")
    times = [p.time for p in points]
    panel.set_xlim(min(times) / 1.5, max(times) * 3.0)
    if error in LEAST:
        least = LEAST[error]
        panel.set_yscale("symlog", linthresh=least, linscale=0.4)
        panel.set_ylim(-0.4 * least, max([*sizes, least]) * 3)
    elif error == "doorway":
        panel.set_yscale("log")
        panel.set_ylim(min(sizes) / 1.6, max(sizes) * 1.5)
    else:
        high = max(*sizes, 1.0)
        points = [_raised(p, -BELOW * high) for p in points]
        low = min(0.0, *(p.error for p in points))
        room = 0.15 * (high - low + 1.0)
        panel.set_ylim(low - room, high + room)
        panel.axhspan(panel.get_ylim()[0], 0.0, color=FRONT, alpha=0.06, lw=0)
        panel.text(
            0.015,
            0.015,
            "stopped before the wall: no leak",
            transform=panel.transAxes,
            ha="left",
            fontsize=8.5,
        )
    _plain_ticks(panel)
    panel.set_xlabel("time per pose [µs]   ← faster")
    panel.set_ylabel(f"{ERRORS[error][0]}   ← better", labelpad=2)
    panel.grid(alpha=0.25)
    for point in points:
        _mark(panel, point.time, point.error, point.row)
    best = pareto_front([(p.time, error_of(p.row, error) or 0.0) for p in points])
    _front(panel, [(p.time, p.error) for p, free in zip(points, best, strict=True) if free])
    panel.set_title(TITLES[error], fontsize=10.5, loc="left")
    if stuck:
        said = f"not drawn, the figure cannot pass: {', '.join(stuck)}"
        panel.text(0.015, 0.975, said, transform=panel.transAxes, va="top", fontsize=8.5, bbox=PAPER)
    return _merged([(p.time, p.error) for p in points], [p.label for p in points], [p.row for p in points])


def _raised(point: Point, floor: float) -> Point:
    """Return the point, moved up to `floor` if it lies below, with its error [mm] in the label."""
    if point.error >= floor:
        return point
    return point._replace(error=floor, label=f"{point.label}: {point.error:.0f} mm")


def _mark(panel: Any, x: float, y: float, row: Row) -> None:
    """Draw one point."""
    star = row.default  # the default is drawn above all others, with a white edge
    panel.plot(
        x, y, marker="*" if star else MARKERS[row.knob], color="black" if star else COLOURS[row.knob],
        markersize=20 if star else 7, markeredgecolor="white", markeredgewidth=1.2 if star else 0.5,
        linestyle="", zorder=7 if star else 3,
    )  # fmt: skip


def _plain_ticks(panel: Any) -> None:
    """Label logarithmic axes with plain numbers (1, 2, 5, 10) instead of powers of ten."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    for axis, scale in ((panel.xaxis, panel.get_xscale()), (panel.yaxis, panel.get_yscale())):
        if scale == "log":
            axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axis.set_minor_formatter(NullFormatter())
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def _front(panel: Any, points: list[tuple[float, float]]) -> None:
    """Draw the Pareto front as a staircase: every point above and to the right of it is beaten."""
    if not points:
        return
    chosen = sorted(points)
    right, top = panel.get_xlim()[1], panel.get_ylim()[1]
    x, y = [chosen[0][0]], [top]
    for (time, error), after in zip(chosen, [*chosen[1:], None], strict=True):
        x += [time, right if after is None else after[0]]
        y += [min(error, y[-1])] * 2
    panel.plot(x, y, color=FRONT, lw=2.5, alpha=0.45, zorder=2, solid_joinstyle="miter")
    panel.scatter(*zip(*chosen, strict=True), s=170, facecolors="none", edgecolors=FRONT, lw=1.8, zorder=5)


def _trade(panel: Any, rows: Sequence[Row]) -> Wanted:
    """Draw the doorway error against the leak, one line per radius model; return the labels."""
    anchors: list[tuple[float, float]] = []
    labels, colours = [], []
    for name, colour in MODEL_COLOURS.items():
        own = [r for r in rows if r.setting.split(":")[0] == name and r.leak_p99_mm is not None]
        own = [r for r in own if math.isfinite(r.doorway_mm or 0.0)]
        places = [(abs(r.doorway_mm or 0.0), r.leak_p99_mm or 0.0) for r in own]
        rim = "border" in name  # hollow: its points almost coincide with those of the model without border
        panel.plot(
            *zip(*places, strict=True), color=colour, lw=1.2, ls="--" if rim else "-", marker="o" if rim else "D",
            markersize=8 if rim else 5, markerfacecolor="none" if rim else colour, zorder=4 if rim else 3,
        )  # fmt: skip
        for row, place in zip(own, places, strict=True):
            if row.default:
                _mark(panel, *place, row)
            anchors.append(place)
            labels.append(f"{row.setting}, default" if row.default else row.setting)
            colours.append(INK)
    best = pareto_front(
        [(1.0, x, max(y, 0.0)) for x, y in anchors]
    )  # times are ignored: other panels show them
    low, high = min(y for _, y in anchors), max(y for _, y in anchors)
    room = 0.12 * (high - low) + 1.0
    panel.set_ylim(low - room, high + room)
    panel.set_xlim(0, max(x for x, _ in anchors) * 1.25)
    _front(panel, [place for place, free in zip(anchors, best, strict=True) if free])
    panel.axhspan(panel.get_ylim()[0], 0.0, color=FRONT, alpha=0.06, lw=0)
    panel.set_xlabel("doorway error [mm]   ← better")
    panel.set_ylabel("leak, 99th percentile [mm]   ← better", labelpad=2)
    panel.set_title("Radius models: larger spheres close the wall, and the door", fontsize=10.5, loc="left")
    panel.grid(alpha=0.25)
    return _beside(anchors, labels, colours)


def _beside(places: list[tuple[float, float]], labels: list[str], colours: list[str]) -> Wanted:
    """Stack the labels of points that almost coincide, in the colour of the first."""
    found: list[tuple[tuple[float, float], list[str], str]] = []
    for place, label, colour in zip(places, labels, colours, strict=True):
        near = (f for f in found if max(abs(f[0][0] - place[0]), abs(f[0][1] - place[1])) < SAME)
        if (other := next(near, None)) is not None:
            other[1].append(label)
        else:
            found.append((place, [label], colour))
    return (
        [place for place, _, _ in found],
        ["\n".join(names) for _, names, _ in found],
        [c for *_, c in found],
    )


def _merged(places: list[tuple[float, float]], labels: list[str], rows: list[Row]) -> Wanted:
    """Return places, labels and colours, with one label for points that almost coincide."""
    found: list[tuple[tuple[float, float], list[str], Row]] = []
    for place, label, row in zip(places, labels, rows, strict=True):
        for other, names, first in found:
            # The same error and almost the same time, or almost the same error and time.
            apart = abs(math.log(place[0] / other[0]))
            off = abs(place[1] - other[1]) / (abs(other[1]) + 1e-3)
            alike = row.knob == first.knob or first.default
            if (alike and apart < 0.25 and off < 1e-6) or (apart < 0.06 and off < 0.02):
                names.append(label)
                break
        else:
            found.append((place, [label], row))
    colours = ["black" if row.default else COLOURS[row.knob] for _, _, row in found]
    return [place for place, _, _ in found], ["\n".join(_short(names)) for _, names, _ in found], colours


def _short(names: list[str]) -> list[str]:
    """Combine labels at one place, one line per knob, such as "tolerance 1 mm, 2 mm"."""
    lines: dict[str, list[str]] = {}
    for name in names:
        knob = next((knob for knob in ("tolerance", "lattice") if name.startswith(f"{knob} ")), name)
        lines.setdefault(knob, []).append(name.removeprefix(knob).strip())
    return [
        f"{knob} {values[0]} to {values[-1]}" if len(values) > 2 else f"{knob} {', '.join(values)}".rstrip()
        for knob, values in lines.items()
    ]
