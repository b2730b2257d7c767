"""Random pushes against walls, corners, creases and thin walls, a centimetre to 50 m at a time, with `sweep`.

Nobody is in contact at the end, nobody is on the other side, no energy appears, and who rests does not move.
"""

from pathlib import Path

import archive_cases
import effect_rooms
import numpy as np
import pytest
from effect_rooms import Play, play
from numpy.typing import NDArray
from solidcloud.schemas.scene.effect_table import AnyEffect, Ground, Slide, Step, Stop, Sweep
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.simulation.world.frame import Body

# Pushes of a test, and of the one that is asked for with -m slow.
PUSHES, MANY = 800, 100_000
REST = 1_000
SIZE = 2.4
# Pushes go so far [m].
LEAST, MOST = 0.01, 50.0


@pytest.fixture(scope="module")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> archive_cases.Case:
    """Two rooms side by side, with a wall of one layer of points between them."""
    return effect_rooms.build(tmp_path_factory.mktemp("rooms"), effect_rooms.room(SIZE, half=True))


def pushes(rng: np.random.Generator, count: int) -> NDArray[np.float64]:
    """Ways (count, 3), of lengths even in their logarithm; a third along axes, into walls, creases and corners."""
    ways = rng.normal(size=(count, 3))
    some = rng.random(count) < 1 / 3
    ways[some] = rng.integers(-1, 2, (int(some.sum()), 3))
    ways[(ways == 0.0).all(axis=1)] = [1.0, 0.0, 0.0]
    length = np.exp(rng.uniform(np.log(LEAST), np.log(MOST), count))
    return ways / np.linalg.norm(ways, axis=1)[:, None] * length[:, None]


def push(game: Play, body: Body, rng: np.random.Generator, count: int, turn: float) -> NDArray[np.float64]:
    """Push a body; returns its poses (count, 4, 4). No energy appears."""
    poses = np.empty((count, 4, 4))
    for number, way in enumerate(pushes(rng, count)):
        before = body.pose[:3, 3].copy()
        angle = rng.uniform(-turn, turn)
        turned = effect_rooms.at(0, 0, 0, angle)[:3, :3] @ body.pose[:3, :3]
        turned = np.linalg.qr(turned)[0] * np.sign(np.diag(np.linalg.qr(turned)[1]))
        moved = game.go(body, way, turned if turn else None)
        gone = body.pose[:3, 3] - before
        assert np.linalg.norm(gone) <= np.linalg.norm(way) * (1 + 1e-9) + 1e-12, (number, way)
        assert gone @ way >= -1e-12, (number, way)
        assert moved.verdict in (Verdict.CLEAR, Verdict.UNKNOWN), (
            number
        )  # a graze may not be told from a touch
        np.testing.assert_array_equal(moved.pose[0], body.pose)
        poses[number] = body.pose
    return poses


def check(game: Play, rooms: archive_cases.Case, body: Body, poses: NDArray[np.float64]) -> None:
    """No pose is in contact, none is in the other room or outside."""
    game.scene.add_avatar("pushed", body.avatar.points, body.avatar.radius)
    assert (game.scene.collide("pushed", poses).verdict == Verdict.CLEAR).all()
    some = poses[:: max(1, len(poses) // 20)]
    assert not rooms.judge(body.avatar.points, body.avatar.radius, some).any()
    assert (poses[:, 0, 3] > 0.0).all() and (np.abs(poses[:, :3, 3]) < SIZE / 2).all()


def in_room(game: Play) -> Body:
    """A body in the room at x > 0."""
    return game.body(effect_rooms.body_box(), effect_rooms.at(SIZE / 4, 0.05, 0.02))


@pytest.mark.parametrize(
    ("effects", "turn"),
    [
        ((Stop(), Sweep()), 0.0),
        ((Stop(), Sweep(), Slide()), 0.0),
        ((Stop(), Sweep(), Slide()), 0.5),
        ((Stop(skin=0.0), Sweep(), Slide()), 0.2),
    ],
)
def test_nobody_is_pushed_into_or_through_a_wall(
    rooms: archive_cases.Case, rng: np.random.Generator, effects: tuple[AnyEffect, ...], turn: float
) -> None:
    with play(rooms.archive, *effects) as game:
        body = in_room(game)
        check(game, rooms, body, push(game, body, rng, PUSHES, turn))


@pytest.mark.slow
def test_nor_by_a_hundred_thousand_pushes(rooms: archive_cases.Case, rng: np.random.Generator) -> None:
    with play(rooms.archive, Stop(), Sweep(), Slide()) as game:
        body = in_room(game)
        check(game, rooms, body, push(game, body, rng, MANY, 0.3))


@pytest.mark.parametrize(
    ("way", "length"),
    [((1, 0, 0), 0.05), ((1, 1, 0), 0.05), ((1, 1, 1), 0.05), ((0.3, 0.9, 0.2), 0.05), ((-1, -1, 1), 3.0)],
)
def test_who_pushes_into_walls_creases_and_corners_does_not_tremble(
    rooms: archive_cases.Case, way: tuple[float, float, float], length: float
) -> None:
    with play(rooms.archive, Stop(), Sweep(), Slide()) as game:
        body = in_room(game)
        wish = np.array(way) / np.linalg.norm(way) * length
        for _ in range(round(2 * SIZE / length) + 20):  # there, and along, into the corner
            game.go(body, wish)
        rests = body.pose.copy()
        for _ in range(REST):
            game.go(body, wish)
            assert np.abs(body.pose[:3, 3] - rests[:3, 3]).max() < 1e-4
        assert not game.touches(body)


@pytest.mark.parametrize("effects", [(), (Slide(), Ground(), Step())])
def test_at_rest_not_a_bit_moves(rooms: archive_cases.Case, effects: tuple[AnyEffect, ...]) -> None:
    with play(rooms.archive, Stop(), Sweep(), *effects) as game:
        body = game.body(effect_rooms.person(), effect_rooms.at(SIZE / 4, 0.05, -SIZE / 2 + 0.2, 0.3))
        for _ in range(30):
            game.go(body, (0.0, 0.0, 0.0))
        rests = body.pose.tobytes()
        for _ in range(REST):
            game.go(body, (0.0, 0.0, 0.0))
            assert body.pose.tobytes() == rests
        assert not game.touches(body)


def test_the_same_wishes_give_the_same_bits_whatever_is_in_memory(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    case = effect_rooms.build(tmp_path, effect_rooms.room(SIZE), voxel=0.5)
    ways = pushes(rng, 400)
    ways *= np.minimum(1.0, 0.2 / np.linalg.norm(ways, axis=1))[:, None]
    walks, budget = [], 1 << 26
    for _ in range(2):
        with play(case.archive, Stop(), Sweep(), Slide(), Ground(), Step(), budget_bytes=budget) as game:
            body, poses = in_room(game), []
            for way in ways:
                game.go(body, way)
                poses.append(body.pose.tobytes())
            walks.append(poses)
            residency = game.scene.residency
            assert (residency.stats.evicted > 0) == (budget < 1 << 26)
            # What one motion reaches fits, and not much more.
            budget = residency.bytes_of(range(len(residency.where))) // 3
    assert walks[0] == walks[1]
