"""Picture of a walk: its path, its contacts, and the time of each answer."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from ....schemas.wire.answers import Verdict
from .walk_answers import Walk, WalkAnswers

# Colours that are shown together differ in lightness, so that they also differ in a grey print.
COLOURS = {Verdict.CLEAR: "#2092ac", Verdict.CONTACT: "#9c001e", Verdict.UNKNOWN: "#f1b833"}
ROUND_TRIP, ENGINE = "#b8a996", "#0f4d5e"
PAPER, INK = "#fbfaf7", "#2f2a26"
STONE = LinearSegmentedColormap.from_list("stone", [PAPER, "#d9cfc1", "#a08e78", "#5b4d40"])
# The figure is drawn at most MAX_FIGURES times: in the middle of the CONTACTS longest contacts, and at
# regular intervals, at least the share APART of the walk from one another.
MAX_FIGURES, CONTACTS, APART = 8, 4, 0.07
# Pixels along the longest extent; the plan, where walls are lines, has half as many.
PIXELS = 700
# Range of heights above the floor that the plan shows [m]: from shin to above the head.
PLAN_LOW, PLAN_HIGH = 0.15, 2.2


# Sizes of the picture [inches]: its width, at least and at most, its title, the times below; the
# largest height of plan and elevation, and the room for labels around each panel.
NARROWEST, WIDEST, TITLE, TIMES = 9.5, 12.0, 0.85, 1.75
HIGHEST = 6.2
LEFT, RIGHT, ABOVE, BELOW = 0.75, 0.2, 0.4, 0.55
# Ratio of width to height of plan and elevation: a scan beyond it gets a margin.
FLATTEST, STEEPEST = 14.0, 0.35
# Ratio of length to width from which a plan is turned so that its length is horizontal.
LONG = 1.8
# Diameter of a number's disc [points], and the distances of its centre from its place.
DISC = 17.0
AROUND = [(9, 9), (-9, 9), (9, -9), (-9, -9), (20, 0), (-20, 0), (0, 24), (0, -24), (24, 24)]
OVERHEAD = [(0.0, 11.0 + 18.0 * k) for k in range(8)]


class Layout(NamedTuple):
    """Places of the panels, (left, bottom, width, height) in inches, and the size of the picture."""

    size: tuple[float, float]
    plan: tuple[float, float, float, float]
    elevation: tuple[float, float, float, float]
    times: tuple[float, float, float, float]

    @property
    def filled(self) -> float:
        """Return the share of the picture above the times that plan and elevation fill."""
        shown = sum(width * height for _, _, width, height in (self.plan, self.elevation))
        return shown / (self.size[0] * (self.size[1] - self.times[1] - self.times[3] - TITLE))


def draw_walk(path: Path, walk: Walk, frames: WalkAnswers, avatar: NDArray[np.float64]) -> None:
    """Draw a walk as a PNG: plan from above, elevation, and the times of every frame.

    avatar: (n, 3) [m], drawn at its pose in a few frames, in the longest contacts if there are any.
    """
    matplotlib.rcParams.update({"font.size": 10, "axes.edgecolor": "#8a8178", "text.color": INK})
    extent = _extent(walk.points)
    flat = _plan_axes(extent)
    shown = [_shown(extent, flat), _shown(extent, (walk.elevation, 2))]
    layout = arrange(*(float(ratio) for ratio in (np.ptp(x) / np.ptp(y) for x, y in shown)))
    width, height = layout.size
    figure = Figure(figsize=layout.size, facecolor=PAPER)
    plan, elevation, times = (
        figure.add_axes((x / width, y / height, w / width, h / height))
        for x, y, w, h in (layout.plan, layout.elevation, layout.times)
    )
    for axes, (x, y) in zip((plan, elevation), shown, strict=True):
        axes.set(xlim=tuple(x), ylim=tuple(y), autoscale_on=False)
    if flat != (0, 1):
        plan.invert_yaxis()  # turned by 90 degrees, not mirrored
    stops = _stops(frames.verdict)
    _draw_plan(plan, walk, frames, stops, flat)
    _draw_elevation(elevation, walk, frames, avatar, stops)
    _draw_times(times, walk, frames)
    touched = int((frames.verdict == Verdict.CONTACT).sum())
    figure.suptitle(
        f"{len(frames.verdict):,} poses of a figure of {len(avatar):,} points: {touched} touch the scan",
        fontsize=14,
        fontweight="bold",
        y=1 - 0.27 / height,
    )
    figure.legend(
        handles=_verdict_handles(frames.verdict),
        loc="center",
        bbox_to_anchor=(0.5, 1 - 0.62 / height),
        ncols=len(Verdict),
        frameon=False,
    )
    figure.savefig(path, dpi=100, pil_kwargs={"optimize": True})


def arrange(plan: float, elevation: float) -> Layout:
    """Return the layout in which plan and elevation fill the picture best: side by side or stacked.

    plan, elevation: ratios of width to height.
    """
    stacked = [_stacked(plan, elevation, wide) for wide in np.linspace(NARROWEST, WIDEST, 6).tolist()]
    return max([_side_by_side(plan, elevation), *stacked], key=lambda layout: layout.filled)


def _side_by_side(plan: float, elevation: float) -> Layout:
    """Return the layout with plan and elevation of one height, beside each other."""
    room = LEFT + RIGHT
    high = min((WIDEST - 2 * room) / (plan + elevation), HIGHEST)
    wide = max((plan + elevation) * high + 2 * room, NARROWEST)
    bottom = BELOW + TIMES + ABOVE + BELOW
    return Layout(
        (wide, bottom + high + ABOVE + TITLE),
        (LEFT, bottom, plan * high, high),
        (wide - RIGHT - elevation * high, bottom, elevation * high, high),
        (LEFT, BELOW, wide - room, TIMES),
    )


def _stacked(plan: float, elevation: float, wide: float) -> Layout:
    """Return the layout with the plan above the elevation, in a picture of this width [inches]."""
    room = LEFT + RIGHT
    sizes = []
    for ratio in (plan, elevation):
        high = min((wide - room) / ratio, HIGHEST)
        sizes.append((ratio * high, high))
    low = BELOW + TIMES + ABOVE + BELOW
    top = low + sizes[1][1] + ABOVE + BELOW
    return Layout(
        (wide, top + sizes[0][1] + ABOVE + TITLE),
        (LEFT, top, *sizes[0]),
        (LEFT, low, *sizes[1]),
        (LEFT, BELOW, wide - room, TIMES),
    )


def _plan_axes(extent: NDArray[np.float64]) -> tuple[int, int]:
    """Return the horizontal and vertical axis of the plan: a long scan lies down."""
    x, y, _ = np.ptp(extent, axis=0)
    return (1, 0) if y > LONG * x else (0, 1)


def _shown(extent: NDArray[np.float64], axes: tuple[int, int]) -> NDArray[np.float64]:
    """Return the limits (2, 2) of a panel [m], widened where it would be too flat or too steep.

    extent: (2, 3).  axes: the horizontal and the vertical one.
    """
    limits = extent[:, axes].T.copy()
    wide, high = np.ptp(limits, axis=1)
    least = np.array([STEEPEST * high, wide / FLATTEST])
    missing = np.maximum(least - (wide, high), 0.0)
    return limits + np.outer(missing, [-0.5, 0.5])


def _verdict_handles(verdict: NDArray[np.uint8]) -> list[Line2D]:
    """Return the legend of the verdicts, with their numbers."""
    return [
        Line2D([], [], marker="o", linestyle="", color=COLOURS[v], label=f"{v.name.lower()} {count:,}")
        for v in Verdict
        if (count := int((verdict == v).sum()))
    ]


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


def _draw_plan(axes: Any, walk: Walk, frames: WalkAnswers, stops: list[int], shown: tuple[int, int]) -> None:
    """Draw the scan from above, and the path coloured by verdict.

    shown: horizontal and vertical axis.
    """
    floor = np.median(walk.poses[:, 2, 3])
    heights = walk.points[:, 2] - floor
    walls = walk.points[(heights > PLAN_LOW) & (heights < PLAN_HIGH)]
    _draw_points(axes, walls, shown, PIXELS // 2)
    at = walk.poses[:, shown, 3]
    for verdict in Verdict:
        chosen = frames.verdict == verdict
        size = 26 if verdict == Verdict.CONTACT else 7
        axes.scatter(*at[chosen].T, s=size, color=COLOURS[verdict], linewidths=0, zorder=3 + int(verdict))
    _number(axes, at[stops], AROUND, frames.verdict[stops])
    axes.set_title("Plan, from shin to head")
    axes.set_xlabel(f"{'xy'[shown[0]]} [m]")
    axes.set_ylabel(f"{'xy'[shown[1]]} [m]")


def _draw_elevation(
    axes: Any, walk: Walk, frames: WalkAnswers, avatar: NDArray[np.float64], stops: list[int]
) -> None:
    """Draw the scan from the side, and the figure in some frames."""
    across = walk.elevation
    _draw_points(axes, walk.points, (across, 2), PIXELS)
    heads = np.empty((len(stops), 2))
    for number, k in enumerate(stops):
        placed = avatar @ walk.poses[k, :3, :3].T + walk.poses[k, :3, 3]
        colour = COLOURS[Verdict(int(frames.verdict[k]))]
        axes.scatter(placed[:, across], placed[:, 2], s=0.8, color=colour, linewidths=0, zorder=4)
        heads[number] = walk.poses[k, across, 3], placed[:, 2].max()
    _number(axes, heads, OVERHEAD, frames.verdict[stops])
    axes.set_title("Elevation with the figure")
    axes.set_xlabel(f"{'xy'[across]} [m]")
    axes.set_ylabel("z [m]")


def _number(
    axes: Any, places: NDArray[np.float64], shifts: Sequence[tuple[float, float]], verdicts: NDArray[np.uint8]
) -> None:
    """Number places from 1, in the colours of their verdicts; no number covers another.

    places: (k, 2), in the panel's units.  shifts: allowed distances of a number from its place
    [points], the preferred first.
    """
    taken: list[NDArray[np.float64]] = []
    frame = axes.get_window_extent()
    scale = axes.figure.dpi / 72
    for number, (place, verdict) in enumerate(zip(places, verdicts, strict=True), 1):
        spot = axes.transData.transform(place)
        free = [
            shift
            for shift in shifts
            if frame.contains(*(spot + np.multiply(shift, scale)))
            and all(np.hypot(*(spot + np.multiply(shift, scale) - other)) > DISC * scale for other in taken)
        ]
        shift = (free or shifts)[0]
        taken.append(spot + np.multiply(shift, scale))
        colour = COLOURS[Verdict(int(verdict))]
        axes.annotate(
            str(number),
            place,
            xytext=shift,
            textcoords="offset points",
            ha="center",
            va="center",
            fontsize=9,
            fontweight="bold",
            color=INK if verdict == Verdict.UNKNOWN else "white",
            bbox={"boxstyle": "circle,pad=0.2", "fc": colour, "ec": "white"},
            zorder=9,
        )


def _draw_points(axes: Any, points: NDArray[np.float64], shown: tuple[int, int], pixels: int) -> None:
    """Draw the points within the limits of the axes as their density on a logarithmic scale.

    shown: horizontal and vertical axis.  pixels: along the longer one.
    """
    limits = np.sort([axes.get_xlim(), axes.get_ylim()])
    pixel = float(np.ptp(limits, axis=1).max()) / pixels
    bins = [max(1, round(float(size) / pixel)) for size in np.ptp(limits, axis=1)]
    counts, *_ = np.histogram2d(points[:, shown[0]], points[:, shown[1]], bins=bins, range=limits)
    image = np.log1p(counts.T)
    axes.imshow(
        image,
        origin="lower",
        extent=limits.ravel(),
        aspect="auto",  # the panel has the shape of its limits
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
        walk.times, trip, color=ROUND_TRIP, linewidth=0.8, label=f"round trip, p50 {np.median(trip):.2f} ms"
    )
    axes.plot(
        walk.times,
        engine,
        color=ENGINE,
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
    axes.set_title("Time of each frame, over zenoh", loc="left")
    axes.set_facecolor(PAPER)
    axes.grid(axis="y", color="#e4ded4", linewidth=0.6)
    # Beside the title: the lines fill the panel.
    axes.legend(
        loc="lower right",
        bbox_to_anchor=(1.0, 0.97),
        ncols=3,
        frameon=False,
        fontsize=9,
        handlelength=1.5,
        columnspacing=1.2,
    )


def _runs(flags: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the first and last index of each run of True."""
    steps = np.diff(np.concatenate([[0], flags.astype(np.int8), [0]]))
    ends = np.flatnonzero(steps == -1) - 1
    return list(zip(np.flatnonzero(steps == 1).tolist(), ends.tolist(), strict=True))
