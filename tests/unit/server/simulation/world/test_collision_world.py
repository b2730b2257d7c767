"""Several archives as one, asked about one avatar: where they lie, which is met first, and what is held."""

from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import archive_cases
import effect_rooms
import numpy as np
import pytest
from effect_frames import body_of, placed, report
from effect_rooms import at
from late_frames import blocked_loads
from msgspec import structs
from solidcloud.schemas.scene.effect_table import Contacts, Slide
from solidcloud.schemas.scene.scene_file import ArchiveItem, SceneFile
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.avatars.avatar_model import make_avatar
from solidcloud.server.queries.query_inputs import LateVoxels, QueryBudget
from solidcloud.server.runtime.stop_flag import NO_STOP
from solidcloud.server.scene import Scene
from solidcloud.server.simulation.effects import report_effects
from solidcloud.server.simulation.world import collision_world
from solidcloud.server.simulation.world.collision_world import World
from solidcloud.server.simulation.world.frame import Hit
from split_scans import several

BALL = make_avatar([[0.0, 0, 0]], 0.2)
# A quarter turn about z, and a shift.
THERE = at(2.0, 1.0, 0.5, np.pi / 2)
THERE[:2, :2] = [[0.0, -1.0], [1.0, 0.0]]


def world_of(*archives: tuple[Scene, np.ndarray | None]) -> World:
    """The world of scenes at poses."""
    file = SceneFile(format=1, archives=[ArchiveItem(path=scene.name) for scene, _ in archives])
    return World(SimpleNamespace(archives=[placed(*each) for each in archives]), file)


@pytest.mark.interpreted
def test_an_archive_at_a_pose_is_met_where_it_lies_and_first_comes_first(tmp_path: Path) -> None:
    wall = effect_rooms.plane((0, -0.8, -0.8), (0, 0.8, 0.8))
    case = effect_rooms.build(tmp_path, wall)
    carried = effect_rooms.build(tmp_path, wall @ THERE[:3, :3].T + THERE[:3, 3])
    motions = [
        (at(2, 0.3, 0.5), at(2, 1.6, 0.5)),
        (at(2.1, 1.8, 0.4), at(2, 0.1, 0.5)),
        (at(1, 0, 0), at(-1, 0, 0)),
        (at(2, 0.5, 0.5), at(0, 0, 0)),
        (at(1, 0.2, 0), at(1, 0.3, 0)),
    ]
    with (
        Scene.open(case.archive) as one,
        Scene.open(case.archive) as other,
        Scene.open(carried.archive) as plain,
    ):
        world, alone = world_of((one, None), (other, THERE)), world_of((plain, None))
        first = world_of((one, None))
        seen = set()
        for begin, end in motions:
            found = world.sweep(BALL, begin, end)
            parts = [each.sweep(BALL, begin, end) for each in (first, alone)]
            touches = [each for each in parts if each is not None]
            seen.add(None if found is None else found.archive)
            assert (found is None) == (not touches)
            if found is None:
                continue
            expected = min(touches, key=lambda each: each.fraction)
            assert found.verdict == expected.verdict == Verdict.CONTACT
            assert found.fraction == pytest.approx(expected.fraction, abs=1e-6)
            assert found.avatar is not None and found.cloud is not None
            np.testing.assert_allclose(found.cloud, expected.cloud, atol=1e-3)
            normal = world.normal(found, 0.1 if not effect_rooms.INTERPRETED else 0.5)
            assert normal is not None and normal @ (found.avatar - found.cloud) > 0
            axis = 0 if found.archive == 0 else 1
            assert abs(normal[axis]) == pytest.approx(1.0, abs=1e-3)
            pose, _ = world.between(BALL, begin, end, found.upper)
            assert world.collide(BALL, pose) == Verdict.CONTACT
            deepest = world.deepest(BALL, pose)
            assert deepest is not None and deepest.archive == found.archive
            nearest = world.nearest(found.cloud + 0.001, 0.05)
            assert nearest is not None and nearest.cloud is not None and nearest.archive == found.archive
            np.testing.assert_allclose(nearest.cloud, found.cloud, atol=1e-6)
        assert seen == {0, 1, None}
        assert world.collide(BALL, at(2, 0.1, 0.5)) == Verdict.CLEAR
        assert world.deepest(BALL, at(2, 0.1, 0.5)) is None
        assert world.nearest(np.array([2.0, 0.1, 0.5]), 0.05) is None
        assert world.lowest_height() == pytest.approx(-0.8 - effect_rooms.RADIUS, abs=2e-3)


@pytest.mark.interpreted
@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_of_two_archives_at_the_same_distance_the_least_witness_is_named(
    tmp_path: Path, order: tuple[int, int]
) -> None:
    """As the archive that holds both points names it, in frames and in questions (NUMERICS.md N11)."""
    points = np.array([[-0.25, 0.0, 0.0], [0.25, 0.0, 0.0]])
    how: dict[str, Any] = {"resolution": archive_cases.BINARY_STEP, "radius": 0.0625}
    cases = [archive_cases.build(tmp_path, part, **how) for part in (points, *points[:, None])]
    ball = make_avatar([[0.0, -0.03125, 0], [0.0, 0.03125, 0]], 0.25)
    origin, above = np.zeros(3), at(0, 1, 0)
    with ExitStack() as stack:
        whole, *halves = [stack.enter_context(Scene.open(case.archive)) for case in cases]
        alone, both = world_of((whole, None)), world_of(*[(halves[i], None) for i in order])
        for world in (alone, both):
            near = world.distance(ball, at(0, 0, 0), 0.5)
            assert near.witness_cloud.tolist() == points[:1].tolist()
            assert near.witness_avatar.tolist() == [[0.0, -0.03125, 0.0]]
            for hit in (world.deepest(ball, at(0, 0, 0)), world.nearest(origin, 0.5)):
                assert hit is not None and hit.cloud is not None
                assert hit.cloud.tolist() == points[0].tolist()
            swept = world.sweep(ball, above, at(0, 0, 0))
            assert swept is not None and swept.cloud is not None
            assert swept.cloud.tolist() == points[0].tolist()
            runner = report_effects.make(Contacts(cluster_distance=0.0), None)
            clusters = report(runner, world, body_of(ball), at(0, 0, 0)).clusters
            assert [cluster.cloud for cluster in clusters] == [tuple(place) for place in points.tolist()]
        asked = several(*[(cases[1 + i].archive, None) for i in order])
        with asked:
            asked.add_avatar("ball", ball.points, ball.radius)
            found = asked.distance("ball", np.eye(4)[None], 0.5)
            assert found.witness_cloud.tolist() == points[:1].tolist()


@pytest.mark.interpreted
def test_what_is_held_stays_through_a_reload_and_no_longer(tmp_path: Path) -> None:
    case = effect_rooms.build(tmp_path, effect_rooms.plane((0, -0.4, -0.4), (0, 0.4, 0.4)))
    with Scene.open(case.archive) as scene:
        world = world_of((scene, None))
        before = world.generations()
        with world as seen:
            opened = seen[0].opened
            scene.reload()
            assert world.generations() == before and not opened.ended.is_set()
            assert world.collide(BALL, at(0.1, 0, 0)) == Verdict.CONTACT
        assert opened.ended.wait(10)
        assert world.generations() != before
        assert world.collide(BALL, at(0.1, 0, 0)) == Verdict.CONTACT


@pytest.mark.interpreted
@pytest.mark.parametrize("unknown", [False, True])
def test_a_contact_that_is_not_exact_is_unknown_only_where_something_was_not_looked_at(
    tmp_path: Path, unknown: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A graze just before the contact: all was looked at."""
    case = effect_rooms.build(tmp_path, effect_rooms.plane((0, -0.4, -0.4), (0, 0.4, 0.4)))
    ask = collision_world.sweep_fast

    def graze(*what: Any) -> Any:
        return structs.replace(ask(*what), exact=np.zeros(1, bool), lower=np.full(1, 0.2))

    monkeypatch.setattr(collision_world, "sweep_fast", graze)
    monkeypatch.setattr(collision_world, "has_unknown", lambda data: unknown)
    with Scene.open(case.archive) as scene:
        for world in (world_of((scene, None)), world_of((scene, None), (scene, THERE))):
            world.begin(NO_STOP)
            found = world.sweep(BALL, at(1, 0, 0), at(0, 0, 0))
            assert found is not None and not found.exact and found.fraction == 0.2 < found.upper
            assert world.unknown == unknown


def test_a_normal_with_points_in_a_voxel_that_is_not_in_memory_is_unknown(tmp_path: Path) -> None:
    wall = effect_rooms.build(tmp_path, effect_rooms.plane((0, -0.5, -0.5), (0, 0.5, 0.5)), voxel=0.5)
    with effect_rooms.play(wall.archive, Slide()) as game:
        world, out = game.world, np.array([-1.0, 0, 0])
        with world as seen, blocked_loads(game.scene) as gate:
            cloud = np.add(seen[0].data.arrays.origin, [0, 0.48, 0.2])  # the next voxels begin at 0.5
            hit = Hit(0.0, Verdict.CONTACT, cloud + out, cloud, archive=0)
            gate.set()
            world.nearest(cloud, 0.01)
            gate.clear()
            late = LateVoxels()
            world.begin(NO_STOP)
            assert (
                world.normal(hit, 0.08, QueryBudget(late=late)) is None and late.count > 0 and world.unknown
            )
            assert not world.highest(hit.archive, hit.cloud, out[None], 0.08, QueryBudget(late=late)).any()
            assert world.unknown
            gate.set()
            world.begin(NO_STOP)
            assert world.normal(hit, 0.08) == pytest.approx(out) and not world.unknown
