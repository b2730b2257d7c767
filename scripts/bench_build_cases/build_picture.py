"""Picture of scripts/bench_build: stages and limits, memory over time, bytes per point, and targets."""

from pathlib import Path
from typing import Any

from bench_engine_cases.engine_picture import FAINT, SERIES, goals_table, text_on, write_picture
from solidcloud.server.report.common.bench_results import Part, goal_rows, number
from solidcloud.server.report.common.sphere_pictures import load_pyplot

from .build_runs import REST, Built

REST_COLOUR = "#ececec"
LIMIT = "#c0392b"


def draw(
    parts: list[Part],
    notes: dict[str, str],
    builds: list[Built],
    limits: dict[int, dict[str, float]],
    bound: int,
    machine: str,
    target: Path,
) -> None:
    """Write the picture as PNG.

    builds: one per size.
    limits: points -> name -> seconds.
    bound: --memory [bytes].
    """
    pyplot = load_pyplot()
    rows = goal_rows(parts, notes)
    sizes = [
        f for part in parts if part.section != "builds" for f in part.figures if f.what in ("archive", "LAZ")
    ]
    cases = list(dict.fromkeys(f.case for f in sizes))
    bars = sum(1 + len(limits.get(built.points, {})) for built in builds)
    heights = [(1.2 + 0.33 * bars, 3.0), (1.0 + 0.3 * len(rows), 1.2 + 0.36 * len(cases))]
    height = max(map(sum, heights)) + 0.6
    figure = pyplot.figure(figsize=(18, height), dpi=110, layout="constrained")
    left, right = figure.subfigures(1, 2, width_ratios=[1.2, 1])
    axes = left.subplots(2, 1, height_ratios=heights[0])
    _stages(axes[0], builds, limits)
    _memory(axes[1], builds, bound)
    # Two separate figures: in a shared one, the long labels of the lower would squeeze the upper.
    parts_right = right.subfigures(2, 1, height_ratios=heights[1]) if cases else [right]
    goals_table(parts_right[0].subplots(), rows, heights[1][0] if cases else height)
    if cases:
        _sizes(parts_right[1].subplots(), sizes, cases)
    title = f"solidcloud build: LAS in, validated archive out, one run  ({machine})"
    write_picture(figure, title, parts, target)


def _stages(axes: Any, builds: list[Built], limits: dict[int, dict[str, float]]) -> None:
    """Draw nanoseconds per point of each stage, one bar per size, and the machine's limits below."""
    names = [*dict.fromkeys(name for built in builds for name in built.stages if name != REST), REST]
    colours = {name: SERIES[k % len(SERIES)] for k, name in enumerate(names)} | {REST: REST_COLOUR}
    longest = max(built.seconds / built.points for built in builds) * 1e9
    labels: list[str] = []
    for k, built in enumerate(builds):
        row, at = len(labels), 0.0
        labels.append(f"build of {built.points:,} points")
        for name in names:
            width = built.stages.get(name, 0.0) / built.points * 1e9
            axes.barh(row, width, left=at, height=0.8, color=colours[name], label=name if k == 0 else None)
            if width > 0.08 * longest:
                text = f"{width:.0f}, {width * built.points / built.seconds / 1e9:.0%}"
                axes.text(
                    at + width / 2,
                    row,
                    text,
                    ha="center",
                    va="center",
                    fontsize=8,
                    color=text_on(colours[name]),
                )
            at += width
        rate = f" {at:.0f}: {built.points / built.seconds / 1e6:.2f} M points/s"
        axes.text(at, row, rate, va="center", fontsize=9, weight="bold")
        for what, seconds in sorted(limits.get(built.points, {}).items(), key=lambda item: item[1]):
            row, width = len(labels), seconds / built.points * 1e9
            labels.append(f"{what} alone")
            axes.barh(row, width, height=0.45, color=LIMIT)
            axes.text(width, row, f" {number(width)}", va="center", fontsize=8, color=LIMIT)
    axes.axvline(500, color=FAINT, ls="--", lw=1.2)
    axes.annotate(
        "goal: 2 M points/s",
        (500, -0.9),
        xytext=(4, 0),
        textcoords="offset points",
        fontsize=8,
        color=FAINT,
        va="center",
    )
    axes.set_yticks(range(len(labels)), labels, fontsize=8.5)
    axes.set(ylim=(len(labels) - 0.4, -1.3), xlim=(0, max(longest * 1.25, 600)))
    title = "time, ns a point: stages of each build, and what reading, writing, decoding take alone"
    axes.set_title(title, loc="left", fontsize=11)
    axes.legend(fontsize=8, frameon=False, loc="lower right")
    axes.spines[["top", "right"]].set_visible(False)


def _memory(axes: Any, builds: list[Built], bound: int) -> None:
    """Draw memory over the build, with each build's duration scaled to one."""
    for k, built in enumerate(builds):
        samples = built.watched.samples
        axes.plot(
            [s.at / built.seconds for s in samples], [s.pss / 2**20 for s in samples], color=SERIES[k % len(SERIES)],
            lw=1.4, label=f"{built.points:,} points",
        )  # fmt: skip
    for limit, text in ((bound, "--memory"), (bound + (200 << 20), "goal: 200 MB more")):
        axes.axhline(limit / 2**20, color=LIMIT, ls="--", lw=1.1)
        axes.text(
            0.005, limit / 2**20, text, fontsize=8, color=LIMIT, va="bottom",
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.5},
        )  # fmt: skip
    axes.set(xlim=(0, 1), ylim=(0, None), xlabel="share of the build's time")
    axes.set_title("memory of all processes together (sum of PSS), MB", loc="left", fontsize=11)
    axes.legend(fontsize=8, frameon=False, loc="lower right")
    axes.spines[["top", "right"]].set_visible(False)


def _sizes(axes: Any, sizes: list[Any], cases: list[str]) -> None:
    """Draw bytes per point: the archive, and LAZ of the same xyz where it exists."""
    for shift, what, colour in ((-0.2, "archive", SERIES[0]), (0.2, "LAZ", "#8a8a8a")):
        own = [f for f in sizes if f.what == what]
        places = [cases.index(f.case) + shift for f in own]
        axes.barh(
            places,
            [f.value for f in own],
            height=0.36,
            color=colour,
            label=what if what == "archive" else "LAZ, xyz alone",
        )
        for y, f in zip(places, own, strict=True):
            axes.text(f.value, y, f" {number(f.value)}", va="center", fontsize=8)
    axes.set_yticks(range(len(cases)), cases, fontsize=8.5)
    axes.set_ylim(len(cases) - 0.4, -0.6)
    axes.set_title("bytes a point", loc="left", fontsize=11)
    axes.legend(fontsize=8, frameon=False, loc="lower right")
    axes.spines[["top", "right"]].set_visible(False)
