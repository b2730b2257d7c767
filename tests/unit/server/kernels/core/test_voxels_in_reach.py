"""The broad phase: every voxel that holds a point in reach is listed, and not many more."""

from pathlib import Path

import archive_cases
import naive
import numpy as np
import pytest
import synthetic_scans
from numpy.typing import NDArray
from solidcloud.schemas.archive.archive import Archive
from solidcloud.server.avatars.avatar_model import AvatarModel, make_avatar
from solidcloud.server.kernels.core.reach import VoxelsInReach
from solidcloud.server.queries.query_inputs import SceneData, check_request, make_scene_data, to_units
from solidcloud.server.residency.voxel_cache import VoxelCache
from solidcloud.server.residency.voxel_store import VoxelStore


def find(data: SceneData, avatar: AvatarModel, poses: NDArray[np.float64], margin: float) -> VoxelsInReach:
    """The voxels in reach of a request."""
    return check_request(data, avatar, poses, data.radius_units + to_units(margin, "margin"))


def open_data(case: archive_cases.Case) -> SceneData:
    """What `collide` reads of an archive."""
    store = VoxelStore(case.archive)
    return make_scene_data(store.archive, VoxelCache(store, 1 << 24))


def listed(reach: VoxelsInReach, pose: int) -> list[int]:
    """The voxel rows of one pose."""
    lists = reach.lists
    return sorted(lists.rows[lists.starts[pose] : lists.starts[pose + 1]].tolist())


@pytest.mark.parametrize(("shift", "margin"), [(0.0, 0.0), (5.6e6, 0.1), (-1e8, 3.0)])
def test_no_voxel_in_reach_is_left_out(
    tmp_path: Path, rng: np.random.Generator, shift: float, margin: float
) -> None:
    case = archive_cases.build(
        tmp_path, synthetic_scans.make_scan("noise", 5, 900) + shift, voxel=0.25, resolution=1e-3
    )
    avatar = rng.uniform(-0.2, 0.2, (30, 3))
    data, model = open_data(case), make_avatar(avatar, 0.02)
    poses = archive_cases.near_poses(rng, case.points, avatar, 40, 0.5)
    reach = find(data, model, poses, margin)
    with Archive(case.archive) as archive:
        lattice, step = archive.header.lattice, archive.header.lattice.step
    integers = naive.lattice_of(case.points, lattice.origin, step)
    units, voxels = naive.scan_units(integers, step), integers // lattice.voxel_steps
    for i, pose in enumerate(poses):
        placed = naive.placed_units(avatar, pose, lattice.origin)
        most = naive.reach_units(0.02, 0.01, margin)
        # Any point in reach of any avatar point, in contact or not: its voxel must be listed.
        apart = np.abs(placed[:, None] - units)
        within = (apart <= most).all(axis=2)
        near = (within & ((np.where(within[..., None], apart, 0) ** 2).sum(axis=2) <= most**2)).any(axis=0)
        needed = {tuple(v) for v in voxels[near].tolist()}
        rows = listed(reach, i)
        found = {tuple(v) for v in (data.arrays.corners[rows] // lattice.voxel_steps).tolist()}
        assert needed <= found and len(found) == len(rows)
        # And each one listed has its box within reach of the sphere around the avatar.
        center = placed.mean(axis=0)
        ball = np.linalg.norm(placed - center, axis=1).max() * 2 + most * 1.001 + 2 * step * naive.UNITS
        low, high = data.tree.low[rows] * step * naive.UNITS, data.tree.high[rows] * step * naive.UNITS
        gap = np.maximum(np.maximum(low - center, center - high), 0)
        assert (np.linalg.norm(gap, axis=1) <= ball).all()


def _place(x: float, y: float = 0.5, z: float = 0.5) -> NDArray[np.float64]:
    return archive_cases.pose_of(np.eye(3), np.array([x, y, z]))


def test_outside_is_where_the_reach_leaves_the_bounds(tmp_path: Path) -> None:
    corners = np.array([[0.0, 0, 0], [2.0, 2, 2], [1.0, 1, 1]])
    data = open_data(archive_cases.build(tmp_path, corners, resolution=1e-3))
    poses = np.array(
        [_place(1.0), _place(0.14), _place(0.06), _place(-0.05), _place(50.0), _place(1.0, z=1.95)]
    )
    reach = find(data, make_avatar([[0.0, 0, 0]], 0.09), poses, 0.0)
    assert reach.outside.tolist() == [False, False, True, True, True, True]
    assert listed(reach, 4) == []
