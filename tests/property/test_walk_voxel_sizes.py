"""The same scan in voxels of three sizes: the same walks, bit for bit, in memory and with a small cache."""

from pathlib import Path

import effect_rooms
import numpy as np
import pytest
from effect_rooms import Play, at, play
from numpy.typing import NDArray
from solidcloud.schemas.scene.effect_table import Ground, Slide, Step, Stop, Sweep
from solidcloud.server.residency.arena import ArenaBuffer
from solidcloud.server.residency.voxel_store import VoxelStore

VOXELS = (1.0, 3.3, 8.0)
EFFECTS = (Stop(), Sweep(), Slide(), Step(), Ground())
FRAMES = 60
PERSON = effect_rooms.person()


def hall(rng: np.random.Generator) -> NDArray[np.float64]:
    """Return a noisy floor with a step, a ramp, two walls and a sheet with a free edge."""
    sides = [
        effect_rooms.plane((-2.2, -2.2, 0.0), (2.2, 2.2, 0.0)),
        effect_rooms.plane((-2.2, 2.0, 0.0), (2.2, 2.0, 1.4)),
        effect_rooms.plane((2.0, -2.2, 0.0), (2.0, 2.2, 1.4)),
        effect_rooms.plane((-0.5, -2.2, 0.15), (0.5, -0.7, 0.15)),
        effect_rooms.plane((-0.5, -0.7, 0.0), (0.5, -0.7, 0.15)),
        effect_rooms.plane((-1.0, -2.2, 0.0), (-1.0, -1.0, 1.4)),
    ]
    ramp = effect_rooms.plane((-2.2, 0.0, 0.0), (-1.0, 1.5, 0.0))
    ramp[:, 2] = 0.5 * (-1.0 - ramp[:, 0])
    return np.concatenate([*sides, ramp]) + rng.normal(0.0, 0.002, (sum(map(len, sides)) + len(ramp), 3))


@pytest.fixture(scope="module")
def archives(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """The hall, built in voxels of each size."""
    folder, points = tmp_path_factory.mktemp("hall"), hall(np.random.default_rng(36))
    return [effect_rooms.build(folder, points, voxel=voxel).archive for voxel in VOXELS]


def walks(game: Play) -> NDArray[np.float64]:
    """Return the poses of walks into walls, corners and edges, up the step and the ramp."""
    rng, poses = np.random.default_rng(1), []
    for start in ((0.0, 0.5), (1.5, 1.5), (0.0, -0.3), (-0.8, 0.7), (-0.6, -1.5)):
        body, heading = game.body(PERSON, at(*start, 0.05)), rng.uniform(0, 2 * np.pi)
        for frame in range(FRAMES):
            if frame % 15 == 0:
                heading += rng.uniform(-2.0, 2.0)
            game.go(body, 0.06 * np.array([np.cos(heading), np.sin(heading), 0.0]))
            poses.append(body.pose.copy())
    return np.array(poses)


def test_walks_are_the_same_in_voxels_of_any_size(archives: list[Path]) -> None:
    with play(archives[-1], *EFFECTS) as game:
        expected = walks(game).tobytes()
    for archive in archives[:-1]:
        with play(archive, *EFFECTS) as game:
            assert walks(game).tobytes() == expected
        with play(archive, *EFFECTS) as game:
            game.world.walker.native = False  # Python answers every query
            assert walks(game).tobytes() == expected


def test_a_cache_of_a_few_voxels_changes_no_walk(archives: list[Path]) -> None:
    """Not all voxels of a motion fit in it."""
    store = VoxelStore(archives[0])
    store.close()
    budget = 9 * ArenaBuffer.rounded(int(store.sizes.max())) // 8
    with play(archives[0], *EFFECTS) as game:
        expected = walks(game).tobytes()
    with play(archives[0], *EFFECTS, budget_bytes=budget, level_bytes=0) as game:
        assert walks(game).tobytes() == expected
        assert game.scene.residency.stats.evicted > 100
