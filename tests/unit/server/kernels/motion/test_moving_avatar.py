"""An avatar at both ends of a chord, by the kernels alone: where it is, its ways, and what its bounds allow for."""

from typing import NamedTuple

import archive_cases
import numpy as np
import pytest
from numpy.typing import NDArray
from solidcloud.server.avatars.avatar_model import make_avatar
from solidcloud.server.kernels.motion import moving_avatar as kernel

pytestmark = pytest.mark.interpreted

U32 = 2.0**-24
STEP = 2.0**-10


class Lattice(NamedTuple):
    """What placing reads of a scene."""

    origin: NDArray[np.float64]
    step: float


SCENE = Lattice(np.array([7.0, -50.0, 300.0]), STEP)


@pytest.mark.parametrize("far", [0.0, 1e6])
@pytest.mark.parametrize(("way", "more"), [(0.0, 0.0), (0.05, 0.0), (3.0, 2.0)])
@pytest.mark.parametrize("turns", [True, False])
def test_an_avatar_is_placed_at_both_ends(
    rng: np.random.Generator, far: float, way: float, more: float, turns: bool
) -> None:
    """more: by how much farther than its nodes' centres some point may go, a part of the speed given [m]."""
    model = make_avatar(rng.uniform(-0.4, 0.4, (100, 3)), 0.01)
    avatar, found = model.arrays, kernel.make_moving(model.arrays)
    at = SCENE.origin + rng.uniform(-1, 1, 3) * far
    ends = [archive_cases.pose_of(archive_cases.random_rotation(rng), at + d * way) for d in (-1.0, 1.0)]
    if not way:
        ends[1] = ends[0]
    elif not turns:
        ends[1][:3, :3] = ends[0][:3, :3]
    moved = way > 0 and turns
    found.ends[0], found.ends[1] = ends
    shifts = [pose[:3, 3] - SCENE.origin for pose in ends]
    exact = [
        (avatar.center @ pose[:3, :3].T + shift) / STEP for pose, shift in zip(ends, shifts, strict=True)
    ]
    ways = exact[1] - exact[0]
    fastest = float(np.sqrt((ways**2).sum(axis=1)).max())
    speed = (fastest + more / STEP) * STEP if more else fastest * STEP * 0.5
    extent, farthest = kernel.place_nodes(avatar, speed, found, SCENE)

    assert found.shifts.tolist() == [shift.tolist() for shift in shifts]
    assert found.frame.tolist() == np.rint((exact[0][0] + exact[1][0]) / 2).astype(int).tolist()
    largest = max(
        (np.abs(pose[:3, :3] * avatar.center[0]).sum(axis=1) + np.abs(shift)).max()
        for pose, shift in zip(ends, shifts, strict=True)
    )
    longest = max(fastest, speed / STEP) * (1 + 1e-6)
    size = avatar.radius[0] / STEP + 1 + longest
    # Without a turn, a coordinate is the sum of two that were rounded.
    roundings = 1 if moved else 3
    assert extent == pytest.approx(roundings * size + kernel.CHORD_ERROR * longest, rel=1e-7)
    assert farthest == pytest.approx(roundings * (largest / STEP + size), rel=1e-7)

    rounding = roundings * size * U32 + farthest * 2.0**-49
    assert np.abs(found.nodes[:3].T - (exact[0] - found.frame)).max() <= rounding
    assert np.abs(found.nodes[4:7].T - ways).max() <= rounding
    inverse = np.array(
        [1 / s if s > 1e-20 else 0.0 for s in (found.nodes[4:7].astype(float) ** 2).sum(axis=0)]
    )
    assert np.abs(found.nodes[7] - inverse).max() <= 8 * U32 * inverse.max()
    wide = found.nodes[3] - avatar.radius / STEP
    assert (wide >= size * U32).all() and wide.max() <= 3e-6 * size
    assert (found.stamp == -1).all()
    for block in range(len(avatar.points)):
        found.lanes[:] = found.displacements[:] = np.nan
        kernel.place_block(avatar, block, found, SCENE)
        points = [
            avatar.points[block].T @ pose[:3, :3].T + shift for pose, shift in zip(ends, shifts, strict=True)
        ]
        lanes, along = points[0] / STEP - found.frame, (points[1] - points[0]) / STEP
        assert np.abs(found.lanes[block].T - lanes).max() <= rounding
        assert np.abs(found.displacements[block, :3].T - along).max() <= rounding
        assert np.isnan(np.delete(found.displacements, block, axis=0)).all()


def test_an_avatar_is_turned_once_for_each_orientation_and_step(rng: np.random.Generator) -> None:
    model = make_avatar(rng.uniform(-0.4, 0.4, (100, 3)), 0.01)
    avatar, kept = model.arrays, kernel.make_moving(model.arrays)
    turns = [archive_cases.random_rotation(rng) for _ in range(2)]
    orientations = []
    for turn, step in [(0, STEP), (0, STEP), (1, STEP), (0, STEP), (0, 2 * STEP)]:
        scene, fresh = Lattice(SCENE.origin, step), kernel.make_moving(avatar)
        begin, end = (
            archive_cases.pose_of(turns[turn], SCENE.origin + rng.uniform(-1, 1, 3)) for _ in range(2)
        )
        for moving in (kept, fresh):
            moving.ends[0], moving.ends[1] = begin, end
            kernel.place_nodes(avatar, 2.0, moving, scene)
            for block in range(len(avatar.points)):
                kernel.place_block(avatar, block, moving, scene)
        for name in ("nodes", "lanes", "displacements", "frame"):
            assert getattr(kept, name).tobytes() == getattr(fresh, name).tobytes(), name
        orientations.append(int(kept.counters[3]))
    assert orientations == [1, 1, 2, 3, 4]
