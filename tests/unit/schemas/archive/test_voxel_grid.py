"""Test world, lattice and voxel frames: half-open cells, negative coordinates, exact bits, keys."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from solidcloud.schemas.archive.units import UNITS_PER_METRE
from solidcloud.schemas.archive.voxel_grid import (
    KEY_BIAS,
    MAX_VOXEL_STEPS,
    make_lattice,
    voxel_coordinates,
    voxel_keys,
)
from solidcloud.schemas.errors import BadRequestError

UTM = (512345.678901, 5612345.123456, -7.25)
VOXEL_COORDINATES = st.tuples(*[st.integers(-KEY_BIAS, KEY_BIAS - 1)] * 3)


def test_multiples_of_the_voxel_size_open_their_own_voxel() -> None:
    # NUMERICS.md case 10: floor(x / s) is another integer for 7 % of x = i * s.
    lattice = make_lattice((0, 0, 0), 0.001, 0.3)
    i = np.arange(-2000, 2001)
    borders = np.repeat(i[:, None] * 0.3, 3, axis=1)
    assert np.array_equal(
        lattice.to_lattice(borders) // lattice.voxel_steps, np.repeat(i[:, None], 3, axis=1)
    )


def test_the_origin_keeps_its_bits() -> None:
    odd = (0.1 + 0.2, np.nextafter(5.6e6, 0), -1e-300)
    lattice = make_lattice(odd, 0.0001, 8.0)
    assert np.array(lattice.origin).tobytes() == np.array(odd).tobytes()
    assert lattice.to_world([[0, 0, 0]]).tobytes() == np.array(odd).tobytes()


def test_quantising_rounds_half_to_even() -> None:
    lattice = make_lattice((0, 0, 0), 0.5, 8.0)
    found = lattice.to_lattice(np.array([[0.25, 0.75, 1.25], [-0.25, -0.75, 0.26]]))
    assert found.tolist() == [[0, 2, 2], [0, -2, 1]]


@given(st.integers(-(2**36), 2**36), st.sampled_from([0.0001, 0.001, 0.00025, 2.0**-10]))
def test_lattice_points_come_back_from_the_world(steps: int, step: float) -> None:
    lattice = make_lattice(UTM, step, 1.0)
    assert lattice.to_lattice(lattice.to_world([[steps, -steps, 0]])).tolist() == [[steps, -steps, 0]]


def test_world_positions_are_within_a_rounding_of_the_formula() -> None:
    lattice = make_lattice(UTM, 0.0001, 8.0)
    steps = np.random.default_rng(3).integers(-(10**7), 10**7, (50, 3))
    for row, world in zip(steps.tolist(), lattice.to_world(steps).tolist(), strict=True):
        for k in range(3):
            exact = Fraction(row[k]) * Fraction(0.0001) + Fraction(UTM[k])
            assert abs(Fraction(world[k]) - exact) <= Fraction(float(np.spacing(abs(world[k]))))


@given(st.lists(VOXEL_COORDINATES, min_size=1, max_size=20, unique=True))
def test_keys_are_a_bijection(voxels: list[tuple[int, int, int]]) -> None:
    keys = voxel_keys(np.array(voxels))
    assert np.array_equal(voxel_coordinates(keys), voxels)
    assert len(set(keys.tolist())) == len(voxels)
    assert max(keys.tolist()) < 2**63


@pytest.mark.parametrize("far", [KEY_BIAS, -KEY_BIAS - 1])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_voxel_too_far_out_is_refused(far: int, axis: int) -> None:
    voxels = np.zeros((3, 3), np.int64)
    voxels[1, axis] = far
    with pytest.raises(BadRequestError, match=rf"voxel coordinates.*{far}.*larger --voxel"):
        voxel_keys(voxels)


@pytest.mark.parametrize(
    ("step", "voxel", "message"),
    [
        (0.0, 8.0, "lattice step"),
        (-1.0, 8.0, "lattice step"),
        (9e-7, 8.0, "lattice step"),
        (float("nan"), 8.0, "lattice step"),
        (float("inf"), 8.0, "lattice step"),
        (0.1, 0.0, "voxel size"),
        (0.1, -1.0, "voxel size"),
        (0.1, float("nan"), "voxel size"),
        (0.1, 0.04, "is less than a lattice step"),
    ],
)
def test_impossible_sizes_are_refused(step: float, voxel: float, message: str) -> None:
    with pytest.raises(BadRequestError, match=message):
        make_lattice((0, 0, 0), step, voxel)


def test_a_voxel_is_a_whole_number_of_steps() -> None:
    lattice = make_lattice((0, 0, 0), 0.0003, 1.0)
    assert lattice.voxel_steps == 3333
    assert lattice.voxel_size == 3333 * 0.0003
    assert make_lattice((0, 0, 0), 1.0, MAX_VOXEL_STEPS).voxel_steps == MAX_VOXEL_STEPS
    assert lattice.units_per_step == 0.0003 * 2**26 == 0.0003 * UNITS_PER_METRE
