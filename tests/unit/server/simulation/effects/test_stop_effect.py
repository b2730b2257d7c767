"""`stop` and `sweep`: what is touched blocks, how near one stays, how one gets free, what is not known."""

import copy
from pathlib import Path
from types import SimpleNamespace

import archive_cases
import effect_rooms
import numpy as np
import pytest
from effect_frames import flip_a_byte
from effect_rooms import APART, RADIUS, Play, at, play
from numpy.typing import NDArray
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.errors import BadRequestError
from solidcloud.schemas.scene.effect_table import Slide, Stop, Sweep
from solidcloud.schemas.scene.scene_file import SceneLimits
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.schemas.wire.encoding import encode
from solidcloud.server.avatars.avatar_model import make_avatar
from solidcloud.server.simulation.effects import motion_effects
from solidcloud.server.simulation.simulation import make_pipeline
from solidcloud.server.simulation.world.collision_world import World

BALL = make_avatar([[0.0, 0, 0]], 0.2)
TOUCH = RADIUS + 0.2  # from a scan point's centre


@pytest.fixture(scope="module")
def wall(tmp_path_factory: pytest.TempPathFactory) -> archive_cases.Case:
    """A wall of one layer at x = 0, a metre to each side."""
    return effect_rooms.build(tmp_path_factory.mktemp("wall"), effect_rooms.plane((0, -1, -1), (0, 1, 1)))


@pytest.mark.interpreted
def test_alone_it_is_there_or_stays(wall: archive_cases.Case) -> None:
    with play(wall.archive, Stop()) as game:
        body = game.body(BALL, at(-1, 0, 0))
        assert game.go(body, (0.5, 0, 0)).pose[0, 0, 3] == -0.5
        moved = game.go(body, (0.4, 0, 0))
        assert body.pose[0, 3] == -0.5 and moved.verdict == Verdict.CLEAR
        assert moved.left == pytest.approx(0.4) and moved.touched[0].place == pytest.approx(
            (0, 0, 0), abs=1e-3
        )
        game.go(body, (1.0, 0, 0))
        assert body.pose[0, 3] == 0.5, "without `sweep` nothing is asked of the way"


@pytest.mark.interpreted
@pytest.mark.parametrize("skin", [0.0, 0.05])
@pytest.mark.parametrize("way", [0.8, 50.0])
def test_a_motion_ends_a_skin_before_what_it_meets(wall: archive_cases.Case, skin: float, way: float) -> None:
    with play(wall.archive, Stop(skin=skin), Sweep()) as game:
        body = game.body(BALL, at(-1, 0, 0))
        moved = game.go(body, (way, 0, 0))
        assert body.pose[0, 3] == pytest.approx(-TOUCH - skin, abs=3e-5)
        assert not game.touches(body) and moved.verdict == Verdict.CLEAR
        assert moved.left == pytest.approx(way - 1 + TOUCH + skin, abs=3e-5)
        assert [touched.what for touched in moved.touched] == [""] and not moved.touched[0].unknown
        before = body.pose.tobytes()
        game.go(body, (way, 0, 0))
        assert body.pose.tobytes() == before


@pytest.mark.interpreted
def test_far_from_the_origin_nobody_ends_in_contact(tmp_path: Path, rng: np.random.Generator) -> None:
    far = np.array([5e5, 5.6e6, 300.0])
    case = effect_rooms.build(tmp_path, effect_rooms.plane((0, -0.6, -0.6), (0, 0.6, 0.6)) + far)
    with play(case.archive, Stop(skin=0.0), Sweep(), Slide()) as game:
        for _ in range(10):
            start = far + np.array([-1, *rng.uniform(-0.4, 0.4, 2)])
            body = game.body(BALL, at(*start))
            game.go(body, (2.0, *rng.uniform(-0.5, 0.5, 2)))
            assert not game.touches(body) and body.pose[0, 3] < far[0]


@pytest.mark.interpreted
@pytest.mark.parametrize("effects", [(Stop(),), (Stop(), Sweep())])
def test_who_is_put_into_a_wall_gets_out_by_the_shortest_way(
    wall: archive_cases.Case, effects: tuple[Stop | Sweep, ...]
) -> None:
    with play(wall.archive, *effects) as game:
        body = game.body(BALL, at(-TOUCH + 0.015, 0, 0))
        moved = game.go(body, (0, 0, 0))
        assert moved.verdict == Verdict.CLEAR and not game.touches(body)
        assert np.linalg.norm(body.pose[:3, 3] - [-TOUCH + 0.015, 0, 0]) <= 0.0201
        body = game.body(BALL, at(-TOUCH + 0.015, 0, 0))
        game.go(body, (-0.3, 0, 0))
        assert body.pose[0, 3] == -TOUCH + 0.015 - 0.3, "its wish leads out"


@pytest.mark.interpreted
@pytest.mark.parametrize("effects", [(Stop(),), (Stop(), Sweep(), Slide())])
def test_who_cannot_get_free_stays_and_is_told(
    tmp_path: Path, effects: tuple[Stop | Sweep | Slide, ...]
) -> None:
    side = 1.6
    grid = effect_rooms.plane((-side / 2,) * 3, (side / 2,) * 3, 2 * APART)
    case = effect_rooms.build(tmp_path, grid)
    with play(case.archive, *effects) as game:
        body = game.body(BALL, at(0, 0, 0))
        for _ in range(2):
            moved = game.go(body, (0.1, 0, 0))
            assert moved.verdict == Verdict.CONTACT and not body.clear
            np.testing.assert_array_equal(body.pose, at(0, 0, 0))


@pytest.mark.interpreted
@pytest.mark.parametrize("effects", [(Stop(),), (Stop(), Sweep(), Slide())])
def test_what_cannot_be_read_stops_and_is_said(
    tmp_path: Path, effects: tuple[Stop | Sweep | Slide, ...]
) -> None:
    case = effect_rooms.build(tmp_path, effect_rooms.plane((0, -1, -1), (0, 1, 1)))
    with Archive(case.archive) as opened:
        voxels = [tuple(voxel) for voxel in opened.coordinates.tolist()]
    for voxel in voxels:
        flip_a_byte(case.archive, voxel)
    with play(case.archive, *effects) as game:
        body = game.body(BALL, at(-1, 0, 0))
        moved = game.go(body, (0.9, 0, 0))
        assert moved.verdict == Verdict.UNKNOWN and moved.touched[0].unknown and moved.unknown
        assert -1 <= body.pose[0, 3] <= -0.2
        assert game.world.collide(BALL, body.pose) == Verdict.CLEAR
        moved = game.go(body, (-0.2, 0, 0))
        assert moved.verdict == Verdict.CLEAR and not moved.touched and not moved.unknown
        # Whether it is touched where it begins is unknown: it ends somewhere clear, and says that this is why.
        lost = game.body(BALL, at(-0.1, 0, 0))
        moved = game.go(lost, (-0.4, 0, 0))
        assert moved.verdict == Verdict.CLEAR and moved.unknown


@pytest.mark.interpreted
def test_who_touches_a_wall_does_not_get_free_through_it(wall: archive_cases.Case) -> None:
    with play(wall.archive, Stop(), Sweep()) as game:
        for side in (-1.0, 1.0):
            body = game.body(BALL, at(side * (TOUCH - 0.01), 0, 0))
            assert game.touches(body)
            game.go(body, (-side * 0.49, 0, 0))
            assert body.pose[0, 3] * side > TOUCH and not game.touches(body)


@pytest.mark.interpreted
def test_a_wish_that_is_too_far_is_refused_and_changes_nothing(wall: archive_cases.Case) -> None:
    with play(wall.archive, Stop(), Sweep(), limits=SceneLimits(longest_move=2.0)) as game:
        body = game.body(BALL, at(-1, 0, 0))
        with pytest.raises(BadRequestError, match="within 2 m"):
            game.go(body, (0, 2.1, 0))
        with pytest.raises(BadRequestError):
            game.go(body, (np.nan, 0, 0))
        np.testing.assert_array_equal(body.pose, at(-1, 0, 0))


@pytest.mark.parametrize("poses", [[None], [at(0.03, 0.0, 0.01, 0.3), at(0.5, 0.2, 0.0)]])
def test_alone_it_moves_like_the_kernel_that_other_effects_need(
    wall: archive_cases.Case, poses: list[NDArray[np.float64] | None]
) -> None:
    """Also in contact, in turns and deep in a wall, with an archive as it lies and with two that were moved."""
    rng, ends = np.random.default_rng(7), set()
    with play(wall.archive, Stop()) as game:
        archives = [copy.copy(game.scene.archives[0]) for _ in poses]
        for archive, pose in zip(archives, poses, strict=True):
            archive.pose, archive.inverse = pose, None if pose is None else np.linalg.inv(pose)
        plays = []
        for alone in (True, False):
            world = World(SimpleNamespace(archives=archives), game.world.file)
            plays.append(Play(game.scene, world, make_pipeline(game.world.file, world)))
            if not alone:
                plays[-1].pipeline.runs = [
                    (["stop"], motion_effects.StopRunner(world, Stop(), walks=True).run)
                ]
        for turn in range(30):
            avatar = (BALL, effect_rooms.person())[turn % 2]
            start = at(*rng.uniform(-0.5, 0.5, 3) * [0.5, 1.0, 1.0], angle=rng.uniform(0, 6))
            bodies = [game.body(avatar, start) for game in plays]
            for _ in range(6):
                wish = at(
                    *bodies[0].pose[:3, 3] + rng.normal(0, 0.1, 3), angle=rng.uniform(0, 6) * (turn % 3 > 0)
                )
                moved = [game.pipeline.run(body, wish) for game, body in zip(plays, bodies, strict=True)]
                assert encode(moved[0]) == encode(moved[1])
                assert (bodies[0].clear, bodies[0].pose.tobytes()) == (
                    bodies[1].clear,
                    bodies[1].pose.tobytes(),
                )
                ends.add((moved[0].verdict, bool(moved[0].touched), moved[0].left > 0))
    assert {verdict for verdict, *_ in ends} == {0, 1} and len(ends) > 3
