"""Test where swept motions end, by the sweep's kernel, against a search of a clear pose."""

import archive_cases
import effect_rooms
import numpy as np
import pytest
from effect_rooms import INTERPRETED
from solidcloud.schemas.scene.effect_table import AnyEffect, Stop, Sweep
from solidcloud.schemas.scene.scene_file import ArchiveItem, SceneFile
from solidcloud.server.archives.placed_archive import PlacedArchive
from solidcloud.server.kernels.walk.state import FOLLOW
from solidcloud.server.scene import Scene
from solidcloud.server.simulation.world.collision_world import World
from solidcloud.server.simulation.world.frame import Body, Frame
from solidcloud.server.simulation.world.walker import walker_of

MOTIONS = 6 if INTERPRETED else 80


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> archive_cases.Case:
    return effect_rooms.build(tmp_path_factory.mktemp("room"), effect_rooms.room(2.4))


@pytest.mark.interpreted
@pytest.mark.parametrize("skin", [0.0, 0.05])
def test_motions_end_where_clear_poses_are_found_step_by_step(
    room: archive_cases.Case, rng: np.random.Generator, skin: float
) -> None:
    placed = PlacedArchive(room.archive, budget_bytes=1 << 28)
    effects: list[AnyEffect] = [Stop(skin=skin), Sweep(tolerance=1e-6)]
    file = SceneFile(format=1, archives=[ArchiveItem(path=str(room.archive))], effects=effects)
    person, hits = effect_rooms.person(), 0
    with Scene([placed], "room") as scene:
        fused, apart = World(scene, file), World(scene, file)
        walker_of(fused)
        walker_of(apart).native = False
        scene.add_avatar("person", person.points, person.radius)
        scene.collide("person", effect_rooms.at(0.125, 0.0625, -0.75), margin=3.0)  # loads the voxels
        for number in range(MOTIONS):
            begin = effect_rooms.at(*rng.uniform(-0.3, 0.3, 3) - [0, 0, 0.4])
            begin[:3, :3] = archive_cases.random_rotation(rng)
            to = begin.copy()
            to[:3, 3] += rng.uniform(-1, 1, 3) * rng.choice([1e-5, 0.05, 2.0])
            if number % 2:
                to[:3, :3] = archive_cases.random_rotation(rng)
            results = []
            for world in (fused, apart):
                frame = Frame(Body("a/b", person, begin), to, 1 / 30, world, pose=begin)
                world.begin(frame.budget.stop)
                with world:
                    world.walker.run(frame, FOLLOW)
                hit = frame.hits[0] if frame.hits else None
                point = None if hit is None or hit.point is None else hit.point.tobytes()
                results.append((frame.pose.tobytes(), None if hit is None else hit.fraction, point))
                hits += hit is not None
            assert results[0] == results[1]
    assert hits > MOTIONS / 4
