"""Picture of the benchmark: sides on the walk, every set of poses, growth, and the targets as a table."""

import textwrap
from pathlib import Path
from typing import Any

from matplotlib.colors import to_rgb
from matplotlib.ticker import FuncFormatter, NullFormatter
from solidcloud.server.report.common.bench_results import (
    MET,
    MISSED,
    Figure,
    Part,
    busy,
    goal_rows,
    limit_text,
    number,
)
from solidcloud.server.report.common.sphere_pictures import load_pyplot

from .collide_section import CAPT_PART, TABLE_PART
from .compared_sides import BRUTE, CAPT, CAPT16, COLLIDE, OURS, SCIPY, TABLE
from .growth_section import FACADES

# Lightness differs between all sides, so that they also differ in a grey print.
COLOURS = {
    OURS: "#124972",
    TABLE: "#d58726",
    CAPT: "#7b50a4",
    CAPT16: "#dacce8",
    SCIPY: "#7f7f7f",
    BRUTE: "#1f1f1f",
}
LIGHTER = "#85bde3"  # our second archive
MARKERS = {OURS: "o", TABLE: "s", CAPT: "^", CAPT16: "v", SCIPY: "D", BRUTE: "X"}
# For other pictures: lightness differs between all of them, most between neighbours.
SERIES = ("#0f3c5d", "#85bde3", "#634084", "#d98928", "#232323", "#30925c", "#e8d187", "#8b5875")
VERDICTS = {MET: "#2e8b57", MISSED: "#c0392b"}
INK, FAINT = "#222222", "#777777"


def draw(parts: list[Part], notes: dict[str, str], machine: str, target: Path) -> None:
    """Write the picture as PNG, without the panels of sections that did not run."""
    pyplot = load_pyplot()
    figures = [f for part in parts for f in part.figures if f.what == COLLIDE]
    walk = [f for f in figures if f.section == "collide" and f.case.endswith(", walk")]
    sets = [f for f in figures if f.section in ("collide", "hard", "scans") and f.side != BRUTE]
    growth = [f for f in figures if f.section == "growth"]
    rows = goal_rows(parts, notes)
    cases = list(dict.fromkeys(f.case for f in sets))
    left = [(draw_it, size) for draw_it, size, shown in (
        (lambda axes: _bars(axes, walk), 0.9 + 0.38 * len(walk), walk),
        (lambda axes: _sets(axes, sets, cases), 1.2 + 0.34 * len(cases), cases),
        (lambda axes: _growth(axes, growth), 2.6, growth),
    ) if shown]  # fmt: skip
    height = max(sum(size for _, size in left), 1.0 + 0.3 * len(rows), 3.0) + 0.6
    figure = pyplot.figure(figsize=(18 if left else 10, height), dpi=110, layout="constrained")
    columns = figure.subfigures(1, 2, width_ratios=[1, 1.12]) if left else [None, figure]
    if left:
        panels = columns[0].subplots(len(left), 1, height_ratios=[size for _, size in left], squeeze=False)
        for axes, (draw_it, _) in zip(panels[:, 0], left, strict=True):
            draw_it(axes)
    goals_table(columns[1].subplots(), rows, height)
    write_picture(
        figure, f"solidcloud: the engine's goals and its peers, one run  ({machine})", parts, target
    )


def write_picture(figure: Any, title: str, parts: list[Part], target: Path) -> None:
    """Write the figure as PNG and close it; the title says where the machine was busy in a part."""
    warning = busy(parts)
    if warning:
        title += f"\n{warning}: not figures to quote"
    figure.suptitle(title, fontsize=13, color=VERDICTS[MISSED] if warning else INK)
    figure.savefig(target)
    load_pyplot().close(figure)


def text_on(colour: str) -> str:
    """Return the colour of a text that is legible on a colour: white on a dark one, else ink."""
    red, green, blue = to_rgb(colour)
    return "white" if 0.2126 * red + 0.7152 * green + 0.0722 * blue < 0.55 else INK


def _colour(side: str, ours: list[str]) -> str:
    if side.startswith(OURS):
        return COLOURS[OURS] if not ours or side == ours[0] else LIGHTER
    return COLOURS.get(side, FAINT)


def _ours(figures: list[Figure]) -> list[str]:
    return list(dict.fromkeys(f.side for f in figures if f.side.startswith(OURS)))


def _plain(axes: Any, axis: str = "x") -> None:
    """Format a log axis with plain numbers and no frame."""
    chosen = getattr(axes, f"{axis}axis")
    chosen.set_major_formatter(FuncFormatter(lambda v, _: f"{v:,.0f}" if v >= 1 else f"{v:g}"))
    chosen.set_minor_formatter(NullFormatter())
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis=axis, which="major", alpha=0.3)
    axes.set_axisbelow(True)


def _bars(axes: Any, walk: list[Figure]) -> None:
    """Draw microseconds per pose of each side, and the targets."""
    ours = _ours(walk)
    order = sorted(walk, key=lambda f: f.value)
    values = [f.value for f in order]
    axes.barh(range(len(order)), values, color=[_colour(f.side, ours) for f in order], height=0.7)
    axes.set_yticks(range(len(order)), [f.side for f in order])
    axes.set(xscale="log", xlim=(min(values) / 8, max(values) * 8))
    for k, value in enumerate(values):
        axes.text(
            value * 1.06, k, number(value), va="center", fontsize=9, color=INK, zorder=4,
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.0},
        )  # fmt: skip
    by_side = {f.side: f.value for f in walk}
    limits = [(share * by_side[side], f"{share:g} x {name}") for side, share, name in (
        (TABLE, TABLE_PART, "table"), (CAPT, CAPT_PART, "CAPT"),
    ) if side in by_side]  # fmt: skip
    for k, (limit, text) in enumerate(sorted(limits)):
        axes.axvline(limit, color=VERDICTS[MISSED], lw=1.4, ls="--")
        align, nudge = ("right", 0.94) if k == 0 else ("left", 1.06)
        axes.text(
            limit * nudge, -0.55, f"goal {text}: {number(limit)}", color=VERDICTS[MISSED], fontsize=8.5, ha=align,
            va="bottom",
        )  # fmt: skip
    axes.set_ylim(len(order) - 0.4, -1.1)
    axes.set_title("collide on the walk, µs a pose, one core, stateless (log scale)", loc="left", fontsize=11)
    _plain(axes)


def _sets(axes: Any, sets: list[Figure], cases: list[str]) -> None:
    """Draw every set of poses: one dot per side."""
    ours = _ours([f for f in sets if f.section != "scans"])
    for side in dict.fromkeys(f.side for f in sets):
        own = [f for f in sets if f.side == side]
        if side == OURS and ours:  # the real scans, built with the default voxel
            colour, label = LIGHTER if len(ours) > 1 else COLOURS[OURS], None
        else:
            colour, label = _colour(side, ours), side
        axes.scatter(
            [f.value for f in own], [cases.index(f.case) for f in own], s=58, color=colour, label=label,
            marker=MARKERS[OURS] if side.startswith(OURS) else MARKERS.get(side, "P"),
            zorder=4 if side.startswith(OURS) else 3,  # ours on top
            edgecolors="white", linewidths=0.6,
        )  # fmt: skip
    axes.set_yticks(range(len(cases)), cases, fontsize=9)
    axes.set_ylim(len(cases) - 0.5, -0.5)
    axes.set_xscale("log")
    axes.grid(axis="y", alpha=0.15)
    axes.set_title("collide on every set of poses, µs a pose (log scale)", loc="left", fontsize=11)
    axes.legend(
        fontsize=8,
        ncols=3,
        frameon=False,
        loc="upper center",
        bbox_to_anchor=(0.42, -0.4 / (1 + 0.3 * len(cases))),
    )
    _plain(axes)


def _growth(axes: Any, growth: list[Figure]) -> None:
    """Draw the mean over the size of the scene, and 1.3 times the first."""
    sizes = [float(f.case.split()[0].replace(",", "")) for f in growth]
    values = [f.value for f in growth]
    axes.plot(sizes, values, "o-", color=COLOURS[OURS], lw=1.8)
    axes.axhline(values[0] * 1.3, color=VERDICTS[MISSED], ls="--", lw=1.4)
    axes.text(
        sizes[0],
        values[0] * 1.3,
        "goal: at most 1.3 x the first",
        color=VERDICTS[MISSED],
        fontsize=8,
        va="bottom",
    )
    for size, value in zip(sizes, values, strict=True):
        axes.annotate(number(value), (size, value), textcoords="offset points", xytext=(6, -12), fontsize=9)
    last = FACADES[-1] * 1e6
    axes.set(
        xscale="log",
        xlim=(min(sizes) / 1.6, max(max(sizes) * 1.6, last)),
        ylim=(0, max(*values, values[0] * 1.3) * 1.25),
    )
    axes.set_title(
        "growth: one façade's walk, over the points of the scene, µs a pose",
        loc="left",
        fontsize=11,
    )
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.3)


def goals_table(axes: Any, rows: list[dict[str, Any]], height: float) -> None:
    """Draw the targets: target, measurement, met or missed."""
    axes.set_axis_off()
    axes.set(xlim=(0, 1), ylim=(0, 1))
    line = min(0.3 / height, 0.94 / (len(rows) + 2))
    y = 0.985
    counts = {word: sum(row["verdict"] == word for row in rows) for word in (MET, MISSED)}
    rest = len(rows) - sum(counts.values())
    title = f"goals: {counts[MET]} met, {counts[MISSED]} missed" + (f", {rest} not measured" if rest else "")
    axes.text(0.0, y, title, fontsize=12, weight="bold", color=INK, va="top")
    y -= 1.5 * line
    for x, text, align in ((0.715, "figure", "right"), (0.862, "goal", "right")):
        axes.text(x, y, text, fontsize=9, color=FAINT, va="center", ha=align)
    for k, row in enumerate(rows):
        y -= line
        if k % 2 == 0:
            axes.axhspan(y - line / 2, y + line / 2, color="#f1f4f7", lw=0)
        colour = VERDICTS.get(row["verdict"], "#b8860b")
        text = textwrap.shorten(row["goal"], 72, placeholder="…")
        axes.text(0.005, y, text, fontsize=9, color=INK, va="center")
        shown = {"va": "center", "ha": "right", "color": colour, "fontsize": 9.5, "weight": "bold"}
        axes.text(0.715, y, number(row["measured"]), **shown)
        axes.text(0.862, y, limit_text(row), fontsize=9, color=FAINT, va="center", ha="right")
        axes.text(0.995, y, row["verdict"], **shown)
