"""`slide`: along walls, creases and around corners, never with more than was wished."""

from pathlib import Path

import archive_cases
import effect_rooms
import numpy as np
import pytest
import trimesh
from effect_rooms import INTERPRETED, RADIUS, at, play
from solidcloud.schemas.scene.effect_table import Slide, Stop, Sweep
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.avatars.avatar_model import make_avatar
from solidcloud.server.avatars.avatar_shape import avatar_shape
from solidcloud.server.kernels.walk.motions import clip as clip_rest

BALL = make_avatar([[0.0, 0, 0]], 0.2)
TOUCH = RADIUS + 0.2
FRAMES = 20 if not INTERPRETED else 8
X, Y, Z = np.eye(3)


@pytest.fixture(scope="module")
def wall(tmp_path_factory: pytest.TempPathFactory) -> archive_cases.Case:
    """A wall at x = 0."""
    return effect_rooms.build(
        tmp_path_factory.mktemp("wall"), effect_rooms.plane((0, -1.4, -0.8), (0, 1.4, 0.8))
    )


@pytest.fixture(scope="module")
def corner(tmp_path_factory: pytest.TempPathFactory) -> archive_cases.Case:
    """Walls at x = 0 and y = 0 and a floor at z = 0, open to negative x and y and to positive z."""
    sides = [
        effect_rooms.plane((0, -1.6, 0), (0, 0, 1.6)),
        effect_rooms.plane((-1.6, 0, 0), (0, 0, 1.6)),
        effect_rooms.plane((-1.6, -1.6, 0), (0, 0, 0)),
    ]
    return effect_rooms.build(
        tmp_path_factory.mktemp("corner"), np.unique(np.round(np.concatenate(sides), 6), axis=0)
    )


@pytest.mark.interpreted
def test_a_wall_is_gone_along_by_the_part_of_the_wish_that_is_along_it(wall: archive_cases.Case) -> None:
    with play(wall.archive, Stop(), Sweep(), Slide()) as game:
        body = game.body(BALL, at(-TOUCH - 0.2, -0.9, 0))
        for _ in range(FRAMES):
            moved = game.go(body, (0.05, 0.08, 0))
            assert moved.verdict == Verdict.CLEAR and body.pose[0, 3] < -0.8 * TOUCH
            assert not game.touches(body)
        gone = body.pose[1, 3] + 0.9
        # Bumps and skin take something of it.
        assert 0.8 * 0.08 * FRAMES < gone <= 0.08 * FRAMES + 1e-9
        assert next(touched.normal for touched in moved.touched) == pytest.approx((-1, 0, 0), abs=0.02)
        assert moved.left == pytest.approx(0.05, abs=0.02)


@pytest.mark.interpreted
def test_head_on_it_stays(wall: archive_cases.Case) -> None:
    with play(wall.archive, Stop(), Sweep(), Slide()) as game:
        body = game.body(BALL, at(-1.0, 0.03, 0.02))
        game.go(body, (1.0, 0.005, 0))
        before = body.pose.copy()
        for _ in range(FRAMES):
            game.go(body, (0.5, 0.005, 0))
        assert np.abs(body.pose - before)[:3, 3].max() < 1e-4 and abs(before[1, 3] - 0.03) < 0.02


@pytest.mark.interpreted
def test_two_walls_are_gone_along_by_their_crease_and_three_stop(corner: archive_cases.Case) -> None:
    with play(corner.archive, Stop(), Sweep(), Slide()) as game:
        body = game.body(BALL, at(-0.5, -0.5, 1.0))
        for _ in range(FRAMES if INTERPRETED else 3 * FRAMES):
            game.go(body, (0.06, 0.06, -0.05))
            assert not game.touches(body)
        low = TOUCH * 0.9
        assert (np.array([-0.5, -0.5, 1.0]) != body.pose[:3, 3]).all()
        if not INTERPRETED:
            assert (np.abs(body.pose[:3, 3]) < TOUCH + 0.05).all() and (np.abs(body.pose[:3, 3]) > low).all()
        before = body.pose.copy()
        for _ in range(FRAMES):
            game.go(body, (0.06, 0.06, -0.05))
        assert INTERPRETED or np.abs(body.pose - before).max() < 1e-4


@pytest.mark.interpreted
def test_who_turns_into_a_wall_goes_as_far_as_it_can_and_turns_on_the_spot_where_it_may(
    wall: archive_cases.Case,
) -> None:
    rod = make_avatar([[x, 0.0, 0.0] for x in np.linspace(-0.5, 0.5, 9)], 0.08)
    with play(wall.archive, Stop(), Sweep(), Slide()) as game:
        body = game.body(rod, at(-0.3, 0, 0, np.pi / 2))
        moved = game.go(body, (0, 0, 0), at(0, 0, 0, 0.0)[:3, :3])
        angle = np.arctan2(body.pose[1, 0], body.pose[0, 0])
        assert 0.3 < angle < 1.5, "it is 1 m long, and 30 cm away"
        assert not game.touches(body) and moved.touched
        np.testing.assert_array_equal(body.pose[:3, 3], [-0.3, 0, 0])
        body = game.body(rod, at(-0.8, 0, 0, np.pi / 2))
        wish = at(0, 0, 0, np.pi / 2 - 0.4)[:3, :3]
        game.go(body, (0.9, 0.1, 0), wish)
        assert not game.touches(body) and body.pose[0, 3] < -0.1


@pytest.mark.interpreted
def test_it_goes_over_the_bumps_of_a_wall(wall: archive_cases.Case, rng: np.random.Generator) -> None:
    small = make_avatar([[0.0, 0, 0]], 0.04)  # it feels every sphere
    with play(wall.archive, Stop(skin=0.0005), Sweep(), Slide()) as game:
        for _ in range(1 if INTERPRETED else 3):
            start = rng.uniform(-0.3, 0.0)
            body = game.body(small, at(-RADIUS - 0.06, start, rng.uniform(-0.3, 0.3)))
            for _ in range(FRAMES):
                game.go(body, (0.01, 0.04, 0.003))
                assert not game.touches(body)
            assert body.pose[1, 3] - start > 0.5 * 0.04 * FRAMES


def clip(left: np.ndarray, planes: list[np.ndarray]) -> np.ndarray | None:
    """Return the clipped displacement (3,); None if there is none."""
    found, way = clip_rest(tuple(left.tolist()), np.array(planes, np.float64).reshape(-1, 3), len(planes))
    return np.array(way) if found else None


@pytest.mark.interpreted
@pytest.mark.parametrize(
    ("left", "planes", "found"),
    [
        ([1, 0, 0], [], [1, 0, 0]),
        ([1, 1, 0], [-X], [0, 1, 0]),
        ([1, 1, 0], [X], [1, 1, 0]),
        ([1, 1, 1], [-X, -Y], [0, 0, 1]),
        ([1, 1, 0], [-X, -Y], None),
        ([1, 2, 3], [-X, -Y, -Z], None),
        ([1, 0, 0], [-X], [0, 0, 0]),
        ([2, 1, 0], [-X, np.array([-0.6, -0.8, 0])], None),
        ([1, 0, 0], [-Y, np.array([-1, -1, 0]) / np.sqrt(2)], [0.5, -0.5, 0]),
    ],
)
def test_a_way_is_clipped_as_little_as_may_be(
    left: list[float], planes: list[np.ndarray], found: list[float] | None
) -> None:
    way = clip(np.array(left, np.float64), planes)
    if found is None:
        assert way is None or np.abs(way).max() == 0
    else:
        assert way is not None
        np.testing.assert_allclose(way, found, atol=1e-12)


@pytest.mark.interpreted
def test_clipped_ways_are_free_never_longer_and_never_against_the_wish(rng: np.random.Generator) -> None:
    for _ in range(200):
        left = rng.normal(size=3)
        planes = [plane / np.linalg.norm(plane) for plane in rng.normal(size=(rng.integers(1, 5), 3))]
        way = clip(left, planes)
        if way is not None:
            assert np.linalg.norm(way) <= np.linalg.norm(left) * (1 + 1e-12)
            assert way @ left >= -1e-12 and all(way @ plane >= -1e-8 for plane in planes)


def test_a_filled_mesh_passes_a_free_edge_as_a_hollow_one_does_issue_35(tmp_path: Path) -> None:
    """The jamb of a wall of one sheet: there the normal is that of the body's surface."""
    jamb = effect_rooms.build(tmp_path, effect_rooms.plane((0, -1.4, -0.8), (0, 0, 0.8)))
    column, ends = trimesh.creation.cylinder(0.25, 0.6), []
    for hollow in (False, True):
        shape = avatar_shape(column, 0.03, hollow=hollow)
        with play(jamb.archive, Stop(), Sweep(), Slide()) as game:
            body = game.body(make_avatar(*shape[:3]), at(-0.5, 0.1, 0))
            normals = []
            for _ in range(60):
                moved = game.go(body, (0.03, 0.0, 0))
                normals += [touched.normal for touched in moved.touched[:1] if touched.normal is not None]
                assert not game.touches(body)
        ends.append(body.pose[:3, 3])
        assert body.pose[0, 3] > 0.3, "around the edge"
        assert normals and all(np.dot(normal, (0.0, 0.0, 1.0)) < 0.2 for normal in normals)
    assert ends[0] == pytest.approx(ends[1], abs=0.02)
