"""Compare the work of survey and spool on each point with plain integers and the lattice's numpy."""

from typing import Any

import numpy as np
import pytest
from solidcloud.builder.kernels.points.content_hash import content_sum
from solidcloud.builder.kernels.points.spool_rows import CHUNK, FREE, place_points, rehash, usable_bounds
from solidcloud.schemas.archive.voxel_grid import KEY_BIAS, Lattice, make_lattice, voxel_keys

pytestmark = pytest.mark.interpreted

SEEDS = np.array([3, (1 << 64) - 5], np.uint64)


def table(room: int) -> tuple[Any, ...]:
    """An empty voxel table of `room` places."""
    return (
        np.full(room, FREE),
        np.empty(room, np.int32),
        np.empty(room // 2, np.uint64),
        np.zeros(1, np.int64),
    )


def placed(xyz: np.ndarray, lattice: Lattice, voxels: tuple[Any, ...], more: np.ndarray) -> tuple[Any, ...]:
    """`place_points` and what it wrote."""
    numbers, codes = np.full(len(xyz), -1, np.int32), np.zeros(len(xyz), np.uint64)
    sums = np.array([5, 7, 9], np.uint64)
    origin = np.array(lattice.origin)
    told = place_points(
        xyz, origin, lattice.step, lattice.voxel_steps, KEY_BIAS, more, SEEDS, voxels, numbers, codes, sums
    )
    return (*told, numbers, codes, sums)


def code(local: np.ndarray) -> int:
    """The Morton code, bit by bit."""
    return sum((int(v) >> bit & 1) << (3 * bit + axis) for axis, v in enumerate(local) for bit in range(21))


def test_usable_points_are_counted_and_bounded() -> None:
    wrong = [[np.nan, 9, 9], [9, np.inf, 9], [9, 9, -np.inf], [8.1, 0, 0], [0, -8.1, 0], [0, 0, 8.1]]
    xyz = np.array([[1.0, -2, 3], *wrong, [0.5, 4, 8]])
    low, high = np.full(3, 2.0), np.full(3, 3.0)
    assert usable_bounds(xyz, 8.0, low, high) == 2
    assert low.tolist() == [0.5, -2, 2]
    assert high.tolist() == [3, 4, 8]
    # What is known before stays where nothing lies beyond it.
    for known in (xyz[:0], np.zeros((1, 3)), xyz[1:4]):
        low, high = np.array([-1.0, -2, -3]), np.array([4.0, 5, 6])
        assert usable_bounds(known, 8.0, low, high) == (len(known) == 1)
        assert (low.tolist(), high.tolist()) == ([-1, -2, -3], [4, 5, 6])


@pytest.mark.parametrize("steps", [1, 3, 7, 80, 2**21])
def test_points_are_placed_as_the_lattice_says(steps: int) -> None:
    rng = np.random.default_rng(steps)
    lattice = make_lattice((0.3, -1e4, 7.7), 0.01, steps * 0.01)
    near = rng.integers(-3 * steps, 3 * steps + 1, (40, 3))  # on voxels' borders too
    near[:20] = near[:20] // steps * steps
    xyz = lattice.to_world(near) + rng.uniform(-0.004, 0.004, (40, 3))
    xyz[0] += 0.005  # half a step, about: to even
    more = rng.integers(0, 1 << 64, (2, 40), np.uint64)
    voxels = table(1 << 14)
    done, moved, lowest, highest, numbers, codes, sums = placed(xyz, lattice, voxels, more)
    expected = lattice.to_lattice(xyz)
    at = expected // lattice.voxel_steps
    assert done == 40
    assert moved == np.abs(lattice.to_world(expected) - xyz).max()
    assert (lowest, highest) == (at.min(), at.max())
    known, count = voxels[2], int(voxels[3][0])
    assert known[numbers].tolist() == voxel_keys(at).tolist()
    assert len(set(known[:count].tolist())) == count == len(set(numbers.tolist()))
    assert codes.tolist() == [code(local) for local in expected - at * lattice.voxel_steps]
    columns = np.concatenate([expected.T.astype(np.uint64), more])
    for k, seed in enumerate(SEEDS):
        assert int(sums[k]) == (int(content_sum(columns, seed)) + (5, 7)[k]) % (1 << 64)
    assert int(sums[2]) == (int(content_sum(columns[:3], SEEDS[0])) + 9) % (1 << 64)


def test_no_more_points_are_taken_than_the_table_has_room_for() -> None:
    lattice = make_lattice((0, 0, 0), 1.0, 1.0)
    xyz = np.arange(3.0 * (CHUNK + 1)).reshape(-1, 3)
    none = np.empty((0, len(xyz)), np.uint64)
    assert placed(xyz, lattice, table(2 * CHUNK - 2), none)[0] == 0
    voxels = table(2 * CHUNK)
    assert placed(xyz, lattice, voxels, none)[0] == CHUNK
    assert int(voxels[3][0]) == CHUNK
    larger = table(8 * CHUNK)
    larger[2][:CHUNK], larger[3][0] = voxels[2][:CHUNK], CHUNK
    rehash(larger[2], CHUNK, larger[0], larger[1])
    numbers = placed(xyz[::-1].copy(), lattice, larger, none)[4]
    # Known ones keep their numbers, the one that is new has the next.
    assert numbers[::-1].tolist() == [*range(CHUNK), CHUNK]
