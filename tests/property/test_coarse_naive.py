"""What coarse tops settle is clear by the definition, whatever the scan, avatar, pose, tree and radii."""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import archive_cases
import numpy as np
from coarse_tops import Made, least_margin, open_made
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from point_clouds import COUNTS, FAR, KINDS, OFF, STEPS, TREES, cloud
from sample_sizes import sample
from solidcloud.builder.voxel.record_points import voxel_points
from solidcloud.schemas.archive.radius_model import class_radii
from solidcloud.server.avatars.avatar_model import AvatarModel, make_avatar

MOST_UNITS = 1 << 30  # of a pair's reach


def spheres(made: Made, model: str | None) -> list[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Points (p, 3) [voxel steps] and radii (p,) [exact units] of every voxel, as stored."""
    archive, found = made.store.archive, []
    table = class_radii(model, archive.header.radius, archive.header.models)
    for row in range(made.voxels):
        voxel, links = archive.read_voxel(row)
        chosen = np.zeros(len(voxel.points), np.int64) if len(table) == 1 else voxel.radius_class
        found.append((voxel_points(voxel, links).astype(np.int64), table[chosen]))
    return found


def judge(
    made: Made, model: str | None, avatar: AvatarModel, poses: NDArray[np.float64], rng: np.random.Generator
) -> tuple[int, int]:
    """Ask about each pose at margins where its pair with some voxel begins to be in contact, just before, and half.

    Returns, of the pairs that are clear by half their distance or more, how many were settled, and how many there are.
    """
    points = spheres(made, model)
    for row in range(made.voxels):
        made.remember(row) if row % 2 else made.coarse.store_from_archive(made.store, row)
    settled = clear = 0
    for pose in poses:
        if np.abs(pose[:3, 3]).max() > 1e9:
            continue
        least = [least_margin(made, row, *points[row], avatar, pose) for row in range(made.voxels)]
        own = int(made.reach(avatar, pose[None]).units[0])
        begun = least[int(rng.integers(made.voxels))]
        resident = np.flatnonzero(rng.uniform(size=made.voxels) < 0.2).tolist()
        for margin in (begun - 1, begun, min(least), min(least) - 1, begun // 2):
            if not 0 <= margin <= MOST_UNITS - own:
                continue
            reach, gone = made.settled(avatar, pose[None], margin)
            assert all(margin < least[row] for row in gone[0]), (pose.tolist(), margin, gone, least)
            some = made.resident(*resident).settled(avatar, pose[None], margin)
            assert some == (reach, [[row for row in gone[0] if row not in resident]])
            far = {row for row in reach[0] if 2 * margin <= least[row]}
            settled, clear = settled + len(far & set(gone[0])), clear + len(far)
    return settled, clear


@settings(max_examples=sample(6, 40), deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**32 - 1),
    kind=st.sampled_from(KINDS),
    count=COUNTS,
    body=st.sampled_from(KINDS),
    step=STEPS,
    voxel_steps=st.sampled_from([7, 1000, 70_000, 1 << 21]),
    far=FAR,
    off=OFF,
    tree=TREES,
)
def test_nothing_in_contact_is_settled(
    seed: int,
    kind: str,
    count: int,
    body: str,
    step: float,
    voxel_steps: int,
    far: float,
    off: float,
    tree: dict[str, Any],
) -> None:
    rng = np.random.default_rng(seed)
    extent = step * min(voxel_steps * rng.uniform(0.1, 3), 1 << 21)
    if step <= far * 1e-14:  # float64 holds no such lattice there
        far = 0.0
    points = cloud(rng, kind, count) * extent + far * rng.uniform(-1, 1, 3)
    place = off * rng.uniform(-1, 1, 3)
    avatar = make_avatar(
        cloud(rng, body, 20) * (extent * rng.uniform(0.01, 0.5)) + place,
        float(step * rng.choice([0, 0.7, 9])),
    )
    radius = float(step * rng.choice([0, 0.5, 9]))
    with TemporaryDirectory() as folder:
        case = archive_cases.build(
            Path(folder), points, voxel=step * voxel_steps, resolution=step, radius=radius, **tree
        )
        poses = archive_cases.near_poses(rng, points, avatar.points, 8, extent)
        judge(open_made(case.archive), None, avatar, poses, rng)
