"""Hard cases of answers that are not exact; a test's number is its row in NUMERICS.md."""

from pathlib import Path

import archive_cases
import numpy as np
import pytest
from numpy.typing import NDArray
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.kernels.core.scene_arrays import Arena
from solidcloud.server.residency.voxel_store import VoxelStore
from solidcloud.server.scene import Scene

# UTM and ECEF, in whole metres.
SHIFTS = [(0, 0, 0), (500_000, 5_600_000, 100), (4_027_894, 307_045, 4_919_475)]


class UnreadableStore(VoxelStore):
    """Store of an archive of which no voxel can be read."""

    def load(self, row: int, arena: Arena, offset: int) -> NDArray[np.int64]:
        """Fail."""
        raise OSError(5, "Input/output error")


@pytest.mark.case(32, "bounds of a voxel that cannot be read: the same at the origin, at UTM and at ECEF")
def test_case_32_boxes_bound_what_is_not_in_memory(tmp_path: Path) -> None:
    """Bodies hang outside the box of a voxel with a floor and a wall."""
    side = np.stack(np.meshgrid(*[np.linspace(0.05, 3.95, 30)] * 2), axis=-1).reshape(-1, 2)
    flat = np.column_stack([side, np.full(len(side), 0.05)])
    scan = np.rint(np.concatenate([flat, np.roll(flat, 1, axis=1)]) * 2.0**14) * 2.0**-14
    body = np.random.default_rng(1).uniform(-0.2, 0.2, (50, 3))
    body = np.rint(body * 2.0**14) * 2.0**-14
    places = np.array([(2.0, 2.0, 5.0), (-0.5, 2.0, 1.0), (5.0, 5.0, 4.5), (2.0, -1.0, -1.0)])
    true = [np.linalg.norm((body + place)[:, None] - scan, axis=-1).min() - 0.03 for place in places]
    found = []
    for number, shift in enumerate(SHIFTS):
        (tmp_path / str(number)).mkdir()
        case = archive_cases.build(
            tmp_path / str(number), scan + np.array(shift), voxel=4.0, radius=0.02, resolution=2.0**-14
        )
        poses = np.array([archive_cases.pose_of(np.eye(3), place + shift) for place in places])
        with Scene.open(case.archive, level_bytes=0, open_store=UnreadableStore) as scene:
            scene.add_avatar("body", body, 0.01)
            bounds = scene.distance("body", poses, 4.0)
        assert (bounds.voxels_missing == 1).all() and np.isinf(bounds.upper).all()
        assert (bounds.lower <= true).all() and bounds.lower.min() > 0.2
        found.append(bounds.lower)
    assert np.ptp(found, axis=0).max() <= 2.0**-20


@pytest.mark.case(
    33, "a share of 1e-9 to 1,000 allowed, spheres 20 cm deep to 1 m apart: errors, bounds and verdicts"
)
def test_case_33_a_share_of_nothing_allows_a_millimetre(tmp_path: Path, rng: np.random.Generator) -> None:
    """A row of points beside the nearest one, each a little farther, tempts the search to end early."""
    row = np.column_stack([np.linspace(0, 1, 200), np.zeros(200), -(np.linspace(0, 0.3, 200) ** 2)])
    case = archive_cases.build(
        tmp_path, row, radius=0.1, resolution=2.0**-14, leaf=4, degree=3, cell_points=20
    )
    heights = [0.0, 1e-7, 1e-4, 0.001, 0.05, 0.1, 0.1999, 0.2, 0.2001, 0.201, 0.3, 1.2]
    poses = np.array([archive_cases.pose_of(np.eye(3), np.array([0.0, 0.0, z])) for z in heights])
    body = np.concatenate([np.zeros((1, 3)), rng.uniform(0, 0.05, (60, 3))])
    with Scene.open(case.archive) as scene:
        scene.add_avatar("ball", body, 0.1)
        exact = scene.distance("ball", poses, 2.0)
        assert exact.signed_distance.min() < -0.15 and exact.signed_distance.max() > 0.8
        for share in (1e-9, 0.01, 0.3, 1.0, 1000.0):
            loose = scene.distance("ball", poses, 2.0, relative_tolerance=share)
            allowed = np.maximum(1e-3, share * (exact.signed_distance + 0.2))
            assert (loose.signed_distance >= exact.signed_distance).all()
            assert (loose.signed_distance <= exact.signed_distance + allowed).all()
            assert (loose.lower <= exact.signed_distance).all() and (
                loose.upper >= exact.signed_distance
            ).all()
            assert (loose.upper - loose.lower <= allowed + 1e-6).all()
            known = loose.verdict != Verdict.UNKNOWN
            assert (loose.verdict[known] == exact.verdict[known]).all()
            assert (loose.verdict[~known] == Verdict.UNKNOWN).all() and (loose.upper[~known] > 0).all()


@pytest.mark.case(
    34, "budgets of 0, 1 and 2 visits for every query that takes one: bounds hold, none is clear unseen"
)
@pytest.mark.parametrize("visits", [0, 1, 2])
def test_case_34_with_hardly_a_visit_bounds_hold(
    tmp_path: Path, rng: np.random.Generator, visits: int
) -> None:
    points = rng.uniform(0, 1, (300, 3)) * [1, 1, 0.1]
    case = archive_cases.build(tmp_path, points, voxel=0.4, leaf=4, degree=3, cell_points=30, radius=0.01)
    body = rng.uniform(-0.1, 0.1, (20, 3))
    poses = archive_cases.near_poses(rng, points, body, 20, 0.4)
    with Scene.open(case.archive) as scene:
        scene.add_avatar("body", body, 0.01)
        signed = scene.distance("body", poses, 3.0).signed_distance
        touch = scene.collide("body", poses, budget_visits=visits)
        assert (touch.lower <= np.minimum(signed, 0.0)).all() and (touch.upper >= signed).all()
        assert (signed[touch.verdict == Verdict.CLEAR] > 0).all()
        assert (signed[touch.verdict == Verdict.CONTACT] <= 0).all()
        assert (touch.node_visits <= visits).all() and (touch.verdict == Verdict.UNKNOWN).any()
        near = scene.distance("body", poses, 3.0, budget_visits=visits)
        assert (near.lower <= signed).all() and (near.upper >= signed).all()
        assert (signed[near.verdict == Verdict.CLEAR] > 0).all() and (near.node_visits <= visits).all()
        moves = scene.sweep("body", poses[:-1], poses[1:], budget_visits=visits)
        full = scene.sweep("body", poses[:-1], poses[1:])
        assert (moves.lower <= full.upper).all()
        assert (full.verdict[moves.verdict == Verdict.CLEAR] == Verdict.CLEAR).all()
        at = poses[:, :3, 3].copy()
        true, found = scene.within(at, 2.0), scene.within(at, 2.0, budget_visits=visits)
        assert (found.lower <= true.distance).all() and (found.upper >= true.distance).all()
        down = np.tile([0.0, 0.0, -1.0], (len(at), 1))
        true, found = scene.raycast(at, down, 5.0), scene.raycast(at, down, 5.0, budget_visits=visits)
        assert (found.lower <= np.where(np.isinf(true.distance), 5.0, true.distance)).all()
        assert (true.verdict[found.verdict == Verdict.CLEAR] == Verdict.CLEAR).all()
