"""The broad phase by its kernels alone: the voxels listed are those whose boxes a ball touches, and no others."""

from typing import NamedTuple

import archive_cases
import numpy as np
import pytest
from numpy.typing import NDArray
from solidcloud.schemas.archive.voxel_grid import KEY_BIAS
from solidcloud.schemas.kernels.morton import morton_encode
from solidcloud.server.kernels.core.voxels_in_reach import (
    SceneIndex,
    VoxelsInReach,
    voxels_in_reach,
)

pytestmark = pytest.mark.interpreted

STEP, VOXEL_STEPS = 2.0**-10, 100
UNITS_PER_STEP = STEP * 2.0**26


class Lattice(NamedTuple):
    """What the broad phase reads of a scene's arrays."""

    origin: NDArray[np.float64]
    step: float
    units_per_step: float
    voxel_steps: int
    stop: NDArray[np.int64]


class Root(NamedTuple):
    """What it reads of an avatar."""

    center: NDArray[np.float64]
    radius: NDArray[np.float64]


SCENE = Lattice(np.array([10.0, -20.0, 30.0]), STEP, UNITS_PER_STEP, VOXEL_STEPS, np.zeros(1, np.int64))
AVATAR = Root(np.array([[0.25, 0.5, -0.125]]), np.array([0.03]))


def scattered(rng: np.random.Generator, side: int, count: int) -> SceneIndex:
    """Voxels about the origin of the lattice, each with a box of points inside it."""
    coordinates = np.unique(rng.integers(-side, side, (count, 3)), axis=0)
    keys = morton_encode((coordinates + KEY_BIAS).astype(np.uint64))
    order = np.argsort(keys)
    base = coordinates[order] * VOXEL_STEPS
    ends = np.sort(rng.integers(0, VOXEL_STEPS, (2, len(base), 3)), axis=0)
    low, high = base + ends[0], base + ends[1]
    return SceneIndex(keys[order], low, high, low.min(axis=0), high.max(axis=0))


def room(poses: int, rows: int, units: int) -> VoxelsInReach:
    """A reach to be filled."""
    return VoxelsInReach(
        np.full(poses, units), np.full(poses + 1, -1), np.full(rows, -1),
        np.full((poses, 2, 3), np.nan), np.ones(poses, bool),
    )  # fmt: skip


def spans(poses: NDArray[np.float64], units: int) -> tuple[NDArray[np.float64], float]:
    """Where the root's centres are, and how far the reach goes [steps], widened as documented."""
    center = (poses[:, :3, :3] @ AVATAR.center[0] + (poses[:, :3, 3] - SCENE.origin)) / STEP
    span = (AVATAR.radius[0] / STEP + units / UNITS_PER_STEP) * (1 + 1e-6) + 1.0
    return center, span


@pytest.mark.parametrize(("side", "count"), [(2, 20), (3, 150), (12, 60), (2, 1)])
def test_the_voxels_listed_are_those_whose_box_a_ball_touches(side: int, count: int) -> None:
    rng = np.random.default_rng([side, count])
    index = scattered(rng, side, count)
    poses = []
    for i in range(30):
        turn = archive_cases.random_rotation(rng)
        at = rng.uniform(-side - 1, side + 1, 3) * VOXEL_STEPS * STEP
        if i % 2:
            at = (index.low[rng.integers(len(index.low))] + rng.uniform(-30, 30, 3)) * STEP
        poses.append(archive_cases.pose_of(turn, SCENE.origin + at - turn @ AVATAR.center[0]))
    stack, units = np.array(poses), int(0.02 * 2**26)
    reach = room(len(stack), 4000, units)
    needed = voxels_in_reach(stack, AVATAR, SCENE, index, reach)
    center, span = spans(stack, units)
    assert needed == reach.starts[-1] and reach.starts[0] == 0
    assert (reach.rows[needed:] == -1).all() and (reach.rows[:needed] >= 0).all()
    met = 0
    for i in range(len(stack)):
        rows = reach.rows[reach.starts[i] : reach.starts[i + 1]].tolist()
        gap = np.maximum(np.maximum(index.low - center[i], center[i] - index.high), 0)
        apart = np.sqrt((gap**2).sum(axis=1))
        assert set(np.flatnonzero(apart <= span).tolist()) <= set(rows)
        assert set(rows) <= set(np.flatnonzero(apart <= span + 1e-6).tolist()) and len(set(rows)) == len(rows)
        met += len(rows)
        box = np.stack([center[i] - span, center[i] + span])
        assert np.abs(reach.boxes[i] - box).max() <= 1e-6
        inside = (box[0] >= index.scene_low).all() and (box[1] <= index.scene_high).all()
        assert reach.outside[i] == (not inside)
    assert met > 0
    # With room for fewer, those that fit are the same, and as many are said to be needed.
    few = room(len(stack), needed // 2, units)
    assert voxels_in_reach(stack, AVATAR, SCENE, index, few) == needed
    assert few.starts.tolist() == reach.starts.tolist()
    assert few.rows.tolist() == reach.rows[: needed // 2].tolist()


def test_rounding_far_from_the_origin_is_added_to_the_reach() -> None:
    """Terms of 10^9 m leave 2^-49 of them in doubt: two micrometres, which the reach is wider by."""
    low = np.zeros((1, 3), np.int64)
    index = SceneIndex(morton_encode(np.full((1, 3), KEY_BIAS, np.uint64)), low, low, low[0], low[0])
    far = Root(np.array([[2.0**29, 0.0, 0.0]]), np.zeros(1))
    widened = 2.0**30 / STEP * 2.0**-49
    for away, listed in ((1.0 + widened * 0.75, 1), (1.0 + widened * 1.25, 0)):
        pose = archive_cases.pose_of(np.eye(3), SCENE.origin)
        pose[0, 3] = -(2.0**29)
        scene = SCENE._replace(origin=np.zeros(3))
        pose[:, 3] = [-(2.0**29), 0.0, away * STEP, 1.0]
        reach = room(1, 4, 0)
        assert voxels_in_reach(pose[None], far, scene, index, reach) == listed
