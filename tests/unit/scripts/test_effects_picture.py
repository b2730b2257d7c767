"""Test the picture of scripts/bench_effects: every effect legible in colour and in grey."""

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from bench_effects_cases import effects_picture
from picture_checks import (
    LEAST_STEP,
    alike_in_grey,
    covered,
    drawn_figures,
    faint_neighbours,
    overlaps,
    share_of_figure,
)
from solidcloud.schemas.scene.effect_table import ORDER
from solidcloud.server.report.common.bench_results import Part

SHOWN = list(effects_picture.COLOURS)


def test_every_effect_of_a_frame_has_a_colour_of_its_own() -> None:
    assert tuple(SHOWN) == ORDER, "in the order in which they run, as they are stacked"
    assert len(set(effects_picture.COLOURS.values())) == len(SHOWN)


def test_all_colours_differ_in_grey_and_neighbours_most() -> None:
    colours = list(effects_picture.COLOURS.values())
    assert [pair for pair in combinations(colours, 2) if faint_neighbours(list(pair), LEAST_STEP)] == []
    assert faint_neighbours(colours, 23.0) == []


@pytest.mark.parametrize("objects, goals", [(0.0, True), (1e-5, True), (0.0, False)])
def test_picture_is_legible_and_full(objects: float, goals: bool, tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    company = {name: rng.exponential(5e-5, 1200) for name in SHOWN}
    company["objects"] = np.full(1200, objects)
    company["contacts"][270:290] = 1e-3  # a peak under the legend
    part = Part("effects")
    for name in SHOWN:
        part.add("an effect", name, "alone", float(rng.uniform(0.1, 500)), "µs")
        part.add("an effect", name, "in company", float(rng.uniform(0.1, 80)), "µs")
    part.goal("walking", "stop, sweep, slide, step, ground: mean frame", 147.0, 100.0, "us")
    with drawn_figures() as figures:
        effects_picture.draw(
            [part] if goals else [], {}, company, 100.0, "a machine", tmp_path / "effects.png"
        )
    (figure,) = figures
    assert alike_in_grey(figure) == []
    assert overlaps(figure) == []
    assert covered(figure) == []
    assert share_of_figure(figure) > 0.85
