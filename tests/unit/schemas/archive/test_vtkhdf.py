"""Test files of points against the VTKHDF specification, and with VTK where it is installed."""

from pathlib import Path

import h5py
import numpy as np
import pytest
from solidcloud.schemas.archive.vtkhdf import VtkPoints, read_points
from solidcloud.schemas.errors import CorruptError

COLUMNS = {"scan": np.dtype("<u2"), "intensity": np.dtype("<f4")}


def points_and_columns(count: int) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Points at UTM coordinates, and their columns."""
    rng = np.random.default_rng(count)
    points = rng.integers(0, 1 << 20, (count, 3)) / 1024 + np.array([5e5, 5.6e6, 100])
    return points, {
        "scan": rng.integers(0, 1 << 16, count).astype("<u2"),
        "intensity": rng.random(count).astype("<f4"),
    }


def write(path: Path, count: int, *, compressed: bool, block: int = 1 << 15) -> None:
    """Write so many points, in blocks."""
    points, columns = points_and_columns(count)
    with (
        h5py.File(path, "w", libver=("v110", "v110")) as file,
        VtkPoints(file, COLUMNS, compressed=compressed) as out,
    ):
        for begin in range(0, count, block):
            some = slice(begin, begin + block)
            out.append(points[some], {name: column[some] for name, column in columns.items()})


@pytest.mark.parametrize("compressed", [True, False])
@pytest.mark.parametrize(("count", "block"), [(0, 1), (10, 3)])
def test_the_structure_is_that_of_the_specification(
    count: int, block: int, compressed: bool, tmp_path: Path
) -> None:
    path = tmp_path / "a.vtkhdf"
    write(path, count, compressed=compressed, block=block)
    points, columns = points_and_columns(count)
    with h5py.File(path) as file:
        root = file["VTKHDF"]
        assert root.attrs["Version"].tolist() == [2, 0] and root.attrs["Version"].dtype == "<i8"
        kind = root.attrs.get_id("Type").get_type()
        assert not kind.is_variable_str() and kind.get_cset() == h5py.h5t.CSET_ASCII
        assert root.attrs["Type"] == b"PolyData"
        assert root["NumberOfPoints"][()].tolist() == [count] and root["NumberOfPoints"].dtype == "<i8"
        assert root["Points"].dtype == "<f8" and root["Points"][()].tolist() == points.tolist()
        for name in ("Vertices", "Lines", "Polygons", "Strips"):
            group, held = root[name], count if name == "Vertices" else 0
            assert {dataset.dtype.str for dataset in group.values()} == {"<i8"}
            assert (
                group["NumberOfCells"][()].tolist() == group["NumberOfConnectivityIds"][()].tolist() == [held]
            )
            assert group["Offsets"][()].tolist() == list(range(held + 1))
            assert group["Connectivity"][()].tolist() == list(range(held))
        assert sorted(root["PointData"]) == ["intensity", "scan"]
        for name, column in columns.items():
            assert root["PointData"][name].dtype == COLUMNS[name]
            assert root["PointData"][name][()].tolist() == column.tolist()


@pytest.mark.parametrize("compressed", [True, False])
def test_what_was_written_is_read(compressed: bool, tmp_path: Path) -> None:
    write(tmp_path / "a.vtkhdf", 1000, compressed=compressed)
    points, columns = points_and_columns(1000)
    found = read_points(tmp_path / "a.vtkhdf")
    assert found.points.tolist() == points.tolist()
    assert {name: column.tolist() for name, column in found.columns.items()} == {
        name: column.tolist() for name, column in columns.items()
    }


def test_what_is_no_file_or_no_hdf5_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        read_points(tmp_path / "none")
    (tmp_path / "text").write_text("VTKHDF")
    with pytest.raises(CorruptError, match="not a complete file of points"):
        read_points(tmp_path / "text")
