"""Charts of the accuracy report, one for each of its questions."""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...common.line_charts import label_ends, plain_ticks
from ...common.sphere_pictures import load_pyplot
from ..measurement.accuracy_results import MemoryRow, RadiusRow, Report
from ..measurement.pose_classes import CLASSES

# A chart is 1280 pixels wide. Shown at 400 its texts are 9 pixels high.
WIDTH, DPI, FONT = 6.4, 200, 10.5
INK, FAINT = "#2f2a26", "#8a8178"
# Classes of poses, from touching to far. They differ in lightness, so that lines also differ in a
# grey print.
KIND_COLOURS = ("#2f2a26", "#a8371e", "#1e7586", "#d2990d", "#9a9a9a")
KIND_MARKS = "osD^v"
MODEL_COLOURS = {
    "mean": "#2f2a26", "local": "#1e7586", "border": "#ce6954", "local+border": "#5b3c6f", "fixed": "#d2990d",
}  # fmt: skip
# Colours of the pictures' palette: halves the file size without losing a colour.
PALETTE = 128
# Ends of lines: x, y, name, colour.
Ends = list[tuple[float, float, str, str]]
# Place of the exact answer on an axis of tolerances, relative to the least of these.
EXACT_AT = 0.35


def draw_charts(report: Report, out: Path) -> dict[str, Path]:
    """Write all charts that the report has results for into `out`; return name -> file."""
    load_pyplot().rcParams.update(
        {"font.size": FONT, "text.color": INK, "axes.edgecolor": FAINT, "axes.labelcolor": INK}
    )
    charts = {
        "main": draw_main(report, out / "accuracy.png"),
        "memory": draw_memory(report, out / "accuracy_memory.png"),
        "distance": draw_distance(report, out / "accuracy_distance.png"),
        "cold": draw_cold(report, out / "accuracy_cold.png"),
        "walks": draw_walks(report, out / "accuracy_walks.png"),
        "frames": draw_frames(report, out / "accuracy_frames.png"),
    }
    if report.radii:
        charts["radii"] = draw_radii(report.radii, out / "accuracy_radii.png")
    return charts


def length_name(metres: float) -> str:
    """Format a length as a label: exact, 2 mm, 5 cm."""
    if not metres:
        return "exact"
    if metres < 1e-3:
        return f"{metres * 1e6:g} µm"
    return f"{metres * 100:g} cm" if metres >= 0.01 else f"{metres * 1e3:g} mm"


def draw_main(report: Report, target: Path) -> Path:
    """Draw what an error allowed saves: time in memory by class of pose, and wait with nothing in memory."""
    figure, (memory, cold) = load_pyplot().subplots(
        2, 1, figsize=(WIDTH, 7.2), dpi=DPI, layout="constrained", height_ratios=[1.25, 1]
    )
    near = _draw_classes(memory, [row for row in report.memory if row.question == "collide"], ratios=True)
    memory.set_ylim(0, None)
    _title(memory, "Scene in memory: time of a pose, % of exact")
    return _save(figure, target, (memory, near), (cold, _draw_cold(cold, report)))


def draw_memory(report: Report, target: Path) -> Path:
    """Draw the time of `collide` by class, and that of a distance field beside it."""
    figure, panel = load_pyplot().subplots(figsize=(WIDTH, 4.6), dpi=DPI, layout="constrained")
    rows = [row for row in report.memory if row.question == "collide"]
    panel.set_yscale("log")
    shown = {row.kind for row in rows}
    for field in (each for each in report.fields if each.kind in shown):
        at = list(CLASSES).index(field.kind)
        # A field's error is at most a diagonal of its cells.
        panel.plot(
            [field.cell * 3**0.5], [field.time_us], "P", color=KIND_COLOURS[at], ms=8, markeredgecolor="white"
        )
    if report.fields:
        panel.plot([], [], "P", color=FAINT, ms=8, label="distance field, grids of " + field_names(report))
        panel.legend(frameon=False, loc="upper left", fontsize=FONT - 1, bbox_to_anchor=(0.0, 1.0))
    ends = _draw_classes(panel, rows, ratios=False)
    top = max([row.time_us for row in rows] + [field.time_us for field in report.fields])
    panel.set_ylim(None, top * 2.5)
    plain_ticks(panel.yaxis)
    _title(panel, "collide: time of a pose [µs]")
    return _save(figure, target, (panel, ends))


def field_names(report: Report) -> str:
    """Return the cells of the distance fields: 2, 5, 10 cm."""
    cells = sorted({row.cell for row in report.fields})
    return ", ".join(f"{cell * 100:g}" for cell in cells) + " cm"


def draw_distance(report: Report, target: Path) -> Path:
    """Draw the time of `distance` by class."""
    figure, panel = load_pyplot().subplots(figsize=(WIDTH, 4.0), dpi=DPI, layout="constrained")
    ends = _draw_classes(panel, [row for row in report.memory if row.question == "distance"], ratios=False)
    panel.set_ylim(0, None)
    _title(panel, "distance: time of a pose [µs]")
    return _save(figure, target, (panel, ends))


def draw_cold(report: Report, target: Path) -> Path:
    """Draw wait and bytes with nothing in memory, relative to exact."""
    figure, panel = load_pyplot().subplots(figsize=(WIDTH, 3.6), dpi=DPI, layout="constrained")
    return _save(figure, target, (panel, _draw_cold(panel, report)))


def draw_walks(report: Report, target: Path) -> Path:
    """Draw stalls and early stops of a walk with little memory, exact and by bounds."""
    rows = [row for row in report.walks if not row.note]
    names = [f"{row.kind}, {row.memory:g} of it" for row in rows]
    figure, panels = load_pyplot().subplots(
        1, 3, figsize=(WIDTH, 1.4 + 0.36 * len(rows)), dpi=DPI, sharey=True, layout="constrained"
    )
    columns = (
        ("frames over\n33 ms, %", [100 * row.stalls / row.frames for row in rows]),
        ("clear poses not\nsaid clear, %", [100 * row.early for row in rows]),
        ("read, MB", [(row.read_bytes or 0) / 1e6 for row in rows]),
    )
    for panel, (title, values) in zip(panels, columns, strict=True):
        colours = ["#1e7586" if row.kind == "bounds" else "#ce6954" for row in rows]
        bars = panel.barh(range(len(rows)), values, color=colours, height=0.62)
        panel.bar_label(bars, fmt=lambda value: f"{value:.3g}", padding=3, fontsize=FONT)
        panel.set_xlim(0, max([*values, 1e-9]) * 1.45)
        _title(panel, title)
        panel.set_xticks([])
        panel.spines[["top", "right", "bottom"]].set_visible(False)
    panels[0].set_yticks(range(len(rows)), names)
    panels[0].invert_yaxis()
    return _save(figure, target)


def draw_frames(report: Report, target: Path) -> Path:
    """Draw the time of a frame against the tolerance of `sweep`, relative to the first tolerance."""
    figure, panel = load_pyplot().subplots(figsize=(WIDTH, 3.4), dpi=DPI, layout="constrained")
    rows = report.frames
    at = [row.tolerance for row in rows]
    p99 = [100 * row.p99_us / rows[0].p99_us for row in rows]
    lines = (("mean", [100 * row.ratio for row in rows], INK, "o"), ("p99", p99, "#1e7586", "s"))
    panel.set_xscale("log")
    for _, values, colour, mark in lines:
        panel.plot(at, values, mark + "-", color=colour)
    low, high = ([100 * getattr(row, name) for row in rows] for name in ("low", "high"))
    panel.fill_between(at, low, high, color=INK, alpha=0.15, lw=0)
    for row in rows:
        if not row.repeats:
            panel.plot([row.tolerance], [100 * row.ratio], "o", color=INK, markerfacecolor="white")
    panel.set(ylim=(0, None), xlabel="tolerance of sweep")
    _title(panel, f"Time of a frame of a walk, % of that at {length_name(at[0])}")
    panel.set_xticks(at, [length_name(each) for each in at], minor=False)
    panel.minorticks_off()
    _frame(panel)
    ends = [(at[-1], values[-1], name, colour) for name, values, colour, _ in lines]
    return _save(figure, target, (panel, ends))


def draw_radii(rows: Sequence[RadiusRow], target: Path) -> Path:
    """Draw the doorway error against the leak of each radius model, a line over its factors."""
    figure, panel = load_pyplot().subplots(figsize=(WIDTH, 4.4), dpi=DPI, layout="constrained")
    own = [row for row in rows if row.scene == "façade" and row.doorway_mm is not None]
    own = [row for row in own if np.isfinite(row.doorway_mm or 0.0)]
    ends = []
    for model, colour in MODEL_COLOURS.items():
        points = sorted(
            (row.doorway_mm or 0.0, row.leak_p99_mm, row.factor) for row in own if row.model == model
        )
        if not points:
            continue
        x, y, _ = zip(*points, strict=True)
        style = "o--" if model == "fixed" else "o-"
        panel.plot(x, y, style, color=colour, lw=1.5, ms=5)
        ends.append((x[0], y[0], model, colour))
        if model == "mean":
            for px, py, factor in points:
                panel.annotate(
                    f"{factor:g} r",
                    (px, py),
                    xytext=(6, 6),
                    textcoords="offset points",
                    color=colour,
                    fontsize=FONT,
                )
    panel.axhline(0.0, color=FAINT, lw=0.8)
    panel.set_xlabel("door: extra width that the figure needs [mm]")
    _title(panel, "Wall: depth that a ball of 5 cm radius enters, p99 [mm]")
    handles = [
        load_pyplot().Line2D([], [], color=colour, marker="o", label=name) for _, _, name, colour in ends
    ]
    panel.legend(handles=handles, frameon=False)
    _frame(panel)
    return _save(figure, target)


def _draw_classes(panel: Any, rows: Sequence[MemoryRow], *, ratios: bool) -> Ends:
    """Draw time [µs], or the ratio to exact [%], against the error allowed, a line for each class of poses.

    Returns the ends of the lines, to be labelled.
    """
    ends = []
    tolerances = sorted({row.tolerance for row in rows})
    places = {tolerance: tolerance or tolerances[1] * EXACT_AT for tolerance in tolerances}
    panel.set_xscale("log")
    for number, kind in enumerate(CLASSES):
        own = [row for row in rows if row.kind == kind]
        if not own:
            continue
        x = [places[row.tolerance] for row in own]
        y = [100 * row.ratio if ratios else row.time_us for row in own]
        colour, mark = KIND_COLOURS[number], KIND_MARKS[number]
        panel.plot(x, y, mark + "-", color=colour, ms=5, lw=1.6)
        if ratios:
            panel.fill_between(
                x,
                [100 * row.low for row in own],
                [100 * row.high for row in own],
                color=colour,
                alpha=0.15,
                lw=0,
            )
        open_ = [(px, py) for px, py, row in zip(x, y, own, strict=True) if not row.repeats]
        if open_:
            panel.plot(*zip(*open_, strict=True), mark, color=colour, markerfacecolor="white", ms=5)
        ends.append((x[-1], y[-1], f"{kind}\n({100 * own[0].share:.0f} % of poses)", colour))
    panel.set_xticks(list(places.values()), [length_name(tolerance) for tolerance in tolerances])
    panel.minorticks_off()
    panel.set_xlabel("error allowed")
    _frame(panel)
    return ends


def _draw_cold(panel: Any, report: Report) -> Ends:
    """Draw wait and bytes relative to exact [%] by the error allowed; return the ends of the lines."""
    rows = report.cold
    names = ["exact,\nno level" if row.tolerance is None else length_name(row.tolerance) for row in rows]
    x = np.arange(len(rows))
    ends = []
    panel.set_yscale("log")
    series = [("wait", INK, "o", [(row.wait, row.wait_low, row.wait_high) for row in rows])]
    if rows[0].read_bytes is not None:
        sizes = [(row.bytes_ratio or 0.0, row.bytes_low or 0.0, row.bytes_high or 0.0) for row in rows]
        series.append(("bytes read", "#1e7586", "s", sizes))
    for name, colour, mark, values in series:
        mean, low, high = 100 * np.array(values).T
        panel.plot(x, mean, mark + "-", color=colour, ms=5, lw=1.6)
        panel.fill_between(x, low, high, color=colour, alpha=0.15, lw=0)
        ends.append((float(x[-1]), float(mean[-1]), name, colour))
    panel.set_xticks(x, names)
    panel.set_xlabel("error allowed")
    _title(panel, "Nothing in memory: wait and bytes of a pose, % of exact")
    _frame(panel)
    plain_ticks(panel.yaxis)
    return ends


def _title(panel: Any, title: str) -> None:
    """Write the title of a panel above its left edge."""
    panel.set_title(title, fontsize=FONT + 0.5, loc="left")


def _frame(panel: Any) -> None:
    """Leave the lines of two axes only, with a faint grid."""
    panel.spines[["top", "right"]].set_visible(False)
    panel.grid(alpha=0.25)


def _save(figure: Any, target: Path, *labelled: tuple[Any, Ends]) -> Path:
    """Save a figure as a PNG with PALETTE colours, and close it.

    labelled: panels and the ends of their lines. Labels come last: the layout moves the panels.
    """
    from PIL import Image

    figure.canvas.draw()
    for panel, ends in labelled:
        label_ends(panel, ends, FONT)
    drawn = io.BytesIO()
    figure.savefig(drawn)
    with Image.open(drawn) as image:
        image.convert("RGB").quantize(PALETTE, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(
            target, optimize=True
        )
    load_pyplot().close(figure)
    return target
