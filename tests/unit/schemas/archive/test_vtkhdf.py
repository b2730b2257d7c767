"""Test files of points against the VTKHDF specification, and with VTK where it is installed."""

import errno
import os
from pathlib import Path

import h5py
import numpy as np
import pytest
import solidcloud.schemas.process.new_hdf5_file as new_hdf5_file_module
from solidcloud.schemas.archive.vtkhdf import VtkPoints, read_points, vtk_file
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
@pytest.mark.parametrize(("count", "block"), [(0, 1), (1, 1), (10, 3), (100_000, 40_000)])
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


def test_the_same_points_are_the_same_bytes_in_any_blocks(tmp_path: Path) -> None:
    for compressed in (True, False):
        for name, block in (("a", 1 << 15), ("b", 1 << 15)):
            write(tmp_path / name, 70_000, compressed=compressed, block=block)
        assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


@pytest.mark.parametrize("compressed", [True, False])
def test_what_was_written_is_read(compressed: bool, tmp_path: Path) -> None:
    write(tmp_path / "a.vtkhdf", 1000, compressed=compressed)
    points, columns = points_and_columns(1000)
    found = read_points(tmp_path / "a.vtkhdf")
    assert found.points.tolist() == points.tolist()
    assert {name: column.tolist() for name, column in found.columns.items()} == {
        name: column.tolist() for name, column in columns.items()
    }


def test_without_columns_there_are_none(tmp_path: Path) -> None:
    with vtk_file(tmp_path / "a", {}) as out:
        out.append(np.zeros((4, 3)), {})
    assert read_points(tmp_path / "a").columns == {}


@pytest.mark.parametrize("room", [0, 3000, 200_000, 900_000])
def test_a_full_disk_is_an_error_that_names_the_file(
    room: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first write that ends behind `room` fails, and all that come later."""
    real = os.pwrite

    def pwrite(descriptor: int, data: memoryview, offset: int) -> int:
        if offset + len(data) > room:
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(descriptor, data, offset)

    monkeypatch.setattr(new_hdf5_file_module.os, "pwrite", pwrite)
    points, appended = np.random.default_rng(1).random((40_000, 3)), 0
    path = tmp_path / "a.vtkhdf"
    with pytest.raises(OSError, match=r"No space left on device: .*a\.vtkhdf"), vtk_file(path, {}) as out:
        for _ in range(20):
            out.append(points, {})
            appended += 1
    # HDF5 writes when 8 MB have come together.
    assert appended < 15 and list(tmp_path.iterdir()) == []


def test_flipped_bytes_of_a_compressed_file_are_refused_or_mean_nothing(tmp_path: Path) -> None:
    path = tmp_path / "a.vtkhdf"
    write(path, 300, compressed=True)
    data, expected = path.read_bytes(), read_points(path)
    rng, refused = np.random.default_rng(1), 0
    for at in rng.integers(0, len(data), 300).tolist():
        broken = bytearray(data)
        broken[at] ^= 1 << int(rng.integers(8))
        path.write_bytes(broken)
        try:
            found = read_points(path)
        except CorruptError as error:
            assert str(error).startswith(str(path))
            refused += 1
        else:
            assert found.points.tobytes() == expected.points.tobytes()
            assert all(found.columns[n].tobytes() == c.tobytes() for n, c in expected.columns.items())
    assert refused > 100


@pytest.mark.parametrize(
    "spoil",
    [
        lambda root: root.attrs.modify("Version", np.array([3, 0])),
        lambda root: root["NumberOfPoints"].write_direct(np.array([11])),
        lambda root: root["Vertices/NumberOfCells"].write_direct(np.array([9])),
        lambda root: root["Lines/NumberOfCells"].write_direct(np.array([1])),
        lambda root: root["Vertices/Connectivity"].write_direct(np.arange(10)[::-1].copy()),
        lambda root: root.pop("Strips"),
        lambda root: root["PointData/scan"].resize(9, axis=0),
    ],
)
def test_what_is_not_one_vertex_a_point_is_refused(spoil: object, tmp_path: Path) -> None:
    path = tmp_path / "a.vtkhdf"
    write(path, 10, compressed=False)
    with h5py.File(path, "r+") as file:
        spoil(file["VTKHDF"])  # type: ignore[operator]
    with pytest.raises(CorruptError, match="not a complete file of points"):
        read_points(path)


def test_what_is_no_file_or_no_hdf5_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        read_points(tmp_path / "none")
    (tmp_path / "text").write_text("VTKHDF")
    with pytest.raises(CorruptError, match="not a complete file of points"):
        read_points(tmp_path / "text")


@pytest.mark.parametrize("compressed", [True, False])
@pytest.mark.parametrize("count", [0, 1, 5000])
def test_vtk_reads_it(count: int, compressed: bool, tmp_path: Path) -> None:
    vtk = pytest.importorskip("vtkmodules.vtkIOHDF", reason="the library vtk is not installed")
    support = pytest.importorskip("vtkmodules.util.numpy_support")
    path = tmp_path / "a.vtkhdf"
    write(path, count, compressed=compressed)
    reader = vtk.vtkHDFReader()
    assert reader.CanReadFile(str(path))
    reader.SetFileName(str(path))
    reader.Update()
    found = reader.GetOutputDataObject(0)
    assert found.GetNumberOfPoints() == found.GetNumberOfVerts() == found.GetNumberOfCells() == count
    if count:
        points, columns = points_and_columns(count)
        assert support.vtk_to_numpy(found.GetPoints().GetData()).tolist() == points.tolist()
        for name, column in columns.items():
            assert support.vtk_to_numpy(found.GetPointData().GetArray(name)).tolist() == column.tolist()
        ids = support.vtk_to_numpy(found.GetVerts().GetConnectivityArray())
        assert ids.tolist() == list(range(count))
