"""Test the paper's scenarios ([Fig12] section 3) on the generated façade, over zenoh.

A user sends motion commands and receives poses. No pose may be in contact, which an exact query
checks afterwards.
"""

from collections.abc import Iterator
from pathlib import Path

import facade_scene
import numpy as np
import pytest
from facade_scene import Served, cylinder, standing
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.pipeline import build_archive
from solidcloud.builder.synthetic.figure import figure_points
from solidcloud.builder.synthetic.sheet import make_sheet
from solidcloud.builder.synthetic.truth import FacadeTruth
from solidcloud.schemas.wire.answers import Verdict

POINTS = 300_000
# Height at which feet are held above the ground (schemas/scene/effect_table.py,
# `Ground.clearance`).
FEET = 0.03
# Distance from a true surface at which a body may stop: the scan's noise and half its spacing, with
# the spheres of both.
NEAR = 0.08


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, FacadeTruth]:
    """Build the façade's archive; return it with its ground truth."""
    return facade_scene.build_facade_archive(tmp_path_factory.mktemp("facade"), POINTS)


@pytest.fixture(scope="module")
def served(made: tuple[Path, FacadeTruth], tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """Serve the façade with all effects for walking, and the figure as `body`."""
    text = facade_scene.scene_text(made[0])
    with facade_scene.serving_scene(tmp_path_factory.mktemp("scene"), text) as served:
        served.client.add_avatar("body", figure_points())
        yield served


def test_through_the_open_door_without_contact(served: Served, made: tuple[Path, FacadeTruth]) -> None:
    """Walk from the landing through the middle of the door into the nave."""
    door = made[1].door("main")
    start, end = standing(0.0, -1.2, door.sill + FEET), standing(0.0, 2.6, door.sill + FEET)
    with served.walking("body", start) as walker:
        last = walker.to(start, end)
    assert not any(state.touched for state in walker.states)
    assert np.allclose(last.pose[0, :2, 3], [0.0, 2.6], atol=1e-9)
    served.assert_clear("body", walker)


def test_alongside_the_wall_sliding_and_never_into_it(served: Served, made: tuple[Path, FacadeTruth]) -> None:
    """Walk into the cloister's wall at 20 degrees: the body slides six metres along it."""
    wall = made[1].wall("cloister")
    angle = np.radians(20.0)
    half = np.ptp(figure_points()[:, 0]) / 2
    with served.walking("body", standing(wall.offset + half + 0.4, -14.0, FEET)) as walker:
        walker.go((-1.5 * np.sin(angle), 1.5 * np.cos(angle), 0.0), 5.0)
    along = 5.0 * 1.5 * np.cos(angle)
    places = walker.places
    assert places[-1, 1] - places[0, 1] > 0.9 * along
    side = places[:, 0] - half - wall.offset
    assert side.min() > -0.02 and side[-1] < NEAR
    assert sum(bool(state.touched) for state in walker.states) > 60
    served.assert_clear("body", walker)


def test_stopped_at_the_wall_head_on(served: Served, made: tuple[Path, FacadeTruth]) -> None:
    """Walk straight at the wall for three seconds: the body reaches it and stays there."""
    wall = made[1].wall("cloister")
    with served.walking("body", standing(wall.offset + 1.5, -10.0, FEET, np.pi / 2)) as walker:
        walker.go((-1.5, 0.0, 0.0), 3.0)
        there = walker.places[-1]
        walker.go((-1.5, 0.0, 0.0), 1.0)
    ahead = figure_points()[:, 1].max()
    assert -0.02 < there[0] - ahead - wall.offset < NEAR
    assert np.abs(walker.places[-30:, 0] - there[0]).max() < 1e-3
    assert walker.states[-1].touched
    served.assert_clear("body", walker)


def test_up_the_steps_of_the_portal_and_down_again(served: Served, made: tuple[Path, FacadeTruth]) -> None:
    """Walk up three risers of 15 cm to the sill and back at walking pace."""
    sill = made[1].door("main").sill
    foot, top = standing(0.0, -4.0, FEET), standing(0.0, -0.7, sill + FEET)
    with served.walking("body", foot) as walker:
        up = walker.to(foot, top)
        assert abs(up.pose[0, 2, 3] - sill - FEET) < 0.03
        assert up.pose[0, 1, 3] > -0.75
        assert any(state.stepped > 0 for state in walker.states)
        down = walker.to(top, foot)
    assert abs(down.pose[0, 2, 3] - FEET) < 0.03
    assert down.pose[0, 1, 3] < -3.95
    # The body descended without falling: it was on the ground all the way.
    assert [number for number, state in enumerate(walker.states) if not state.ground.on_ground] == []
    served.assert_clear("body", walker)


def test_around_a_column(served: Served, made: tuple[Path, FacadeTruth]) -> None:
    """Walk straight at the forecourt's column, beside its middle: the body passes on that side."""
    column = made[1].column("forecourt left")
    half = np.ptp(figure_points()[:, 0]) / 2
    start = standing(column.x + 0.4, column.y - column.radius - 1.2, FEET)
    with served.walking("body", start) as walker:
        walker.go((0.0, 1.5, 0.0), 5.0)
    places = walker.places[:, :2] - [column.x, column.y]
    assert places[-1, 1] > column.radius + half
    assert np.hypot(*places.T).min() > column.radius + 0.05
    assert (places[:, 0] > 0).all()
    served.assert_clear("body", walker)


@pytest.mark.parametrize(("model", "passes"), [("border:3", True), ("mean:3", False)])
def test_tight_door_is_passed_with_border_radii_and_reported_with_mean(
    model: str, passes: bool, tmp_path: Path
) -> None:
    """Walk through a 60 cm door in a thin wall with a body of 55 cm: the spheres of the rim decide.

    In a thick wall the jambs are planes, and no radius model makes their spheres smaller.
    """
    sheet = make_sheet(tmp_path / "sheet.ply", spacing=0.05, door=0.60)
    build_archive([sheet.path], tmp_path / "sheet", BuildConfig(jobs=1, models=frozenset({"mean", "border"})))
    text = facade_scene.scene_text(tmp_path / "sheet", ("stop", "sweep"), radius_model=f'"{model}"')
    start, end = standing(0.0, -1.0, 0.3), standing(0.0, 1.0, 0.3)
    with facade_scene.serving_scene(tmp_path, text) as served:
        served.client.add_avatar("body", cylinder(0.55), 0.02)
        with served.walking("body", start) as walker:
            last = walker.to(start, end)
        served.assert_clear("body", walker, radius_model=model)
    if passes:
        assert last.pose[0, 1, 3] == 1.0 and not any(state.touched for state in walker.states)
    else:
        # A round body enters as far as it is narrower than the remaining width of the door.
        assert -0.2 < last.pose[0, 1, 3] < 0.0
        place = np.array(last.touched[0].place)
        assert abs(abs(place[0]) - 0.30) < 0.06 and abs(place[1]) < 0.01
    assert last.verdict == Verdict.CLEAR
