"""Voxels that are not resident are bounded: by their boxes, and more closely by their coarse bounds."""

import math

import archive_cases
import numpy as np
import pytest
from coarse_tops import ROOM, Made, build_scattered, open_made, rows_of
from numpy.typing import NDArray
from solidcloud.builder.voxel.record_points import voxel_points
from solidcloud.server.avatars.avatar_model import AvatarModel, make_avatar
from solidcloud.server.kernels.core.voxels_in_reach import VoxelsInReach
from solidcloud.server.kernels.nearest.missing_voxels import split_missing
from solidcloud.server.residency.coarse_bounds import CoarseBounds

REACH = 3 << 26  # exact units


@pytest.fixture(scope="module")
def opened(tmp_path_factory: pytest.TempPathFactory) -> Made:
    """Open an archive of eight voxels."""
    return open_made(build_scattered(tmp_path_factory.mktemp("scattered")))


@pytest.fixture
def made(opened: Made) -> Made:
    """Return the eight voxels without coarse bounds."""
    return opened._replace(coarse=CoarseBounds(opened.voxels, ROOM))


def split(
    made: Made, body: AvatarModel, poses: NDArray[np.float64], which: NDArray[np.int64]
) -> tuple[VoxelsInReach, VoxelsInReach, NDArray[np.float64], NDArray[np.uint32]]:
    """Return the reach, what is left of it, the bounds [m] and the numbers of missing voxels."""
    reach = made.reach(body, poses, REACH)
    starts, rows = np.empty_like(reach.starts), np.empty_like(reach.rows)
    bound, counts = np.full(len(poses), math.inf), np.zeros((3, len(poses)), np.uint32)
    split_missing(
        poses,
        body.arrays,
        made.arrays,
        made.broad,
        made.coarse.arrays,
        reach,
        which,
        starts,
        rows,
        bound,
        counts,
    )
    left = reach._replace(starts=starts, rows=rows)
    return reach, left, bound * made.arrays.step, counts[0]


def least_distances(
    made: Made, body: AvatarModel, poses: NDArray[np.float64], rows: list[list[int]]
) -> NDArray[np.float64]:
    """Return the least distance of any avatar centre from any point of the voxels of each pose [m]."""
    least = np.full(len(poses), np.inf)
    archive = made.store.archive
    lattice = archive.header.lattice
    for row in range(made.voxels):
        local = voxel_points(*archive.read_voxel(row))
        points = lattice.to_world(local + archive.coordinates[row] * lattice.voxel_steps)
        for i in (i for i, own in enumerate(rows) if row in own):
            placed = body.points @ poses[i, :3, :3].T + poses[i, :3, 3]
            apart = np.linalg.norm(placed[:, None] - points, axis=-1).min()
            least[i] = min(least[i], apart)
    return least


@pytest.mark.interpreted
@pytest.mark.parametrize("count", [1, 40])
def test_bounds_hold_and_coarse_bounds_are_closer(made: Made, rng: np.random.Generator, count: int) -> None:
    body = make_avatar(rng.uniform(-0.2, 0.2, (count, 3)), 0.01)
    poses = np.array(
        [
            archive_cases.pose_of(archive_cases.random_rotation(rng), rng.uniform(-0.5, 2.5, 3))
            for _ in range(12)
        ]
    )
    some = made.resident(0, 3)
    which = np.array([0, 2, 3, 7, 8, 9, 11])
    reach, left, boxes, counts = split(some, body, poses, which)
    missing = [
        [row for row in own if row not in (0, 3)] if i in which else []
        for i, own in enumerate(rows_of(reach))
    ]
    assert counts.tolist() == [len(rows) for rows in missing]
    resident = [[row for row in own if row in (0, 3)] for own in rows_of(reach)]
    assert rows_of(left) == [own if i in which else [] for i, own in enumerate(resident)]
    true = least_distances(made, body, poses, missing)
    assert (boxes <= true).all() and np.isinf(boxes[counts == 0]).all() and (counts > 0).any()
    some.fill(5)
    closer = split(some, body, poses, which)[2]
    assert (boxes <= closer).all() and (closer <= true).all()
    known = counts > 0
    assert (closer > boxes)[known].any(), "the nodes lie within the box"
