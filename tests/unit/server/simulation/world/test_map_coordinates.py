"""Test walks in a scene that its file moves to map coordinates, against the same walks at the origin."""

from pathlib import Path
from typing import Any

import archive_cases
import effect_rooms
import numpy as np
import pytest
from effect_rooms import INTERPRETED
from numpy.typing import NDArray
from solidcloud.schemas.scene.effect_table import AnyEffect, Ground, Slide, Step, Stop, Sweep
from solidcloud.schemas.scene.scene_file import ArchiveItem, SceneFile
from solidcloud.server.archives.placed_archive import PlacedArchive
from solidcloud.server.scene import Scene
from solidcloud.server.simulation.simulation import make_pipeline
from solidcloud.server.simulation.world.collision_world import World
from solidcloud.server.simulation.world.frame import Body

Floats = NDArray[np.float64]

EFFECTS: list[AnyEffect] = [Stop(), Sweep(), Slide(), Step(), Ground()]
MAP = np.array([500_000.0, 4_000_000.0, 300.0])
# Largest rounding of a coordinate there: half the distance between two float64 numbers, 2.3e-10 m.
ROUNDING = np.spacing(MAP.max()) / 2
FRAMES = 6 if INTERPRETED else 300


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> archive_cases.Case:
    return effect_rooms.build(tmp_path_factory.mktemp("room"), effect_rooms.room(2.4))


def walk(archive: Path, shift: Floats, ways: Floats) -> tuple[Floats, int]:
    """Walk in an archive that is moved by `shift`, along ways (n, 3), a frame each.

    Return the positions (n, 3) minus the shift, and the number of motions that were swept.
    """
    pose = np.eye(4)
    pose[:3, 3] = shift
    placed = PlacedArchive(archive, budget_bytes=1 << 28, pose=pose)
    items = [ArchiveItem(path=str(archive), pose=pose.tolist())]
    with Scene([placed], "map") as scene:
        world, swept = Counted(scene, SceneFile(format=1, archives=items, effects=EFFECTS)), []
        pipeline = make_pipeline(world.file, world)
        start = effect_rooms.at(0.125, 0.0625, -0.75)
        start[:3, 3] += shift
        body = Body("client/avatar", effect_rooms.person(), start)
        for way in ways:
            target = body.pose.copy()
            target[:3, 3] += way
            pipeline.run(body, target, 1 / 30)
            swept.append(body.pose[:3, 3] - shift)
        return np.array(swept), world.motions


class Counted(World):
    """World that counts motions."""

    motions = 0

    def sweep(self, *arguments: Any, **options: Any) -> Any:
        self.motions += 1
        return super().sweep(*arguments, **options)


@pytest.mark.interpreted
def test_a_walk_at_map_coordinates_differs_by_the_rounding_of_its_positions(
    room: archive_cases.Case, rng: np.random.Generator
) -> None:
    """The drift was reported as 1.1e-8 m.

    Positions are float64 in the world frame. A frame rounds one in its target, and each motion
    rounds one in its end and one in the point between, each by at most ROUNDING. All else is
    computed in the archive's frame, where the pose is an exact difference. The sum of these bounds is
    5e-7 m for 300 frames; roundings of either sign leave some 1e-8 m of it.
    """
    ways = np.repeat(rng.normal(scale=0.04, size=(FRAMES // 30 + 1, 3)), 30, axis=0)[:FRAMES]
    here, _ = walk(room.archive, np.zeros(3), ways)
    there, motions = walk(room.archive, MAP, ways)
    drift = np.abs(there - here).max()
    assert 0.0 < drift <= (FRAMES + 2 * motions) * ROUNDING
    assert drift < 1e-7
    assert np.ptp(here, axis=0)[:2].min() > (0.0 if INTERPRETED else 0.5), "it walks through the room"
