"""Figure 7 of [Fig12]: frame rate along the path per degree, with and without a collision test."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.sphere_pictures import load_pyplot

FRAME_RATE = 30.0
SMOOTH_SECONDS = 0.5


class Curve(NamedTuple):
    """Times of one degree. seconds: (k,), of each frame's collision test [s]."""

    degree: int
    seconds: NDArray[np.float64]


def rolling_median(values: NDArray[np.float64], width: int) -> NDArray[np.float64]:
    """Return the medians (k,) over an odd number of neighbours, with the end values repeated.

    Unsmoothed frames would hide the differences between degrees.
    """
    padded = np.pad(values, width // 2, mode="edge")
    median: NDArray[np.float64] = np.median(np.lib.stride_tricks.sliding_window_view(padded, width), axis=1)
    return median


def contact_spans(times: NDArray[np.float64], contact: NDArray[np.bool_]) -> list[tuple[float, float]]:
    """Return the time intervals [s] in which every frame is in contact."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], contact, [False]]).astype(np.int8)))
    return [(float(times[a]), float(times[b - 1])) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def draw_path(
    times: NDArray[np.float64],
    curves: dict[str, list[Curve]],
    without: NDArray[np.float64],
    contact: NDArray[np.bool_],
    paper_fps: dict[int, float],
    target: Path,
) -> None:
    """Write the figure as PNG.

    It shows the loop of 30 frames per second, and one panel of test times per kind of node.
    times: (k,) [s].  curves: kind -> one curve per degree.  without: (k,) [s], without a collision
    test.
    contact: (k,) bool.  paper_fps: degree -> mean frames per second in the paper's table 1.
    """
    pyplot = load_pyplot()
    figure, axes = pyplot.subplots(
        1 + len(curves), 1, figsize=(12, 3 + 3.6 * len(curves)), dpi=120, sharex=True, layout="constrained",
        height_ratios=[0.75] + [1.0] * len(curves),
    )  # fmt: skip
    step = float(np.median(np.diff(times))) if len(times) > 1 else 1.0
    width = (min(int(SMOOTH_SECONDS / step) | 1, len(times)) - 1) | 1
    _draw_loop(axes[0], times, next(iter(curves.values())), paper_fps)
    everything = [c.seconds for group in curves.values() for c in group] + [without]
    low, high = min(float(np.min(s)) for s in everything), max(float(np.max(s)) for s in everything)
    for panel, (kind, group) in zip(axes[1:], curves.items(), strict=True):
        for k, curve in enumerate(group):
            colour = pyplot.get_cmap("viridis")(k / max(len(group) - 1, 1) * 0.95)
            panel.plot(
                times,
                rolling_median(curve.seconds, width) * 1e3,
                color=colour,
                lw=1.3,
                label=f"{curve.degree}",
            )
        panel.plot(times, rolling_median(without, width) * 1e3, "k--", lw=1.2, label="no test")
        for i, (a, b) in enumerate(contact_spans(times, contact)):
            panel.axvspan(a, b + step, color="tab:red", alpha=0.12, lw=0, label=None if i else "contact")
        panel.set(yscale="log", ylim=(low * 1e3 / 1.3, high * 1e3 * 1.3), ylabel="test time per frame [ms]")
        panel.set_title(
            f"{kind}: one call per frame, rolling median over {SMOOTH_SECONDS:g} s", fontsize=11, loc="left"
        )
        panel.yaxis.set_major_formatter("{x:g}")
        panel.grid(alpha=0.25, which="both")
        right = panel.secondary_yaxis("right", functions=(_inverse, _inverse))
        right.yaxis.set_major_formatter("{x:,.0f}")
        right.set_ylabel("possible frames per second")
    figure.legend(*axes[1].get_legend_handles_labels(), title="degree", fontsize=9, loc="outside right upper")
    axes[-1].set(xlabel="time along the path [s]", xlim=(times[0], times[-1]))
    figure.savefig(target)
    pyplot.close(figure)


def _inverse(milliseconds: Any) -> Any:
    """Convert milliseconds per frame to frames per second, or back."""
    return 1e3 / np.maximum(milliseconds, 1e-12)


def _draw_loop(
    panel: Any, times: NDArray[np.float64], group: list[Curve], paper_fps: dict[int, float]
) -> None:
    """Draw the paper's synchronised loop: a frame takes 1/30 s, or its test if that is longer."""
    for curve in group:
        panel.plot(times, 1 / np.maximum(curve.seconds, 1 / FRAME_RATE), color="tab:green", lw=1.5)
    panel.plot([], [], color="tab:green", label="solidcloud, every degree (without rendering)")
    panel.plot(times[[0, -1]], [FRAME_RATE] * 2, "k--", lw=1.2, label="no test")
    paper = [paper_fps[c.degree] for c in group if c.degree in paper_fps]
    if paper:
        panel.axhspan(
            min(paper), max(paper), color="tab:orange", alpha=0.3, lw=0, label="means of [Fig12], table 1"
        )
    panel.set(ylim=(0, 1.15 * FRAME_RATE), ylabel="frames per second")
    panel.set_title("in a loop of 30 frames per second", fontsize=11, loc="left")
    panel.grid(alpha=0.25)
    panel.legend(fontsize=9, loc="lower right", ncols=3)
