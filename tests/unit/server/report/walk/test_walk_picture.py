"""Test the picture of a walk: legible in grey, nothing covered, and filled by scans of any shape."""

from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from picture_checks import alike_in_grey, covered, drawn_figures, faint_neighbours, overlaps, share_of_figure
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.report.walk.walk_answers import Walk, WalkAnswers
from solidcloud.server.report.walk.walk_picture import COLOURS, ENGINE, ROUND_TRIP, arrange, draw_walk

FRAMES = 300
# Widths [m] along x, y and z.
SHAPES = {
    "façade": (18.0, 28.0, 15.0),
    "wide": (80.0, 9.0, 5.0),
    "long": (4.0, 60.0, 3.0),
    "tower": (6.0, 6.0, 60.0),
    "field": (90.0, 80.0, 2.0),
    "room": (5.0, 5.0, 3.0),
}


def drawn(size: tuple[float, float, float], out: Path) -> Figure:
    """Return the picture of a walk along the longer side of a box of points, with all verdicts."""
    rng = np.random.default_rng(5)
    points = rng.uniform(0, 1, (20_000, 3)) * size
    along = int(size[1] > size[0])
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    poses[:, :2, 3] = np.array(size[:2]) / 2
    poses[:, along, 3] = np.linspace(0.05, 0.95, FRAMES) * size[along]
    verdict = np.zeros(FRAMES, np.uint8)
    verdict[40:70], verdict[150:155], verdict[200:230] = 1, 1, 2
    times = np.exp(rng.normal(-9, 0.5, FRAMES))
    none = np.zeros(FRAMES, np.int64)
    answers = WalkAnswers(verdict, times, 6 * times, none, none, none, (np.arange(FRAMES) % 90 == 3) * 1)
    avatar = rng.uniform((-0.3, -0.2, 0), (0.3, 0.2, 1.75), (500, 3))
    walk = Walk(np.arange(FRAMES) / 30, poses, "across", points, along)
    with drawn_figures() as figures:
        draw_walk(out / "walk.png", walk, answers, avatar)
    (figure,) = figures
    return figure


@pytest.mark.parametrize("shape", SHAPES)
def test_picture_is_legible_and_full(shape: str, tmp_path: Path) -> None:
    figure = drawn(SHAPES[shape], tmp_path)
    assert overlaps(figure) == []
    assert covered(figure) == []
    assert alike_in_grey(figure) == []
    assert share_of_figure(figure) > 0.7


@pytest.mark.parametrize("shape", SHAPES)
def test_plan_and_elevation_have_one_scale_in_both_directions(shape: str, tmp_path: Path) -> None:
    for axes in drawn(SHAPES[shape], tmp_path).axes[:2]:
        box, (x0, x1), (y0, y1) = axes.get_window_extent(), axes.get_xlim(), axes.get_ylim()
        assert box.width / (x1 - x0) == pytest.approx(box.height / abs(y1 - y0), rel=0.01)


def test_a_long_scan_lies_down_and_is_not_mirrored(tmp_path: Path) -> None:
    plan = drawn(SHAPES["long"], tmp_path).axes[0]
    assert plan.get_xlabel() == "y [m]" and plan.yaxis_inverted() and not plan.xaxis_inverted()
    plan = drawn(SHAPES["wide"], tmp_path).axes[0]
    assert plan.get_xlabel() == "x [m]" and not plan.yaxis_inverted()


@pytest.mark.parametrize("plan, elevation", [(0.7, 1.2), (9.0, 14.0), (1.0, 0.35), (14.0, 14.0), (1.0, 1.0)])
def test_layout_keeps_panels_apart_and_inside(plan: float, elevation: float) -> None:
    layout = arrange(plan, elevation)
    panels = (layout.plan, layout.elevation, layout.times)
    for x, y, wide, high in panels:
        assert x >= 0.7 and y >= 0.5 and high >= 0.7
        assert x + wide <= layout.size[0] and y + high + 0.4 <= layout.size[1]
    for one in range(3):
        for x, y, wide, high in panels[one + 1 :]:
            x2, y2, wide2, high2 = panels[one]
            assert x >= x2 + wide2 or x2 >= x + wide or y >= y2 + high2 + 0.9 or y2 >= y + high + 0.9


def test_colours_shown_together_differ_in_grey() -> None:
    verdicts = sorted(COLOURS[verdict] for verdict in Verdict)
    for one in range(3):
        assert faint_neighbours([verdicts[one - 1], verdicts[one]], 18.0) == []
    assert faint_neighbours([ROUND_TRIP, ENGINE], 30.0) == []
