"""Test avatars that are pushed between a floor and a slope that hangs over it: they come to rest."""

from collections.abc import Iterator

import effect_rooms
import numpy as np
import pytest
from check_doors_cases.door_walls import cylinder
from effect_rooms import Play, at, play
from numpy.typing import NDArray
from solidcloud.schemas.scene.effect_table import AnyEffect, Ground, Slide, Step, Stop, Sweep
from solidcloud.server.avatars.avatar_model import make_avatar

SPACING, SPHERE = 0.02, 0.014
EFFECTS: list[AnyEffect] = [Stop(), Sweep(), Slide(), Step(), Ground()]


def figure() -> NDArray[np.float64]:
    """Return points (n, 3) of feet that reach forward, along y, two legs and a trunk [m]."""
    points = [
        [0.1 * s + x, y, 0.04] for s in (-1, 1) for x in (-0.03, 0.03) for y in np.arange(-0.08, 0.2, 0.04)
    ]
    points += [[0.1 * s, -0.06, z] for s in (-1, 1) for z in np.arange(0.08, 0.8, 0.05)]
    return np.concatenate([points, cylinder(0.2, 0.7, 0.04, 0.06) + np.array([0.0, -0.06, 0.8])])


AVATARS = {
    "figure": make_avatar(figure(), 0.04),
    "cylinder": make_avatar(cylinder(0.25, 0.8, 0.02, 0.03), 0.02),
}


def wedge(degrees: float, noise: float) -> NDArray[np.float64]:
    """Return points (n, 3) of a floor and of a sheet that rises over it, towards negative y."""
    floor = effect_rooms.plane((-0.8, -1.4, 0.0), (0.8, 0.3, 0.0), SPACING)
    sheet = effect_rooms.plane((-0.8, 0.0, 0.0), (0.8, 1.6, 0.0), SPACING)
    way, angle = sheet[:, 1], np.radians(degrees)
    sheet = np.column_stack([sheet[:, 0], 0.3 - way * np.cos(angle), way * np.sin(angle)])
    points = np.concatenate([floor, sheet])
    return points + np.random.default_rng(2).normal(scale=noise, size=points.shape) if noise else points


@pytest.fixture(scope="module", params=[(36, 0.0), (60, 0.002)], ids=str)
def game(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Play]:
    case = effect_rooms.build(tmp_path_factory.mktemp("wedge"), wedge(*request.param), radius=SPHERE)
    with play(case.archive, *EFFECTS) as game:
        yield game


@pytest.mark.parametrize("name", sorted(AVATARS))
def test_an_avatar_pushed_into_a_wedge_comes_to_rest(game: Play, name: str) -> None:
    """Under a sheet of 36 degrees the figure rose and sank by 22 mm in turn, and moved aside."""
    x, height = 0.05, 0.15
    body = game.body(AVATARS[name], at(x, -1.5, height + SPHERE))
    while not game.touches(body) and body.pose[1, 3] < 0.0:
        body.pose[1, 3] += 0.01
    body.pose[1, 3] -= 0.012
    places = []
    for _ in range(120):
        game.go(body, (0.0, 1 / 30, 0.0))
        places.append(body.pose[:3, 3].copy())
    settled = np.array(places[20:])
    assert np.abs(np.diff(settled, axis=0)).max() < 1e-4
    assert abs(settled[-1, 0] - x) < 0.01
    assert not game.touches(body)
