"""Which pairs of pose and voxel coarse tops settle, and which they leave to those who look closer."""

import os
from itertools import chain

import archive_cases
import numpy as np
import pytest
from coarse_tops import ROOM, Made, build_scattered, open_made
from numpy.typing import NDArray
from solidcloud.server.avatars.avatar_model import make_avatar
from solidcloud.server.kernels.collide.collide_poses import collide_poses
from solidcloud.server.kernels.collide.early_contact import CLEAR
from solidcloud.server.queries.context.query_budget import NO_LIMIT
from solidcloud.server.residency.coarse_bounds import CoarseBounds

INTERPRETED = os.environ.get("NUMBA_DISABLE_JIT") == "1"


@pytest.fixture(scope="module")
def opened(tmp_path_factory: pytest.TempPathFactory) -> Made:
    """Open an archive of eight voxels."""
    return open_made(build_scattered(tmp_path_factory.mktemp("scattered")))


@pytest.fixture
def made(opened: Made) -> Made:
    """Return the eight voxels without coarse bounds."""
    return opened._replace(coarse=CoarseBounds(opened.voxels, ROOM))


def shifted(*places: tuple[float, float, float]) -> NDArray[np.float64]:
    """Poses (k, 4, 4) that only shift."""
    return np.array([archive_cases.pose_of(np.eye(3), np.array(place)) for place in places])


@pytest.mark.interpreted
def test_what_is_settled_of_a_long_avatar_is_clear(made: Made, rng: np.random.Generator) -> None:
    """A rod, much of which is far from its middle: along each axis, at random places."""
    made.fill()
    everything, count = made.resident(*range(made.voxels)), 10 if INTERPRETED else 30
    for axis in range(3):
        rod = make_avatar(
            np.roll(np.column_stack([np.linspace(-0.6, 0.6, 40), np.zeros((40, 2))]), axis, axis=1), 0.01
        )
        poses = shifted(*rng.uniform(0, 2, (count, 3)).tolist())
        before, gone = made.settled(rod, poses)
        assert 0 < sum(map(len, gone)) < sum(map(len, before))
        starts = np.cumsum([0, *map(len, gone)])
        reach = made.reach(rod, poses)._replace(starts=starts, rows=np.array(list(chain(*gone)), np.int64))
        verdict, counts = np.zeros(count, np.uint8), np.zeros((3, count), np.uint32)
        collide_poses(
            poses, rod.arrays, everything.arrays, reach, np.arange(count), 0, NO_LIMIT, verdict, counts
        )
        assert (verdict == CLEAR).all()
