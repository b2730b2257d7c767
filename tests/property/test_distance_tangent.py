"""Ten million pairs of points, a hundred thousand of them near-tangent, against the integers: none decided wrongly."""

from pathlib import Path

import archive_cases
import naive
import naive_distance
import numpy as np
import pytest
from numpy.typing import NDArray
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.kernels.core.node_bounds import U32
from solidcloud.server.scene import Scene


def squares(a: NDArray[np.int64], b: NDArray[np.int64]) -> NDArray[np.int64]:
    """All |a - b|^2 (m * n,), exact units; every difference is below 2^30, so that the sums fit."""
    apart = a[:, None] - b
    assert np.abs(apart).max() < 1 << 30
    return (apart * apart).sum(axis=2).ravel()


def judge(scene: Scene, poses: NDArray[np.float64], least: list[int], radii: int) -> None:
    """Assert that `distance` and `collide` say what the least squares say, to the unit."""
    answers = scene.distance("avatar", poses, 3.0)
    assert answers.exact.all()
    expected = [naive_distance.signed_distance(square, radii) for square in least]
    assert answers.signed_distance.tolist() == expected
    for pose, square in list(zip(poses, least, strict=True))[::10]:
        root = round(square**0.5)
        for reach in (root - 1, root, root + 1):
            if reach >= radii:
                verdict = scene.collide("avatar", pose[None], (reach - radii) / naive.UNITS).verdict[0]
                assert verdict == (Verdict.CONTACT if square <= reach * reach else Verdict.CLEAR)


@pytest.mark.case(
    6,
    "10^5 near-tangent pairs among 10^7: distance exact to the unit, collide one unit on either side; none wrong",
)
def test_ten_million_pairs_none_wrong(tmp_path: Path, rng: np.random.Generator) -> None:
    # A fine lattice and a large voxel: what float32 cannot tell there is half a step wide.
    step, steps = 1e-6, 1 << 21
    points = rng.uniform(-1, 1, (100, 3))
    avatar = rng.uniform(-0.5, 0.5, (100, 3))
    case = archive_cases.build(tmp_path, points, voxel=step * steps, resolution=step, radius=0.01)
    poses = archive_cases.near_poses(rng, points, avatar, 950, 1.0)
    with Scene.open(case.archive) as scene:
        scene.add_avatar("avatar", avatar, 0.02)
        origin = scene.info().origin
        scan = naive.scan_units(naive.lattice_of(points, origin, step), step)
        least = [int(squares(naive.placed_units(avatar, pose, origin), scan).min()) for pose in poses]
        judge(scene, poses, least, naive.reach_units(0.02, 0.01, 0.0))
    pairs = len(poses) * len(points) * len(avatar)
    # The near-tangent ones: the points of a sphere, on the lattice, seen from all around its centre.
    out = rng.normal(size=(1000, 3))
    shell = np.rint(out / np.linalg.norm(out, axis=1)[:, None] * 0.3 / step) * step
    case = archive_cases.build(tmp_path, shell, voxel=step * steps, resolution=step, radius=0.1)
    poses = np.array([archive_cases.pose_of(np.eye(3), rng.uniform(-0.2, 0.2, 3) * step) for _ in range(500)])
    with Scene.open(case.archive) as scene:
        scene.add_avatar("avatar", np.zeros((1, 3)), 0.1)
        origin = scene.info().origin
        scan = naive.scan_units(naive.lattice_of(shell, origin, step), step)
        found = [squares(naive.placed_units(np.zeros((1, 3)), pose, origin), scan) for pose in poses]
        judge(scene, poses, [int(each.min()) for each in found], naive.reach_units(0.1, 0.1, 0.0))
    # Within what float32 may lose of the nearest pair (placed_avatar.py): nothing but the integers tells these apart.
    band = 2 * np.sqrt(3.0) * U32 * (2 * steps) * step * naive.UNITS
    near = sum(int((np.sqrt(each.astype(float)) <= each.min() ** 0.5 + band).sum()) for each in found)
    assert pairs + 500 * len(shell) >= 10**7 and near >= 10**5, near
