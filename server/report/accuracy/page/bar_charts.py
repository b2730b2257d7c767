"""Bar charts of the accuracy report: each knob, and the sheet with a door."""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...common.sphere_pictures import load_pyplot
from ..measurement.setting_results import RADIUS, Row

# Colours of the pictures' palette: halves the file size without losing a colour.
PALETTE = 256
# They differ in lightness, so that bars and lines also differ in a grey print.
MODEL_COLOURS = {
    "mean": "#2f2a26", "local": "#1e7586", "border": "#ce6954", "local+border": "#5b3c6f", "fixed": "#d2990d",
}  # fmt: skip


def draw_knob(knob: str, rows: Sequence[Row], target: Path) -> Path:
    """Draw the times (p50 to p99) and the errors of each setting of one knob, side by side."""
    pyplot = load_pyplot()
    figure, (times, wrong) = pyplot.subplots(
        1, 2, figsize=(9.0, 1.5 + 0.34 * len(rows)), sharey=True, layout="constrained", width_ratios=[1.3, 1]
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
    times.set_xlabel("time per pose [µs]\np50 to p99 of groups of poses, mean as a point")
    left = np.zeros(len(rows))
    for name, colour in (("early", "#d62839"), ("late", "#5b1a8b"), ("unknown", "#b9b2a8")):
        share = np.array([getattr(row, name) / max(row.poses, 1) * 100 for row in rows])
        wrong.barh(range(len(rows)), share, left=left, color=colour, height=0.6, label=name)
        left += share
    wrong.set_xlim(0, max(1.0, float(left.max()) * 1.15))
    than = "mean's" if knob == RADIUS else "the exact ones"
    wrong.set_xlabel(f"verdicts that differ\nfrom {than} [% of poses]")
    # Above the panel, clear of the bars.
    wrong.legend(frameon=False, fontsize=8, loc="lower right", bbox_to_anchor=(1.0, 0.99), ncols=3)
    for panel in (times, wrong):
        panel.grid(alpha=0.25, axis="x")
    save_picture(figure, target)
    pyplot.close(figure)
    return target


def save_picture(figure: Any, target: Path) -> None:
    """Save a figure as a PNG with PALETTE colours."""
    from PIL import Image

    drawn = io.BytesIO()
    figure.savefig(drawn, dpi=100)
    with Image.open(drawn) as image:
        image.convert("RGB").quantize(PALETTE, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(
            target, optimize=True
        )


def draw_sheet(rows: Sequence[Row], target: Path) -> Path:
    """Draw the doorway error and the leak of the sheet with a door, by radius model and factor."""
    pyplot = load_pyplot()
    figure, panels = pyplot.subplots(1, 2, figsize=(9.0, 3.4), layout="constrained")
    titles = {
        "doorway_mm": "Door: extra width that the figure needs [mm]",
        "leak_p99_mm": "Sheet: leak, 99th percentile [mm]",
    }
    models = list(dict.fromkeys(row.setting.split(":")[0] for row in rows))
    factors = sorted({row.value or 0.0 for row in rows})
    for panel, (name, title) in zip(panels, titles.items(), strict=True):
        for k, model in enumerate(models):
            own = {row.value: float(getattr(row, name)) for row in rows if row.setting.split(":")[0] == model}
            places = np.arange(len(factors)) + (k - (len(models) - 1) / 2) * 0.8 / len(models)
            heights = [own.get(factor, np.nan) for factor in factors]
            bars = panel.bar(
                places, heights, width=0.76 / len(models), color=MODEL_COLOURS[model], label=model
            )
            panel.bar_label(bars, fmt="%.1f", fontsize=9, padding=2)
        panel.axhline(0.0, color="#8a8178", lw=0.8)
        panel.margins(y=0.15)
        panel.set_xticks(range(len(factors)), [f"{factor:g}" for factor in factors])
        panel.set_xlabel("factor on the mean radius")
        panel.set_title(title, fontsize=10.5, loc="left")
        for side in ("top", "right"):
            panel.spines[side].set_visible(False)
    panels[0].legend(frameon=False, fontsize=9)
    save_picture(figure, target)
    pyplot.close(figure)
    return target
