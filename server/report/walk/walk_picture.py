"""Picture of a walk: its path, its contacts, and the time of each answer."""

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from ....schemas.wire.answers import Verdict
from .walk_answers import Walk, WalkAnswers

COLOURS = {Verdict.CLEAR: "#1f7a8c", Verdict.CONTACT: "#d62839", Verdict.UNKNOWN: "#e0a100"}
PAPER, INK = "#fbfaf7", "#2f2a26"
STONE = LinearSegmentedColormap.from_list("stone", [PAPER, "#d9cfc1", "#a08e78", "#5b4d40"])
# The figure is drawn at most MAX_FIGURES times: in the middle of the CONTACTS longest contacts, and at
# regular intervals, at least the share APART of the walk from one another.
MAX_FIGURES, CONTACTS, APART = 8, 4, 0.07
# Pixels along the longest extent; the plan, where walls are lines, has half as many.
PIXELS = 700
# Range of heights above the floor that the plan shows [m]: from shin to above the head.
PLAN_LOW, PLAN_HIGH = 0.15, 2.2


def draw_walk(path: Path, walk: Walk, frames: WalkAnswers, avatar: NDArray[np.float64]) -> None:
    """Draw a walk as a PNG: plan from above, elevation, and the times of every frame.

    avatar: (n, 3) [m], drawn at its pose in a few frames, in the longest contacts if there are any.
    """
    matplotlib.rcParams.update({"font.size": 10, "axes.edgecolor": "#8a8178", "text.color": INK})
    figure = Figure(figsize=(12, 8.2), facecolor=PAPER, layout="constrained")
    parts: Any = figure.subfigures(2, 1, height_ratios=[2.35, 1], facecolor=PAPER)
    upper, lower = parts
    plan, elevation = upper.subplots(1, 2, width_ratios=_widths(walk))
    times = lower.subplots()
    stops = _stops(frames.verdict)
    _draw_plan(plan, walk, frames, stops)
    _draw_elevation(elevation, walk, frames, avatar, stops)
    _draw_times(times, walk, frames)
    touched = int((frames.verdict == Verdict.CONTACT).sum())
    figure.suptitle(
        f"{len(frames.verdict):,} poses of a figure of {len(avatar):,} points: {touched} touch the scan",
        fontsize=14,
        fontweight="bold",
    )
    figure.savefig(path, dpi=100, pil_kwargs={"optimize": True})


def _widths(walk: Walk) -> list[float]:
    """Return the widths of plan and elevation at which both have the same height."""
    x, y, z = _extent(walk.points).T
    ratios = [np.ptp(x) / np.ptp(y), np.ptp((x, y)[walk.elevation]) / np.ptp(z)]
    return [min(max(float(ratio), 0.5), 2.0) for ratio in ratios]


def _extent(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the low and high corner (2, 3) of points [m], without the farthest outliers."""
    return np.quantile(points, [0.0005, 0.9995], axis=0) + np.array([[-0.3], [0.3]])


def _stops(verdict: NDArray[np.uint8]) -> list[int]:
    """Return the frames in which the figure is drawn."""
    count = len(verdict)
    longest = sorted(_runs(verdict == Verdict.CONTACT), key=lambda run: run[0] - run[1])[:CONTACTS]
    wanted = [(first + last) // 2 for first, last in longest]
    wanted += (np.linspace(0.03, 0.97, 2 * MAX_FIGURES) * count).astype(int).tolist()
    stops: list[int] = []
    for k in wanted:
        if len(stops) < MAX_FIGURES and all(abs(k - other) >= APART * count for other in stops):
            stops.append(k)
    return sorted(stops)


def _draw_plan(axes: Any, walk: Walk, frames: WalkAnswers, stops: list[int]) -> None:
    """Draw the scan from above, and the path coloured by verdict."""
    floor = np.median(walk.poses[:, 2, 3])
    heights = walk.points[:, 2] - floor
    walls = walk.points[(heights > PLAN_LOW) & (heights < PLAN_HIGH)]
    low, high = _extent(walk.points)
    _draw_points(axes, walls, (0, 1), (low, high), PIXELS // 2)
    at = walk.poses[:, :2, 3]
    for verdict in Verdict:
        chosen = frames.verdict == verdict
        size = 26 if verdict == Verdict.CONTACT else 7
        axes.scatter(*at[chosen].T, s=size, color=COLOURS[verdict], linewidths=0, zorder=3 + int(verdict))
    for number, k in enumerate(stops, 1):
        _badge(axes, number, at[k], (9, 9), frames.verdict[k])
    axes.set_title("Plan, from shin to head")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    handles = [
        Line2D([], [], marker="o", linestyle="", color=COLOURS[v], label=f"{v.name.lower()} {n:,}")
        for v in Verdict
        if (n := int((frames.verdict == v).sum()))
    ]
    axes.legend(handles=handles, loc="lower right", framealpha=0.9)


def _draw_elevation(
    axes: Any, walk: Walk, frames: WalkAnswers, avatar: NDArray[np.float64], stops: list[int]
) -> None:
    """Draw the scan from the side, and the figure in some frames."""
    across = walk.elevation
    low, high = _extent(walk.points)
    _draw_points(axes, walk.points, (across, 2), (low, high), PIXELS)
    for number, k in enumerate(stops, 1):
        placed = avatar @ walk.poses[k, :3, :3].T + walk.poses[k, :3, 3]
        colour = COLOURS[Verdict(int(frames.verdict[k]))]
        axes.scatter(placed[:, across], placed[:, 2], s=0.8, color=colour, linewidths=0, zorder=4)
        head = (walk.poses[k, across, 3], placed[:, 2].max())
        _badge(axes, number, head, (0, 11), frames.verdict[k])
    axes.set_title("Elevation, with the figure at the numbered places")
    axes.set_xlabel(f"{'xy'[across]} [m]")
    axes.set_ylabel("z [m]")


def _badge(axes: Any, number: int, at: Any, shift: tuple[int, int], verdict: int) -> None:
    """Draw the number of a place beside it, in the colour of its verdict."""
    axes.annotate(
        str(number),
        at,
        xytext=shift,
        textcoords="offset points",
        ha="center",
        va="center",
        fontsize=9,
        fontweight="bold",
        color="white",
        bbox={"boxstyle": "circle,pad=0.2", "fc": COLOURS[Verdict(int(verdict))], "ec": "white"},
        zorder=9,
    )


def _draw_points(
    axes: Any,
    points: NDArray[np.float64],
    shown: tuple[int, int],
    extent: tuple[NDArray[np.float64], NDArray[np.float64]],
    pixels: int,
) -> None:
    """Draw points as an image of their density on a logarithmic scale.

    shown: horizontal and vertical axis.
    """
    low, high = extent
    pixel = float((high - low).max()) / pixels
    edges = [np.arange(low[axis], high[axis] + pixel, pixel) for axis in shown]
    counts, _, _ = np.histogram2d(points[:, shown[0]], points[:, shown[1]], bins=edges)
    image = np.log1p(counts.T)
    axes.imshow(
        image,
        origin="lower",
        extent=(edges[0][0], edges[0][-1], edges[1][0], edges[1][-1]),
        cmap=STONE,
        vmax=float(np.quantile(image[image > 0], 0.93)) if image.any() else 1.0,
        interpolation="nearest",
    )
    axes.set_facecolor(PAPER)


def _draw_times(axes: Any, walk: Walk, frames: WalkAnswers) -> None:
    """Draw the engine and round-trip times of every frame, with contacts and loads marked."""
    for start, end in _runs(frames.verdict == Verdict.CONTACT):
        axes.axvspan(
            walk.times[start], walk.times[end], color=COLOURS[Verdict.CONTACT], alpha=0.13, linewidth=0
        )
    trip, engine = frames.round_trip * 1e3, frames.engine * 1e3
    axes.plot(
        walk.times, trip, color="#9a8c7c", linewidth=0.8, label=f"round trip, p50 {np.median(trip):.2f} ms"
    )
    axes.plot(
        walk.times,
        engine,
        color=COLOURS[Verdict.CLEAR],
        linewidth=0.9,
        label=f"in the engine, p50 {np.median(engine):.3f} ms",
    )
    loads = frames.misses > 0
    if loads.any():
        axes.scatter(
            walk.times[loads], engine[loads], marker="v", s=26, color=INK, zorder=4, label="voxels loaded"
        )
    axes.set_yscale("log")
    axes.set_xlim(walk.times[0], walk.times[-1])
    axes.set_xlabel("time along the walk [s]; shaded: contact")
    axes.set_ylabel("[ms]")
    axes.set_title("Time of each frame, one request per frame over zenoh")
    axes.set_facecolor(PAPER)
    axes.grid(axis="y", color="#e4ded4", linewidth=0.6)
    axes.legend(loc="upper right", ncols=3, framealpha=0.9)


def _runs(flags: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the first and last index of each run of True."""
    steps = np.diff(np.concatenate([[0], flags.astype(np.int8), [0]]))
    ends = np.flatnonzero(steps == -1) - 1
    return list(zip(np.flatnonzero(steps == 1).tolist(), ends.tolist(), strict=True))
