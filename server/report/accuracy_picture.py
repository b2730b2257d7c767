"""Charts of the accuracy report: time against error, every setting a labelled point, the Pareto front marked."""

import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .accuracy_arithmetic import PRIMITIVE, VOLUME
from .accuracy_labels import place_labels
from .accuracy_row import (
    BUDGET,
    ENGINE,
    ERRORS,
    NODES,
    RADIUS,
    SHOWN,
    STEP,
    TOLERANCE,
    Row,
    error_of,
    knobs,
    unbeaten,
)
from .spheres import load_pyplot

INK, FRONT = "#2f2a26", "#1b7f3b"
COLOURS = {
    TOLERANCE: "#c8553d", BUDGET: "#7a5195", RADIUS: "#1f7a8c", STEP: "#b8860b", NODES: "#444444",
}  # fmt: skip
MARKERS = {TOLERANCE: "o", BUDGET: "s", RADIUS: "D", STEP: "^", NODES: "P"}
# Errors that may be exactly 0, and below what they are drawn as next to none.
LEAST = {"wrong": 1e-3, "distance": 1e-2}
# Flat colours need no more; a third of the bytes.
PALETTE = 96


TITLES = {
    "doorway": "A door: how much wider than the figure it must be",
    "leak": "A wall: how far a ball of 5 cm gets into it",
    "wrong": "Verdicts that are not the exact ones",
    "distance": "Distances that are not the exact ones",
}
# Labels of a panel: where their points are, what they say, their colours.
Wanted = tuple[list[tuple[float, float]], list[str], list[str]]


class Point(NamedTuple):
    """A row in a chart: time [us], error, what stands beside it."""

    row: Row
    time: float
    error: float
    label: str


def draw_charts(rows: Sequence[Row], ground: str, out: Path) -> dict[str, Path]:
    """Write all charts into `out`; returns name -> file: "main", "verdicts", "volumes", and one a knob."""
    pyplot = load_pyplot()
    pyplot.rcParams.update(
        {"font.size": 10, "text.color": INK, "axes.edgecolor": "#8a8178", "axes.labelcolor": INK}
    )
    charts = {}
    errors: tuple[str, ...] = ("wrong", "distance")
    if points_of(rows, "doorway") and points_of(rows, "leak"):
        charts["verdicts"] = draw_scatter(rows, errors, ground, out / "accuracy_verdicts.png")
        errors = ("doorway", "leak")
    charts["main"] = draw_scatter(rows, errors, ground, out / "accuracy.png")
    charts["volumes"] = draw_volumes(rows, out / "accuracy_volumes.png")
    for knob in knobs(rows):
        name = "".join(letter if letter.isalnum() else "_" for letter in knob)
        own = [row for row in rows if row.knob == knob]
        charts[knob] = draw_knob(knob, own, out / f"accuracy_{name}.png")
    return charts


def points_of(rows: Sequence[Row], error: str) -> list[Point]:
    """What a chart of time against an error shows: the engine's settings, the default once and first.

    Of radius models those without a factor: a factor trades one felt error for the other, which is a panel of its own.
    """
    found: list[Point] = []
    for row in sorted(rows, key=lambda r: not r.default):
        size = error_of(row, error)
        if row.by != ENGINE or row.knob not in SHOWN or row.mean_us is None or size is None:
            continue
        if row.default and any(point.row.default for point in found):
            continue
        if row.knob == RADIUS and not row.default and is_scaled(row):
            continue
        shown = float(getattr(row, ERRORS[error][1])) if error == "leak" else size
        found.append(Point(row, row.mean_us, shown, "default" if row.default else label_of(row)))
    return found


def is_scaled(row: Row) -> bool:
    """Whether a radius model is another one's with a factor, or a figure that is not about the mean."""
    return ":" in row.setting and not (row.setting.startswith("fixed") and row.value == 1.0)


def label_of(row: Row) -> str:
    """A setting's name beside its point."""
    if row.knob == NODES:
        return "spheres without slab"
    if row.knob in (STEP, TOLERANCE):
        return f"{row.knob.removesuffix(' step')} {row.setting}"
    return row.setting


def draw_scatter(rows: Sequence[Row], errors: tuple[str, ...], ground: str, target: Path) -> Path:
    """Time against two errors; of the felt ones, below, one against the other, and what bounds a node."""
    pyplot = load_pyplot()
    felt = "leak" in errors
    figure, panels = pyplot.subplots(
        1 + felt, 2, figsize=(11.2, 9.6 if felt else 5.6), squeeze=False, layout="constrained"
    )
    wanted: list[tuple[Any, Wanted]] = []
    for panel, error in zip(panels[0], errors, strict=True):
        wanted.append((panel, _scatter(panel, points_of(rows, error), error)))
    if felt:
        wanted.append((panels[1][0], _trade(panels[1][0], [r for r in rows if r.knob == RADIUS])))
        _bars(panels[1][1], rows, VOLUME)
        panels[1][1].legend(frameon=False, fontsize=9, loc="lower right")
    shown = {p.row.knob for error in errors for p in points_of(rows, error) if not p.row.default}
    handles = [
        pyplot.Line2D([], [], color="black", marker="*", linestyle="", markersize=13, label="default: exact, mean"),
        *(
            pyplot.Line2D([], [], color=COLOURS[knob], marker=MARKERS[knob], linestyle="", label=knob)
            for knob in SHOWN
            if knob in shown
        ),
        pyplot.Line2D(
            [], [], color=FRONT, lw=2.5, alpha=0.6, marker="o", markersize=11, markerfacecolor="none",
            label="Pareto front: nothing is both faster and better",
        ),
    ]  # fmt: skip
    figure.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False)
    figure.suptitle(f"What a collision test costs, and what it gets wrong: {ground}", fontsize=13)
    # Labels last: what was laid out before moves the panels.
    figure.canvas.draw()
    for panel, labels in wanted:
        place_labels(panel, *labels)
    _save(figure, target)
    pyplot.close(figure)
    return target


def _scatter(panel: Any, points: list[Point], error: str) -> Wanted:
    """One panel: points and front; returns the labels it wants."""
    stuck = [p.label for p in points if not math.isfinite(p.error)]
    points = [p for p in points if math.isfinite(p.error)]
    sizes = [p.error for p in points]
    panel.set_xscale("log")
    times = [p.time for p in points]
    panel.set_xlim(min(times) / 1.5, max(times) * 2.2)
    if error in LEAST:
        least = LEAST[error]
        panel.set_yscale("symlog", linthresh=least, linscale=0.4)
        panel.set_ylim(-0.4 * least, max([*sizes, least]) * 3)
    elif error == "doorway":
        panel.set_yscale("log")
        panel.set_ylim(min(sizes) / 1.6, max(sizes) * 1.5)
    else:
        low, high = min(*sizes, 0.0), max(*sizes, 0.0)
        room = 0.12 * (high - low + 1.0)
        panel.set_ylim(low - room, high + room)
        panel.axhspan(panel.get_ylim()[0], 0.0, color=FRONT, alpha=0.06, lw=0)
        panel.text(
            0.985,
            0.015,
            "stopped before the wall: no leak",
            transform=panel.transAxes,
            ha="right",
            fontsize=8.5,
        )
    _plain_ticks(panel)
    panel.set_xlabel("time of a pose [µs]   ← faster")
    panel.set_ylabel(f"{ERRORS[error][0]}   ← better", labelpad=2)
    panel.grid(alpha=0.25)
    for point in points:
        _mark(panel, point.time, point.error, point.row)
    best = unbeaten([(p.time, error_of(p.row, error) or 0.0) for p in points])
    _front(panel, [(p.time, p.error) for p, free in zip(points, best, strict=True) if free])
    panel.set_title(TITLES[error], fontsize=10.5, loc="left")
    if stuck:
        said = f"not drawn, the figure cannot pass at all: {', '.join(stuck)}"
        panel.text(0.015, 0.975, said, transform=panel.transAxes, va="top", fontsize=8.5)
    return _merged([(p.time, p.error) for p in points], [p.label for p in points], [p.row for p in points])


def _mark(panel: Any, x: float, y: float, row: Row) -> None:
    """One point."""
    star = row.default
    panel.plot(
        x, y, marker="*" if star else MARKERS[row.knob], color="black" if star else COLOURS[row.knob],
        markersize=16 if star else 7, linestyle="", zorder=4 if star else 3,
    )  # fmt: skip


def _plain_ticks(panel: Any) -> None:
    """To be read in microseconds and millimetres, not in powers: 1, 2, 5, 10 on a logarithmic axis."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    for axis, scale in ((panel.xaxis, panel.get_xscale()), (panel.yaxis, panel.get_yscale())):
        if scale == "log":
            axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axis.set_minor_formatter(NullFormatter())
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def _front(panel: Any, points: list[tuple[float, float]]) -> None:
    """The front as a staircase: what lies above and to the right of it is beaten."""
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
    """Radius models: the doorway against the leak, each model a line over its factors; returns the labels it wants."""
    lines = {
        "mean": "#2f2a26",
        "local": "#1f7a8c",
        "border": "#c8553d",
        "local+border": "#7a5195",
        "fixed": "#b8860b",
    }
    anchors: list[tuple[float, float]] = []
    labels, colours = [], []
    for name, colour in lines.items():
        own = [r for r in rows if r.setting.split(":")[0] == name and r.leak_p99_mm is not None]
        own = [r for r in own if math.isfinite(r.doorway_mm or 0.0)]
        places = [(abs(r.doorway_mm or 0.0), r.leak_p99_mm or 0.0) for r in own]
        panel.plot(
            *zip(*places, strict=True), color=colour, lw=1.2, marker="D", markersize=5, alpha=0.9, zorder=3
        )
        for row, place in zip(own, places, strict=True):
            if row.default:
                panel.plot(*place, marker="*", color="black", markersize=16, zorder=4)
            anchors.append(place)
            labels.append(f"{row.setting}, default" if row.default else row.setting)
            colours.append(colour)
    best = unbeaten([(1.0, x, max(y, 0.0)) for x, y in anchors])  # their times are in the panels above
    low, high = min(y for _, y in anchors), max(y for _, y in anchors)
    room = 0.12 * (high - low) + 1.0
    panel.set_ylim(low - room, high + room)
    panel.set_xlim(0, max(x for x, _ in anchors) * 1.25)
    _front(panel, [place for place, free in zip(anchors, best, strict=True) if free])
    panel.axhspan(panel.get_ylim()[0], 0.0, color=FRONT, alpha=0.06, lw=0)
    panel.set_xlabel("doorway error [mm]   ← better")
    panel.set_ylabel("leak, 99th percentile [mm]   ← better", labelpad=2)
    panel.set_title("Radius models: a larger sphere shuts the wall, and the door", fontsize=10.5, loc="left")
    panel.grid(alpha=0.25)
    return anchors, labels, colours


def _merged(places: list[tuple[float, float]], labels: list[str], rows: list[Row]) -> Wanted:
    """Places, labels and colours, those that nearly coincide under one label."""
    found: list[tuple[tuple[float, float], list[str], Row]] = []
    for place, label, row in zip(places, labels, rows, strict=True):
        for other, names, _ in found:
            # Of the same error and nearly the same time, or of nearly both.
            apart = abs(math.log(place[0] / other[0]))
            off = abs(place[1] - other[1]) / (abs(other[1]) + 1e-3)
            if (apart < 0.25 and off < 1e-6) or (apart < 0.06 and off < 0.02):
                names.append(label)
                break
        else:
            found.append((place, [label], row))
    colours = ["black" if row.default else COLOURS[row.knob] for _, _, row in found]
    return [place for place, _, _ in found], ["\n".join(_short(names)) for _, names, _ in found], colours


def _short(names: list[str]) -> list[str]:
    """Labels that share one place, those of one knob on one line: "tolerance 1 mm, 2 mm", "lattice 1 mm to 1 cm"."""
    lines: dict[str, list[str]] = {}
    for name in names:
        knob, _, value = (
            name.partition(" ") if name.startswith(("tolerance ", "lattice ")) else (name, "", "")
        )
        lines.setdefault(knob, []).append(value)
    return [
        f"{knob} {values[0]} to {values[-1]}" if len(values) > 2 else f"{knob} {', '.join(values)}".rstrip()
        for knob, values in lines.items()
    ]


def draw_volumes(rows: Sequence[Row], target: Path) -> Path:
    """Bars: time of each bounding volume and of each point primitive, walls along the axes and turned."""
    pyplot = load_pyplot()
    groups = [knob for knob in (VOLUME, PRIMITIVE) if any(row.knob == knob for row in rows)]
    figure, panels = pyplot.subplots(
        1, len(groups), figsize=(6.6 * len(groups), 3.9), squeeze=False, layout="constrained"
    )
    for panel, knob in zip(panels[0], groups, strict=True):
        _bars(panel, rows, knob)
    panels[0][0].legend(frameon=False, fontsize=9, loc="lower right")
    _save(figure, target)
    pyplot.close(figure)
    return target


def _bars(panel: Any, rows: Sequence[Row], knob: str) -> None:
    """The times of a knob of the plain descent, walls along the axes and turned."""
    names = list(dict.fromkeys(row.setting for row in rows if row.knob == knob))
    most = 0.0
    for shift, (suffix, colour, said) in enumerate(
        (("", "#1f7a8c", "walls along the axes"), (", turned", "#e0a100", "the same scene, turned"))
    ):
        own = {row.setting: row for row in rows if row.knob == knob + suffix}
        for i, name in enumerate(names):
            if name not in own:
                continue
            mean, place = own[name].mean_us or 0.0, i - 0.2 + 0.4 * shift
            panel.barh(place, mean, height=0.38, color=colour, label=said if i == 0 else None)
            panel.text(mean * 1.01, place, f" {_bar_text(own[name])}", va="center", fontsize=9)
            most = max(most, mean)
    panel.set_yticks(range(len(names)), [name.replace(", ", ",\n") for name in names])
    panel.invert_yaxis()
    panel.set_xlim(0, 1.45 * most)
    panel.set_xlabel("time of a pose, one plain scalar descent [µs]   ← faster")
    title = "What bounds a node: no answer changes" if knob == VOLUME else "What stands for a point"
    panel.set_title(title, fontsize=10.5, loc="left")
    for side in ("top", "right"):
        panel.spines[side].set_visible(False)


def _bar_text(row: Row) -> str:
    """What stands at a bar's end."""
    wrong = row.early + row.late
    return f"{row.mean_us or 0.0:.1f}" + (f", {wrong} of {row.poses:,} wrong" if wrong else "")


def draw_knob(knob: str, rows: Sequence[Row], target: Path) -> Path:
    """One knob: each setting's time, from the middle pose to one in a hundred, and beside it what it gets wrong."""
    pyplot = load_pyplot()
    figure, (times, wrong) = pyplot.subplots(
        1, 2, figsize=(9.0, 1.3 + 0.34 * len(rows)), sharey=True, layout="constrained", width_ratios=[1.3, 1]
    )
    for i, row in enumerate(rows):
        colour = "black" if row.default else "#1f7a8c"
        times.plot(
            [row.p50_us or 0.0, row.p99_us or 0.0],
            [i, i],
            color=colour,
            lw=5,
            alpha=0.35,
            solid_capstyle="butt",
        )
        times.plot(
            [row.mean_us or 0.0],
            [i],
            marker="*" if row.default else "o",
            color=colour,
            ms=11 if row.default else 7,
        )
    times.set_yticks(range(len(rows)), [row.setting for row in rows])
    times.invert_yaxis()
    most = max((row.p99_us or 0.0) for row in rows)
    times.set_xlim(0, most * 1.08)
    times.set_xlabel("time of a pose [µs]: p50 to p99, mean as a point")
    left = np.zeros(len(rows))
    for name, colour in (("early", "#d62839"), ("late", "#5b1a8b"), ("unknown", "#b9b2a8")):
        share = np.array([getattr(row, name) / max(row.poses, 1) * 100 for row in rows])
        wrong.barh(range(len(rows)), share, left=left, color=colour, height=0.6, label=name)
        left += share
    wrong.set_xlim(0, max(1.0, float(left.max()) * 1.15))
    than = "mean's" if knob == RADIUS else "the judge's"
    wrong.set_xlabel(f"verdicts that are not {than} [% of poses]")
    # Above, where no bar is.
    wrong.legend(frameon=False, fontsize=8, loc="lower right", bbox_to_anchor=(1.0, 0.99), ncols=3)
    for panel in (times, wrong):
        panel.grid(alpha=0.25, axis="x")
    _save(figure, target)
    pyplot.close(figure)
    return target


def _save(figure: Any, target: Path) -> None:
    """As a PNG of few colours."""
    from PIL import Image

    drawn = io.BytesIO()
    figure.savefig(drawn, dpi=100)
    with Image.open(drawn) as image:
        image.convert("RGB").quantize(PALETTE, dither=Image.Dither.NONE).save(target, optimize=True)
