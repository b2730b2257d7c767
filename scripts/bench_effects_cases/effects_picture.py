"""Picture of the cost of effects: every frame of the walk, stacked by effect, and each effect's mean."""

from pathlib import Path

import numpy as np
from bench_engine_cases.engine_picture import FAINT, INK, VERDICTS, goals_table, write_picture
from solidcloud.server.report.common.bench_results import MISSED, Part, goal_rows
from solidcloud.server.report.common.sphere_pictures import load_pyplot

# By effect, in the order in which they run. Lightness differs between all of them, most between
# neighbours in the stack, so that they also differ in a grey print.
COLOURS = {
    "objects": "#937233", "crowd": "#e8c96c", "stop": "#082d52", "sweep": "#4191d3", "slide": "#cee6f6",
    "step": "#175b34", "ground": "#7bc68e", "proximity": "#52287b", "contacts": "#e28d23", "uncertainty": "#b43628",
}  # fmt: skip
# Frames averaged for a smooth line: a third of a second.
SMOOTH = 10


def draw(
    parts: list[Part],
    notes: dict[str, str],
    company: dict[str, np.ndarray],
    limit: float,
    machine: str,
    target: Path,
) -> None:
    """Write the picture as PNG; without targets, only the stacked frames.

    company: effect -> (k,) seconds of each frame.
    limit: of walking [us].
    """
    pyplot = load_pyplot()
    rows = goal_rows(parts, notes)
    if rows:
        figure = pyplot.figure(figsize=(15, 9), dpi=110, layout="constrained")
        above, below = figure.subfigures(2, 1, height_ratios=[1.15, 1])
        _stack(above.subplots(), company, limit)
        left, right = below.subplots(1, 2, width_ratios=[1, 1.6])
        _means(left, parts)
        goals_table(right, rows, 4.0)
    else:
        figure = pyplot.figure(figsize=(15, 5), dpi=110, layout="constrained")
        _stack(figure.subplots(), company, limit)
    write_picture(figure, f"solidcloud: what effects cost, frame by frame  ({machine})", parts, target)


def _stack(axes, company: dict[str, np.ndarray], limit: float) -> None:  # type: ignore[no-untyped-def]
    """Draw the time of each frame, stacked in the order in which effects run."""
    names = [name for name, values in company.items() if values.max() > 0]
    kernel = np.ones(SMOOTH) / SMOOTH
    values = [1e6 * np.convolve(company[name], kernel, mode="same") for name in names]
    at = np.arange(len(values[0])) / 30.0
    axes.stackplot(
        at, values, labels=names, colors=[COLOURS[name] for name in names], edgecolor="white", linewidth=0.4
    )
    axes.axhline(limit, color=VERDICTS[MISSED], lw=1.2, ls="--")
    axes.set(xlim=(0, at[-1]), xlabel="time on the walk [s]", ylabel="time of a frame [µs]")
    title = f"all effects together, means of {SMOOTH} frames; dashed: target of the mean frame of walking, {limit:g} µs"
    axes.set_title(title, loc="left", fontsize=11, pad=26)
    axes.spines[["top", "right"]].set_visible(False)
    # Between the title and the panel: the stacks reach the top of the panel.
    axes.legend(
        loc="lower left",
        bbox_to_anchor=(0.0, 0.99),
        ncols=len(names),
        frameon=False,
        fontsize=9,
        borderaxespad=0.2,
    )


def _means(axes, parts: list[Part]) -> None:  # type: ignore[no-untyped-def]
    """Draw the added time of each effect alone, and its own time with all others."""
    figures = [f for part in parts for f in part.figures if f.case == "an effect"]
    names = list(dict.fromkeys(f.side for f in figures))
    alone = {f.side: f.value for f in figures if "alone" in f.what}
    company = {f.side: f.value for f in figures if "in company" in f.what}
    at = np.arange(len(names))
    axes.barh(
        at - 0.2, [alone.get(n, 0) for n in names], 0.38, color=[COLOURS[n] for n in names], label="alone",
        edgecolor=FAINT, linewidth=0.4,
    )  # fmt: skip
    axes.barh(at + 0.2, [company.get(n, 0) for n in names], 0.38, color=[COLOURS[n] for n in names], alpha=0.45,
              edgecolor=FAINT, linewidth=0.4, label="in company")  # fmt: skip
    for k, name in enumerate(names):
        axes.text(
            max(0.0, alone.get(name, 0)),
            k - 0.2,
            f" {alone.get(name, 0):.1f}",
            va="center",
            fontsize=8,
            color=INK,
        )
        if name in company:
            axes.text(company[name], k + 0.2, f" {company[name]:.1f}", va="center", fontsize=8, color=FAINT)
    axes.set_yticks(at, names)
    axes.invert_yaxis()
    axes.margins(x=0.15)  # room for the numbers
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_title("mean of a frame [µs]: alone (full), in company (pale)", loc="left", fontsize=11)
