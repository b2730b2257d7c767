"""Test pushes at a flat wall that are nearly head on: the avatar slides; head on, it stays."""

from collections.abc import Iterator

import effect_rooms
import numpy as np
import pytest
from effect_rooms import Play, at, play
from solidcloud.schemas.scene.effect_table import Slide, Stop, Sweep
from solidcloud.server.avatars.avatar_model import AvatarModel, make_avatar

BALL = make_avatar([[0.0, 0, 0]], 0.2)
# Spacing of the wall's points and their noise [m].
SPACINGS = [(0.01, 0.002), (0.04, 0.0)]
STEP, SETTLING, FRAMES, STILL_FRAMES = 1 / 30, 10, 45, 120


@pytest.fixture(scope="module", params=SPACINGS, ids=["noise of 2 mm", "coarse"])
def wall(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Play]:
    """A wall at x = 0."""
    apart, noise = request.param
    points = effect_rooms.plane((0, -1.4, -0.6), (0, 1.4, 0.6), apart)
    if noise:
        points = points + np.random.default_rng(3).normal(scale=noise, size=points.shape)
    radius = 0.03 if apart > 0.02 else 0.006
    case = effect_rooms.build(tmp_path_factory.mktemp("wall"), points, radius=radius)
    with play(case.archive, Stop(), Sweep(), Slide()) as game:
        yield game


def pushed(game: Play, avatar: AvatarModel, start: float, degrees: float, frames: int) -> np.ndarray:
    """Push an avatar from y = start at an angle from head on. Return its positions (frames, 3)."""
    body, angle = game.body(avatar, at(-0.3, start, 0.01)), np.radians(degrees)
    places = []
    for _ in range(frames):
        game.go(body, STEP * np.array([np.cos(angle), np.sin(angle), 0.0]))
        places.append(body.pose[:3, 3].copy())
    assert not game.touches(body)
    return np.array(places)


@pytest.mark.parametrize("degrees", [2.0, 5.9, -2.5])
def test_nearly_head_on_the_avatar_slides_by_the_tangential_part(wall: Play, degrees: float) -> None:
    for start in (-0.61, 0.117):
        y = pushed(wall, BALL, start, degrees, FRAMES)[SETTLING:, 1]
        share = (y[-1] - y[0]) / ((len(y) - 1) * STEP * np.sin(np.radians(degrees)))
        assert 0.9 < share < 1.1, (start, share)


def test_head_on_the_avatar_does_not_creep(wall: Play) -> None:
    for start in (-0.61, 0.117):
        places = pushed(wall, BALL, start, 0.0, STILL_FRAMES)
        assert np.abs(places[:, 1] - start).max() < 1e-3, start
        assert np.abs(np.diff(places[-60:], axis=0)).max() == 0.0
