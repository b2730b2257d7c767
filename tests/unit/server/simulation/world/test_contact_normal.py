"""Normals of contacts: of the scan where the body lies on one side of it, of the body at an edge."""

from collections.abc import Iterator
from pathlib import Path

import effect_rooms
import numpy as np
import pytest
from effect_rooms import Play, at, play
from solidcloud.schemas.scene.effect_table import Slide, Stop, Sweep
from solidcloud.server.avatars.avatar_model import AvatarModel, make_avatar
from solidcloud.server.kernels.walk.state import FOLLOW, SLIDE
from solidcloud.server.simulation.world.frame import Frame, Hit, translated

# Radius and spacing of the spheres of scan and body [m], interpreted too: an edge needs dense points.
RADIUS, APART = 0.03, 0.04
# Points within this distance form a surface [m].
REACH = 2.0 * APART + 0.001


@pytest.fixture(scope="module")
def sheet(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Play]:
    """A sheet of points at y = 0, whose free edge is at x = 0."""
    points = effect_rooms.plane((0.0, 0.0, -0.16), (1.2, 0.0, 0.16), APART)
    case = effect_rooms.build(tmp_path_factory.mktemp("sheet"), points, radius=RADIUS)
    with play(case.archive, Stop(), Sweep(), Slide(normal_reach=REACH)) as game:
        yield game


def column(radius: float) -> AvatarModel:
    """An upright cylinder of spheres as dense as the scan."""
    count = round(2 * np.pi * radius / APART)
    angles = 2 * np.pi * np.arange(count) / count
    ring = np.column_stack([radius * np.cos(angles), radius * np.sin(angles)])
    heights = APART * np.arange(-3, 4)
    return make_avatar(np.array([[x, y, z] for z in heights for x, y in ring]), RADIUS)


def hit_of(game: Play, avatar: AvatarModel, x: float, way: tuple[float, float, float]) -> Hit:
    """Return the hit of a motion that begins before the sheet, with its normal."""
    body = game.body(avatar, at(x, -1.4, 0.01))
    frame = Frame(body, translated(body.pose, np.array(way)), 1 / 30, game.world, pose=body.pose)
    with game.world:
        game.world.walker.run(frame, FOLLOW)
        assert len(frame.hits) == 1 and frame.hits[0].normal is None
        game.world.walker.run(frame, SLIDE)
    return frame.hits[0]


@pytest.mark.interpreted
def test_before_a_sheet_it_is_the_normal_of_the_sheet(sheet: Play) -> None:
    hit = hit_of(sheet, column(0.5), 0.6, (0.0, 1.4, 0.0))
    assert hit.normal is not None
    with sheet.world:
        np.testing.assert_array_equal(hit.normal, sheet.world.normal(hit, REACH))
    np.testing.assert_allclose(hit.normal, [0.0, -1.0, 0.0], atol=1e-9)


@pytest.mark.interpreted
@pytest.mark.parametrize("share", [0.6, 0.75, 0.95])
def test_at_a_free_edge_it_is_the_normal_of_the_body(sheet: Play, share: float) -> None:
    """The axis passes beside the edge, at a share of the distance at which both would only graze."""
    hit = hit_of(sheet, column(0.5), -share * (0.5 + 2.0 * RADIUS), (0.0, 1.4, 0.0))
    with sheet.world:
        smoothed = sheet.world.normal(hit, REACH)
    assert smoothed is not None and hit.normal is not None
    assert abs(smoothed[1]) > 0.99, "that of the sheet"
    expected = np.array([-share, -np.sqrt(1.0 - share**2), 0.0])
    assert hit.normal @ expected > np.cos(np.radians(8.0)), hit.normal


@pytest.mark.interpreted
def test_where_nothing_forms_a_surface_it_is_the_direction_of_the_pair(tmp_path: Path) -> None:
    case = effect_rooms.build(tmp_path, np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]), radius=RADIUS)
    with play(case.archive, Stop(), Sweep(), Slide(normal_reach=REACH)) as game:
        hit = hit_of(game, make_avatar([[0.0, 0.0, 0.0]], 0.2), 0.05, (0.0, 1.4, 0.0))
    assert hit.avatar is not None and hit.cloud is not None and hit.normal is not None
    out = hit.avatar - hit.cloud
    np.testing.assert_allclose(hit.normal, out / np.linalg.norm(out), atol=1e-12)
