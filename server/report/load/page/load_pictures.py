"""Pictures of a load test as PNG bytes: hit rate, stalls, bytes, round trips, resident voxels."""

import io
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...common.line_charts import label_ends, plain_ticks
from ...common.sphere_pictures import load_pyplot
from ..runs.load_cases import ECHO, Ran
from ..users.archive_voxels import Voxels
from ..users.frame_clock import FRAME
from ..users.frame_outcomes import PERCENTILES

Floats = NDArray[np.float64]

COLOURS = ("#1b6ca8", "#d98b2b", "#7a4fa3", "#2e8b57", "#74b3df", "#c9a227", "#4d4d4d", "#b79bd1")
INK, FAINT, LIMIT = "#222222", "#777777", "#c0392b"
MARKS = "osD^vP*X"
# One hue, from light to dark, for percentiles: they differ in grey, too.
SHADES = ("#9dc3e0", "#5a9bcb", "#1b6ca8", "#0b2f4d")
LABEL_FONT = 8.5


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


def _frame(axes: Any) -> tuple[float, float, str, str]:
    """Draw the line above which a frame stalls; return its end for `label_ends`."""
    axes.axhline(1e3 * FRAME, color=LIMIT, lw=1.1, ls="--")
    return axes.get_xlim()[1], 1e3 * FRAME, "a frame: 33 ms", LIMIT


def _ticks_at(axes: Any, values: list[float]) -> None:
    """Place ticks of a logarithmic x axis at the measured values only."""
    from matplotlib.ticker import NullLocator

    axes.xaxis.set_minor_locator(NullLocator())
    axes.set_xticks(values, [f"{value:g}" for value in values])


def hit_rate(runs: list[Ran]) -> bytes:
    """Draw the share of resident voxels in reach over the budget, as a share of all decoded bytes.

    Kinds of users differ in colour and mark, policies in filled and open marks.
    """
    figure, axes = _axes("hit rate of voxels over the budget, %")
    kinds = list(_by(runs, lambda r: r.case.kind))
    sides = list(_by(runs, lambda r: r.case.side))
    ends = []
    for (kind, side), own in _by(runs, lambda r: (r.case.kind, r.case.side)).items():
        k, first = kinds.index(kind), side == sides[0]
        own = sorted(own, key=lambda r: r.case.share)
        shares, rates = [r.case.share for r in own], [100 * r.figures.hit_rate for r in own]
        colour = COLOURS[k % 8]
        axes.plot(
            shares, rates, MARKS[k % 8] + ("-" if first else "--"), color=colour, lw=1.6,
            markerfacecolor=colour if first else "white",
        )  # fmt: skip
        ends.append((shares[-1], rates[-1], f"{kind}, {side}" if len(sides) > 1 else kind, colour))
    axes.set(xlabel="budget, share of the scene's decoded bytes", xscale="log")
    _ticks_at(axes, sorted({r.case.share for r in runs}))
    _settle(axes)
    label_ends(axes, ends, LABEL_FONT)
    return png(figure)


def stalls(runs: list[Ran]) -> bytes:
    """Draw percentiles of the time from due to answer over the users' speed, a panel for each policy."""
    by_side = _by(runs, lambda r: r.case.side)
    figure, panels = load_pyplot().subplots(
        1, len(by_side), figsize=(5.6 * len(by_side), 4.6), dpi=100, layout="constrained", squeeze=False, sharey=True
    )  # fmt: skip
    figure.suptitle(
        "from when a frame is due to its answer, over the users' speed, ms", fontsize=11, color=INK
    )
    drawn = []
    for axes, (side, own) in zip(panels.flat, by_side.items(), strict=True):
        own = sorted((r for r in own if np.isfinite(r.speed)), key=lambda r: r.speed)
        if not own:
            continue
        axes.set_title(side, loc="left", fontsize=10, color=INK)
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(alpha=0.25)
        axes.set(xlabel="mean speed of the users, m/s", yscale="log")
        ends = []
        for k, (share, values) in enumerate(
            zip(PERCENTILES, np.array([r.figures.delays for r in own]).T, strict=False)
        ):
            axes.plot([r.speed for r in own], 1e3 * values, MARKS[k] + "-", color=SHADES[k], lw=1.5, ms=5)
            name = "slowest" if share == 100.0 else f"p{share:g}"
            ends.append((own[-1].speed, float(1e3 * values[-1]), name, SHADES[max(k, 1)]))
        drawn.append((axes, ends))
    for axes, ends in drawn:  # once all panels have set the limits that they share
        plain_ticks(axes.yaxis)
        _settle(axes)
        ends.append(_frame(axes))
        label_ends(axes, ends, LABEL_FONT)
    return png(figure)


def round_trips(runs: list[Ran]) -> bytes:
    """Draw p50 and p99 over the number of users, beside a bare echo's."""
    figure, axes = _axes("from when a frame is due to its answer, over the number of users, ms")
    ends: list[tuple[float, float, str, str]] = []
    for k, (side, own) in enumerate(_by(runs, lambda r: r.case.side).items()):
        own = sorted(own, key=lambda r: r.case.users)
        colour = FAINT if side == ECHO else COLOURS[k % 8]
        users = [r.case.users for r in own]
        for at, style in ((0, "-"), (1, "--")):
            values = [1e3 * r.figures.delays[at] for r in own]
            face = colour if at == 0 else "white"
            axes.plot(users, values, MARKS[k % 8] + style, color=colour, lw=1.6, markerfacecolor=face)
            ends.append((users[-1], values[-1], f"{side}, p{PERCENTILES[at]:g}", colour))
    axes.set(xlabel="users, 30 frames a second each", xscale="log", yscale="log")
    plain_ticks(axes.yaxis)
    _ticks_at(axes, sorted({r.case.users for r in runs}))
    _settle(axes)
    ends.append(_frame(axes))
    label_ends(axes, ends, LABEL_FONT)
    return png(figure)


def _settle(axes: Any) -> None:
    """Fix the limits of the axes, which must hold the line of a frame's duration, too, if in ms."""
    low, high = axes.get_ylim()
    if axes.get_yscale() == "log":
        high = max(high, 1.5e3 * FRAME)
    axes.set(xlim=axes.get_xlim(), ylim=(low, high))


def bytes_over_time(runs: list[Ran]) -> bytes:
    """Draw the resident bytes that answers report, the process's memory and the budget.

    There is one panel per run, and one legend below all panels.
    """
    columns = min(3, max(1, len(runs)))
    rows = -(-len(runs) // columns)
    size = (5.2 * columns, 2.9 * rows + 0.4)
    figure, panels = load_pyplot().subplots(
        rows, columns, figsize=size, dpi=100, layout="constrained", squeeze=False
    )
    for axes in panels.flat[len(runs) :]:
        axes.set_axis_off()
    for axes, ran in zip(panels.flat, runs, strict=False):
        axes.plot(ran.resident[0], ran.resident[1] / 2**20, color=COLOURS[0], lw=2.2, label="resident voxels")
        beyond = (ran.rss[1] - ran.empty) / 2**20
        axes.plot(
            ran.rss[0], beyond, color=COLOURS[1], lw=1.0, label="memory beyond that of the warm, empty server"
        )
        axes.axhline(ran.budget / 2**20, color=LIMIT, ls=":", lw=1.6, label="budget")
        axes.set_title(f"{ran.case.name}, {ran.case.side}", loc="left", fontsize=8.5)
        axes.set(xlabel="s", ylabel="MB", xlim=(0, None), ylim=(0, None))
        axes.spines[["top", "right"]].set_visible(False)
    handles, names = panels.flat[0].get_legend_handles_labels()
    figure.legend(
        handles, names, loc="outside lower center", ncols=min(3, 2 * columns - 1), fontsize=8, frameon=False
    )
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
    axes.add_collection(PolyCollection(list(corners), facecolors=colour, edgecolors="none", alpha=alpha))


def _by(runs: list[Ran], key: Callable[[Ran], Any]) -> dict[Any, list[Ran]]:
    """Return runs by a key, in order of their first."""
    found: dict[Any, list[Ran]] = {}
    for ran in runs:
        found.setdefault(key(ran), []).append(ran)
    return found


def draw_pictures(
    runs: Mapping[str, list[Ran]], voxels: Voxels, strips: dict[int, bytes]
) -> list[tuple[str, bytes]]:
    """Draw the pictures of all runs: titles and PNGs.

    runs: by section.  strips: film strips drawn before, by the id of their run; new ones are added.
    """
    found = []
    steady = [ran for ran in runs["kinds"] if np.isfinite(ran.speed)]
    for name, of, picture in (
        ("Hit rate over budget", runs["budgets"], hit_rate),
        ("Stalls over speed", runs["speeds"] or steady, stalls),
        ("Round trips over users", runs["users"], round_trips),
        ("Bytes over time", runs["kinds"] or runs["speeds"], bytes_over_time),
    ):
        if of:
            found.append((name, picture(of)))
    for ran in runs["kinds"]:
        if ran.strip:
            if id(ran) not in strips:
                strips[id(ran)] = film_strip(ran, voxels)
            found.append((f"Resident: {ran.case.name}, {ran.case.side}", strips[id(ran)]))
    return found
