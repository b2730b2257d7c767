"""Test the nearest scan point where voxels are in memory against `within`."""

import os
from pathlib import Path

import archive_cases
import effect_rooms
import numpy as np
import pytest
from solidcloud.schemas.scene.effect_table import Stop
from solidcloud.server.kernels.rays.nearest_in_memory import nearest_in_memory
from solidcloud.server.queries.within import within

INTERPRETED = os.environ.get("NUMBA_DISABLE_JIT") == "1"
PLACES = 40 if INTERPRETED else 4000


@pytest.mark.interpreted
def test_it_is_the_point_that_within_finds(tmp_path: Path, rng: np.random.Generator) -> None:
    """Points on a lattice of 4 cm: many are equally near, and some places have none in reach."""
    points = np.round(rng.uniform(-1.0, 1.0, (300 if INTERPRETED else 4000, 3)) / 0.04) * 0.04
    points[:, 0] += 700.0
    case = archive_cases.build(tmp_path, np.unique(points, axis=0))
    found, rows, in_reach = np.empty(3), np.empty(64, np.int64), 0
    with effect_rooms.play(case.archive, Stop()) as play, play.world as seen:
        data, stop = seen[0].data, np.zeros(1, np.int64)
        held = data.references.to(data.arrays, data.broad).reference
        aside = rng.uniform(-1.2, 1.2, (PLACES // 2, 3)) + np.array([700.0, 0.0, 0.0])
        places = np.concatenate([points[: PLACES // 2], aside])
        assert nearest_in_memory(held, tuple(places[0]), 0.08, stop, rows, found)[0] == -1, "not loaded"
        play.scene.add_avatar("ball", np.zeros((1, 3)), 0.1)
        play.scene.collide("ball", effect_rooms.at(700.0, 0.0, 0.0), margin=3.0)  # loads the voxels
        for reach in (0.02, 0.08):
            answers = within(data, places, reach)
            for place, distance, cloud in zip(places, answers.distance, answers.cloud_point, strict=True):
                count, known, _ = nearest_in_memory(held, tuple(place), reach, stop, rows, found)
                assert count >= 0 and known == np.isfinite(distance)
                if known:
                    np.testing.assert_array_equal(found, cloud)
                in_reach += known
        assert 0 < in_reach < 2 * PLACES
        stop[0] = 1
        assert nearest_in_memory(held, tuple(places[0]), 0.08, stop, rows, found)[0] == -1
        stop[0] = 0
        assert nearest_in_memory(held, tuple(places[0]), 0.5, stop, rows[:1], found)[0] == -1
