"""Test scans in other units, with another axis up and at a given pose: coordinates, bits and lattice."""

from pathlib import Path

import numpy as np
import pytest
import synthetic_scans
from scan_formats import ptx_scan, write_e57
from solidcloud.builder.sources.common.scan import Scan
from solidcloud.builder.sources.placed_scan import TURNS, place_scan
from solidcloud.builder.sources.scan_files import open_scans

TURN = np.array([[0.0, -1, 0, 10], [1, 0, 0, 20], [0, 0, 1, 30], [0, 0, 0, 1]])


def read(scan: Scan, block_points: int = 1 << 18) -> np.ndarray:
    return np.concatenate([np.empty((0, 3)), *(block.xyz for block in scan.blocks(block_points))])


@pytest.fixture
def las(tmp_path: Path) -> Scan:
    raw = np.random.default_rng(1).integers(-(10**6), 10**6, (500, 3))
    synthetic_scans.write_las(tmp_path / "a.las", raw, offset=(1000.0, -500.0, 30.5))
    return open_scans(tmp_path / "a.las")[0]


@pytest.mark.parametrize("up", TURNS)
def test_the_axis_that_is_up_becomes_z_by_a_turn(up: str, las: Scan) -> None:
    before, after = read(las), read(place_scan(las, up=up))
    assert np.array_equal(after[:, 2], before[:, "xyz".index(up)])
    turn = place_scan(las, up=up).pose[:3, :3]
    assert np.linalg.det(turn) == 1 and np.array_equal(before @ turn.T, after)


@pytest.mark.parametrize("up", TURNS)
@pytest.mark.parametrize("units", ["m", "us-ft", "m+ft"])
def test_a_turned_or_scaled_scan_stays_on_its_lattice_and_a_posed_one_does_not(
    units: str, up: str, las: Scan
) -> None:
    turned = place_scan(las, up=up, units=units)
    assert turned.lattice is not None
    steps = (read(turned) - turned.lattice.offset) / turned.lattice.scale
    assert np.abs(steps - np.rint(steps)).max() < 1e-6
    assert place_scan(las, up=up, pose=TURN).lattice is None


def test_units_then_axes_then_the_pose(las: Scan) -> None:
    moved = place_scan(las, units="cm", up="y", pose=TURN)
    x, y, z = (read(las) * 0.01).T
    assert np.abs(read(moved) - np.column_stack([10 + z, 20 + x, 30 + y])).max() < 1e-12
    homogeneous = np.column_stack([read(las), np.ones(500)]) @ moved.pose.T
    assert np.abs(homogeneous[:, :3] - read(moved)).max() < 1e-10
    assert (moved.units, moved.up, moved.format, moved.declared_count) == ("cm", "y", "las", 500)


@pytest.mark.parametrize("up", TURNS)
def test_heights_may_have_a_unit_of_their_own(up: str, las: Scan) -> None:
    turned = read(place_scan(las, up=up))
    assert np.array_equal(read(place_scan(las, up=up, units="m+us-ft")), turned * [1, 1, 1200 / 3937])
    assert np.array_equal(
        read(place_scan(las, up=up, units="0.3047972654+2.0")), turned * [0.3047972654, 0.3047972654, 2]
    )


@pytest.mark.parametrize("up", TURNS)
def test_bounds_hold_all_points(up: str, las: Scan) -> None:
    for options in ({}, {"units": "ft"}, {"pose": TURN}, {"units": "in", "pose": TURN, "scale": 7.0}):
        moved = place_scan(las, up=up, **options)
        xyz = read(moved)
        assert moved.bounds is not None
        assert (moved.bounds[0] <= xyz).all() and (xyz <= moved.bounds[1]).all()
        assert np.abs(moved.bounds - [xyz.min(axis=0), xyz.max(axis=0)]).max() < 1e-5


def test_a_given_pose_takes_the_place_of_a_scans_own(tmp_path: Path) -> None:
    path = tmp_path / "a.ptx"
    xyz = np.random.default_rng(2).uniform(-5, 5, (20, 3))
    xyz[3] = 0
    path.write_text(ptx_scan(xyz, np.ones(20), TURN))
    (scan,) = open_scans(path)
    own = read(scan)
    xyz = np.delete(xyz, 3, axis=0)
    assert place_scan(scan, pose=TURN) is scan  # as the list of scans has it, unless it was edited
    bare = place_scan(scan, pose=np.eye(4))
    assert np.array_equal(read(bare), xyz) and bare.dropped == {"no return": 1}
    other = TURN.copy()
    other[:3, 3] = [1, 2, 3]
    assert np.abs(read(place_scan(scan, pose=other)) - (own - [9, 18, 27])).max() < 1e-12
    assert np.array_equal(read(place_scan(scan, units="mm")), own * 0.001)  # its own, in its own units
    assert np.array_equal(read(scan), own)  # the scan itself is as it was


def test_bounds_that_a_scans_own_pose_made_are_not_believed_at_another(tmp_path: Path) -> None:
    columns = {f"cartesian{axis}": np.arange(3.0) for axis in "XYZ"}
    scan = {"columns": columns, "translation": [5.0, 0, 0], "bounds": [[0, 0, 0], [2, 2, 2]]}
    (scan,) = open_scans(write_e57(tmp_path / "a.e57", [scan]))
    assert scan.bounds is not None
    assert place_scan(scan, pose=np.eye(4)).bounds is None
    assert place_scan(scan, units="cm").bounds is not None
