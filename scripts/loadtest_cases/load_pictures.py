"""Pictures of a load test as PNG bytes: hit rate, stalls, bytes, round trips, resident voxels."""

import io
from typing import Any

import numpy as np
from bench_engine_cases.engine_picture import FAINT, INK, VERDICTS
from measurement.bench_results import MISSED
from numpy.typing import NDArray
from solidcloud.server.report.common.sphere_pictures import load_pyplot

from .archive_voxels import Voxels
from .frame_clock import FRAME
from .frame_outcomes import PERCENTILES
from .load_cases import ECHO, Ran

Floats = NDArray[np.float64]

COLOURS = ("#1b6ca8", "#d98b2b", "#7a4fa3", "#2e8b57", "#74b3df", "#c9a227", "#4d4d4d", "#b79bd1")
LIMIT = VERDICTS[MISSED]
MARKS = "osD^vP*X"


def png(figure: Any) -> bytes:
    """Return a figure as PNG and close it."""
    out = io.BytesIO()
    figure.savefig(out, format="png")
    load_pyplot().close(figure)
    return out.getvalue()


def _axes(title: str, width: float = 9.0, height: float = 4.6) -> tuple[Any, Any]:
    figure, axes = load_pyplot().subplots(figsize=(width, height), dpi=100, layout="constrained")
    axes.set_title(title, loc="left", fontsize=11, color=INK)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.25)
    return figure, axes


def _frame(axes: Any) -> None:
    """Draw the line above which a frame stalls."""
    axes.axhline(1e3 * FRAME, color=LIMIT, lw=1.1, ls="--")
    across = axes.get_yaxis_transform()
    axes.text(0.01, 1e3 * FRAME, "a frame: 33 ms", color=LIMIT, fontsize=8, va="bottom", transform=across)


def _plain_ticks(axis: Any) -> None:
    """Format a logarithmic axis with plain numbers, at 1, 2 and 5."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def _ticks_at(axes: Any, values: list[float]) -> None:
    """Place ticks of a logarithmic x axis at the measured values only."""
    from matplotlib.ticker import NullLocator

    axes.xaxis.set_minor_locator(NullLocator())
    axes.set_xticks(values, [f"{value:g}" for value in values])


def _sides(runs: list[Ran]) -> dict[str, list[Ran]]:
    """Return runs by kind and policy, in order of their first."""
    found: dict[str, list[Ran]] = {}
    for ran in runs:
        found.setdefault(f"{ran.case.kind}, {ran.case.side}", []).append(ran)
    return found


def hit_rate(runs: list[Ran]) -> bytes:
    """Draw the share of resident voxels in reach over the budget, as a share of all decoded bytes."""
    figure, axes = _axes("hit rate of voxels over the budget, %")
    for k, (name, own) in enumerate(_sides(runs).items()):
        own = sorted(own, key=lambda r: r.case.share)
        shares, rates = [r.case.share for r in own], [100 * r.figures.hit_rate for r in own]
        axes.plot(shares, rates, MARKS[k % 8] + "-", color=COLOURS[k % 8], label=name, lw=1.6)
    axes.set(xlabel="budget, share of the scene's decoded bytes", xscale="log")
    _ticks_at(axes, sorted({r.case.share for r in runs}))
    axes.legend(fontsize=8, frameon=False)
    return png(figure)


def stalls(runs: list[Ran]) -> bytes:
    """Draw percentiles of the time from due to answer over the users' speed."""
    figure, axes = _axes("from when a frame is due to its answer, over the users' speed, ms")
    for k, (side, own) in enumerate(_by(runs, lambda r: r.case.side).items()):
        own = sorted((r for r in own if np.isfinite(r.speed)), key=lambda r: r.speed)
        for share, values in zip(PERCENTILES, np.array([r.figures.delays for r in own]).T, strict=False):
            style = {50.0: ":", 99.0: "--", 99.9: "-."}.get(share, "-")
            label = f"{side}, p{share:g}"
            axes.plot(
                [r.speed for r in own], 1e3 * values, style + MARKS[k % 8], color=COLOURS[k % 8], label=label
            )
    _frame(axes)
    axes.set(xlabel="mean speed of the users, m/s", yscale="log")
    _plain_ticks(axes.yaxis)
    axes.legend(fontsize=7, frameon=False, ncols=2)
    return png(figure)


def round_trips(runs: list[Ran]) -> bytes:
    """Draw p50 and p99 over the number of users, beside a bare echo's."""
    figure, axes = _axes("from when a frame is due to its answer, over the number of users, ms")
    for k, (side, own) in enumerate(_by(runs, lambda r: r.case.side).items()):
        own = sorted(own, key=lambda r: r.case.users)
        colour = FAINT if side == ECHO else COLOURS[k % 8]
        for at, style in ((0, "-"), (1, "--")):
            values = [1e3 * r.figures.delays[at] for r in own]
            label = f"{side}, p{PERCENTILES[at]:g}"
            axes.plot(
                [r.case.users for r in own], values, style + MARKS[k % 8], color=colour, label=label, lw=1.6
            )
    _frame(axes)
    axes.set(xlabel="users, 30 frames a second each", xscale="log", yscale="log")
    _plain_ticks(axes.yaxis)
    _ticks_at(axes, sorted({r.case.users for r in runs}))
    axes.legend(fontsize=8, frameon=False)
    return png(figure)


def bytes_over_time(runs: list[Ran]) -> bytes:
    """Draw the resident bytes that answers report, the process's memory and the budget.

    There is one panel per run.
    """
    columns = min(3, max(1, len(runs)))
    rows = -(-len(runs) // columns)
    size = (5.2 * columns, 2.9 * rows)
    figure, panels = load_pyplot().subplots(
        rows, columns, figsize=size, dpi=100, layout="constrained", squeeze=False
    )
    for axes in panels.flat[len(runs) :]:
        axes.set_axis_off()
    for axes, ran in zip(panels.flat, runs, strict=False):
        axes.plot(ran.resident[0], ran.resident[1] / 2**20, color=COLOURS[0], lw=1.4, label="resident voxels")
        beyond = (ran.rss[1] - ran.empty) / 2**20
        axes.plot(ran.rss[0], beyond, color=COLOURS[1], lw=1.1, label="RSS beyond warm, empty")
        axes.axhline(ran.budget / 2**20, color=LIMIT, ls="--", lw=1.1, label="budget")
        axes.set_title(f"{ran.case.name}, {ran.case.side}", loc="left", fontsize=8.5)
        axes.set(xlabel="s", ylabel="MB", xlim=(0, None), ylim=(0, None))
        axes.spines[["top", "right"]].set_visible(False)
    panels.flat[0].legend(fontsize=7, frameon=False, loc="center right")
    return png(figure)


def film_strip(ran: Ran, voxels: Voxels) -> bytes:
    """Draw the positions of the resident voxels over time, from above."""
    boxes = voxels.boxes
    low, high = boxes[:, 0, :2].min(axis=0), boxes[:, 1, :2].max(axis=0)
    columns = min(6, len(ran.strip))
    rows = -(-len(ran.strip) // columns)
    tall = float(np.clip((high[1] - low[1]) / (high[0] - low[0]), 0.3, 3.0))
    size = (2.3 * columns, (2.3 * tall + 0.4) * rows)
    figure, panels = load_pyplot().subplots(
        rows, columns, figsize=size, dpi=100, layout="constrained", squeeze=False
    )
    for axes in panels.flat:
        axes.set_axis_off()
    for axes, (at, resident) in zip(panels.flat, ran.strip, strict=False):
        held = np.zeros(len(boxes), bool)
        held[voxels.rows(resident)] = True
        for own, colour, alpha in ((~held, "#d5dae0", 0.6), (held, COLOURS[0], 0.5)):
            _plan(axes, boxes[own], colour, alpha)
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
        axes.set_title(f"{at:.1f} s, {int(held.sum())} voxels", fontsize=8)
    figure.suptitle(f"resident from above: {ran.case.name}, {ran.case.side}", fontsize=10)
    return png(figure)


def _plan(axes: Any, boxes: Floats, colour: str, alpha: float) -> None:
    """Draw boxes (k, 2, 3) from above."""
    from matplotlib.collections import PolyCollection

    (x0, y0), (x1, y1) = boxes[:, 0, :2].T, boxes[:, 1, :2].T
    corners = np.stack([np.stack(c, axis=-1) for c in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))], axis=1)
    axes.add_collection(PolyCollection(corners, facecolors=colour, edgecolors="none", alpha=alpha))


def _by(runs: list[Ran], key: Any) -> dict[str, list[Ran]]:
    found: dict[str, list[Ran]] = {}
    for ran in runs:
        found.setdefault(key(ran), []).append(ran)
    return found
