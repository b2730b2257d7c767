"""Compare the points of chosen cubes and the occupied voxels with plain numpy."""

import numpy as np
import pytest
from solidcloud.builder.kernels.points.occupied_cubes import FREE, find_cube_points, insert_all

MOST = (1 << 20) - 1


def keys_of(voxels: np.ndarray) -> np.ndarray:
    x, y, z = (np.clip(voxels, -MOST, MOST) + MOST).T
    return (x << 42) | (y << 21) | z


@pytest.mark.parametrize("voxel_steps", [1, 7, 64, 1000])
def test_cubes_and_voxels_are_those_of_numpy(voxel_steps: int, rng: np.random.Generator) -> None:
    origin, step = np.array([3.0, -4.0, 0.5]), 0.25
    steps = rng.integers(-3 * voxel_steps, 3 * voxel_steps, (3000, 3))
    xyz = origin + steps * step + rng.uniform(-0.1, 0.1, steps.shape)
    voxels, at = steps // voxel_steps, steps % voxel_steps
    drawn = rng.choice(3000, 12, replace=False)
    shifts = rng.integers(0, 6, 12)
    cubes = at[drawn] >> shifts[:, None]
    chosen = np.unique(np.column_stack([keys_of(voxels[drawn]), cubes, shifts]), axis=0)
    # A point in two cubes, one in the other, is the first one's.
    expected = np.full(3000, -1)
    for slot in reversed(range(len(chosen))):
        key, cube, shift = chosen[slot, 0], chosen[slot, 1:4], chosen[slot, 4]
        expected[(keys_of(voxels) == key) & (at >> shift == cube).all(axis=1)] = slot
    table, known = np.full(1 << 10, FREE), np.zeros(1, np.int64)
    picked, slots, local = np.empty(3000, np.int64), np.empty(3000, np.int64), np.empty((3000, 3), np.int64)
    count, done = find_cube_points(xyz, origin, step, voxel_steps, chosen, table, known, picked, slots, local)
    assert done == 3000
    assert np.array_equal(picked[:count], np.flatnonzero(expected >= 0))
    assert np.array_equal(slots[:count], expected[expected >= 0])
    assert np.array_equal(local[:count], at[expected >= 0])
    found = np.sort(table[table != FREE])
    assert np.array_equal(found, np.unique(keys_of(voxels))) and known[0] == len(found)


def test_a_full_table_ends_it_and_a_larger_one_goes_on() -> None:
    xyz = np.arange(40.0)[:, None] * np.ones(3)
    table, known = np.full(16, FREE), np.zeros(1, np.int64)
    none, out = (
        np.empty((0, 5), np.int64),
        (np.empty(40, np.int64), np.empty(40, np.int64), np.empty((40, 3), np.int64)),
    )
    assert find_cube_points(xyz, np.zeros(3), 1.0, 1, none, table, known, *out) == (0, 12)
    assert known[0] == np.count_nonzero(table != FREE) == 12
    larger = np.full(64, FREE)
    insert_all(table, larger)
    assert find_cube_points(xyz[12:], np.zeros(3), 1.0, 1, none, larger, known, *out) == (0, 28)
    assert np.array_equal(np.sort(larger[larger != FREE]), np.unique(keys_of(xyz.astype(np.int64))))


def test_voxels_beyond_the_edge_are_counted_as_at_it() -> None:
    xyz = np.array([[1e7, -1e7, 0.0], [2e7, -2e7, 0.0]])
    table, known = np.full(16, FREE), np.zeros(1, np.int64)
    out = (np.empty(2, np.int64), np.empty(2, np.int64), np.empty((2, 3), np.int64))
    find_cube_points(xyz, np.zeros(3), 1.0, 1, np.empty((0, 5), np.int64), table, known, *out)
    assert known[0] == 1 and table.max() == keys_of(np.array([[MOST, -MOST, 0]]))[0]
