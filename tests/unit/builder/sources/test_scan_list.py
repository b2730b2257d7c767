"""Test scan lists: written, read back, edited by hand, invalid; and the files that a build opens."""

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scan_campaign import POSE, edit_list, read_points, write_campaign
from scan_formats import glb_document, glb_vertices, write_e57, write_glb
from solidcloud.builder.sources import scan_files
from solidcloud.builder.sources.common.scan import library_errors
from solidcloud.builder.sources.scan_files import inspect_scans, open_input_files
from solidcloud.builder.sources.scan_list import ScanEntry, read_scan_list, write_scan_list
from solidcloud.schemas.errors import BadRequestError, ScanError, SolidcloudError


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_campaign(tmp_path / "campaign")


def test_headers_say_what_scans_there_are(folder: Path) -> None:
    las, first, second, broken, text = inspect_scans([folder])
    assert (las.path, las.format, las.count, las.fault) == (folder / "a.las", "las", 50, "")
    assert las.bounds is not None and las.pose is None
    assert (first.index, first.format, first.count) == (0, "ptx", 20) and np.array_equal(first.pose, POSE)
    assert (second.index, second.count, second.pose) == (1, 7, None)
    assert "checksum" in broken.fault and broken.format == ""
    assert (text.format, text.count, text.sha256) == ("text", None, "")


def same(a: ScanEntry, b: ScanEntry) -> bool:
    arrays = all(
        np.array_equal(x, y) if x is not None and y is not None else x is y
        for x, y in ((a.bounds, b.bounds), (a.pose, b.pose))
    )
    names = ("index", "format", "count", "units", "up", "scale", "crs", "sha256", "use", "fault")
    return arrays and all(getattr(a, name) == getattr(b, name) for name in names) and a.path.samefile(b.path)


@pytest.mark.parametrize("place", ["scans.toml", "deep/scans.toml", "../scans.toml"])
def test_a_list_is_read_back_as_it_was_written(place: str, folder: Path) -> None:
    entries = inspect_scans([folder], with_sha256=True)
    odd = ScanEntry(
        folder / "a.las", 9, "las", 0, np.array([[0.1, 2, 3], [4, 5, 1e300]]), POSE, "us-ft", "y", 0.3, 'X["ü"]\n"',
        "ab", False, "why",
    )  # fmt: skip
    write_scan_list(folder / place, [*entries, odd])
    read = read_scan_list(folder / place)
    assert len(read) == 6 and all(map(same, [*entries, odd], read))


@pytest.mark.parametrize("code", ["utf-8-sig", "utf-16"])
def test_a_list_of_any_editor_is_read(code: str, folder: Path) -> None:
    """Issue 35."""
    write_scan_list(folder / "scans.toml", inspect_scans([folder]))
    (folder / "scans.toml").write_bytes((folder / "scans.toml").read_text("utf-8").encode(code))
    assert len(read_scan_list(folder / "scans.toml")) == 5


def test_paths_in_a_list_move_with_it(folder: Path, tmp_path: Path) -> None:
    write_scan_list(folder / "scans.toml", inspect_scans([folder / "a.las"]))
    assert 'path = "a.las"' in (folder / "scans.toml").read_text()
    folder.rename(tmp_path / "elsewhere")
    (item,) = open_input_files([tmp_path / "elsewhere" / "scans.toml"])
    assert item.path == tmp_path / "elsewhere" / "a.las" and len(read_points([item])) == 50


def test_what_is_edited_is_what_is_built(folder: Path) -> None:
    path = folder / "scans.toml"
    write_scan_list(path, inspect_scans([folder / "a.las", folder / "b.ptx"]))
    before = read_points(open_input_files([path]))
    assert np.array_equal(before, read_points(open_input_files([folder / "a.las", folder / "b.ptx"])))
    edit_list(path, {"units": "mm", "up": "y", "crs": "EPSG:2056"}, 0)
    edit_list(path, {"pose": np.eye(4).tolist()}, 1)
    edit_list(path, {"use": False}, 2)
    las, ptx = open_input_files([path])
    x, y, z = before[:50].T
    assert np.array_equal(read_points([las]), np.column_stack([x, -z, y]) * 0.001)
    assert (las.scans[0].crs, las.scans[0].units, las.scans[0].up) == ("EPSG:2056", "mm", "y")
    assert len(ptx.scans) == 1
    turned = read_points([ptx])
    assert (
        np.abs(
            before[50:70] - np.column_stack([10 - turned[:, 1], 20 + turned[:, 0], 30 + turned[:, 2]])
        ).max()
        < 1e-9
    )


def test_faults_are_kept_for_all_of_them_to_be_named(folder: Path) -> None:
    (folder / "e.las").write_bytes(b"LASF")
    write_scan_list(folder / "scans.toml", inspect_scans([folder]))
    edit_list(folder / "scans.toml", {"index": 5}, 2)
    for paths, bad in (([folder], 2), ([folder / "scans.toml"], 3)):
        found = open_input_files(paths)
        faults = {item.path.name: item.fault for item in found if item.fault}
        assert len(faults) == bad and "checksum" in faults["c.e57"] and "b'LASF'" in faults["e.las"]
    assert "holds 2 scans, expected one of index 5" in faults["b.ptx"]
    assert sum(len(item.scans) for item in found) == 2


def test_a_header_says_where_a_broken_scan_was_unless_the_list_puts_it_elsewhere(folder: Path) -> None:
    las = folder / "a.las"
    bounds = inspect_scans([las])[0].bounds
    las.write_bytes(las.read_bytes()[:600])
    write_scan_list(folder / "scans.toml", inspect_scans([las]))
    assert np.array_equal(open_input_files([folder / "scans.toml"])[0].region, bounds)
    assert np.array_equal(open_input_files([las])[0].region, bounds)
    edit_list(folder / "scans.toml", {"units": "ft"})
    assert np.allclose(open_input_files([folder / "scans.toml"])[0].region, bounds * 0.3048)
    edit_list(folder / "scans.toml", {"up": "y"})
    assert open_input_files([folder / "scans.toml"])[0].region is None


def test_a_scan_that_is_named_twice_is_refused(folder: Path, tmp_path: Path) -> None:
    """By its file and its folder, a link, or a list beside them; its points would count twice in silence."""
    las, link = folder / "a.las", tmp_path / "link.las"
    link.symlink_to(las)
    for twice in ([folder, las], [las, folder / "deep" / ".." / "a.las"], [las, link], [folder / "deep"] * 2):
        with pytest.raises(BadRequestError, match=r"scan 0 is named twice, as that of .*: leave one out"):
            open_input_files(twice)
        with pytest.raises(BadRequestError, match="is named twice"):
            inspect_scans(twice)
    path = tmp_path / "scans.toml"
    write_scan_list(path, [ScanEntry(folder / "b.ptx", index) for index in (0, 1)])
    assert [len(item.scans) for item in open_input_files([path, las])] == [2, 1]
    with pytest.raises(BadRequestError, match=r"b\.ptx: scan 0 is named twice"):
        open_input_files([path, folder / "b.ptx"])


@pytest.mark.parametrize("error", [OSError(5, "Input/output error"), MemoryError()])
def test_a_file_that_cannot_be_opened_just_now_is_not_left_out(
    error: Exception, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(path: Path, **_: Any) -> Any:
        with library_errors(path):
            raise error

    monkeypatch.setattr(scan_files, "open_scans", fails)
    with pytest.raises((OSError, SolidcloudError), match=r"Input/output error|out of memory") as caught:
        open_input_files([folder / "a.las"])
    assert not isinstance(caught.value, ScanError)


def test_a_missing_file_of_a_list_is_a_fault_and_of_the_command_an_error(folder: Path) -> None:
    write_scan_list(folder / "scans.toml", inspect_scans([folder]))
    (folder / "a.las").unlink()
    assert "no such file" in open_input_files([folder / "scans.toml"])[0].fault
    with pytest.raises(ScanError, match="no such file"):
        open_input_files([folder / "a.las"])


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("path", 3, r"scan 1 \(3\): path is '3', expected the path of a file"),
        ("path", None, r"scan 1 \(without path\): no path, expected the path"),
        ("index", -1, r"scan 1 \(a.las\): index is '-1', expected a whole number"),
        ("index", True, "index is 'True', expected a whole number"),
        ("use", "no", "use is 'no', expected true or false"),
        ("units", "feet", "units is 'feet', expected m, mm, .* us-ft, yd"),
        ("scale", 0, "scale is '0', expected a number above 0"),
        ("scale", float("nan"), "scale is 'nan', expected a number above 0"),
        ("up", "Y", "up is 'Y', expected z or y or x"),
        ("pose", [[1, 0, 0, 0]] * 3, "pose is .*, expected four rows of four numbers"),
        ("pose", np.zeros((4, 4)).tolist(), "pose is .*, expected four rows of four numbers"),
        (
            "pose",
            np.diag([1.0, 1, 0, 1]).tolist(),
            "pose is .*, expected four rows of four numbers that move",
        ),
        (
            "pose",
            np.diag([1.0, 1, float("inf"), 1]).tolist(),
            "pose is .*, expected four rows of four numbers",
        ),
        ("pose", "identity", "pose is 'identity', expected four rows"),
        ("low", [1, 2], r"low is '\[1, 2\]', expected three numbers"),
        ("low", None, "low or high alone"),
        ("crs", 4326, "crs is '4326', expected text in quotes"),
        ("unit", "m", "unknown field 'unit', expected one of path, index"),
    ],
)
def test_a_wrong_edit_is_refused_by_file_scan_and_field(
    field: str, value: object, message: str, folder: Path
) -> None:
    path = folder / "scans.toml"
    write_scan_list(path, inspect_scans([folder / "a.las"]))
    edit_list(path, {field: value})
    with pytest.raises(BadRequestError, match=message) as caught:
        read_scan_list(path)
    assert str(caught.value).startswith(f"{path}: ")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("version = 1\n[[scan]]\npath = \n", "line 3"),
        ("version = 2\nscan = []\n", "version 2, expected version = 1"),
        ("scans = []\n", "unknown scans"),
        ("version = 1\n", "expected version = 1 and a"),
        ("version = 1\nscan = [1]\n", "no path"),
        ("version = 1\nscan = []\n", "no scan to use"),
        (
            '[[scan]]\npath = "a"\n[[scan]]\npath = "b"\n[[scan]]\npath = "a"\n',
            r"scan 3 \(.*\): the same as scan 1",
        ),
        ('[[scan]]\npath = "a"\n[[scan]]\npath = "b/../a"\n', r"scan 2 \(.*\): the same as scan 1"),
        ('[[scan]]\npath = "a.las"\nuse = false\n', "no scan to use"),
        ("\udcff", "expected a list of scans"),
    ],
)
def test_a_file_that_is_no_list_is_refused(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "scans.toml"
    path.write_bytes(text.encode("utf-8", "surrogateescape"))
    with pytest.raises(BadRequestError, match=message):
        open_input_files([path])


def test_a_mesh_is_sampled_in_metres_whatever_its_units(tmp_path: Path) -> None:
    square = np.array([[0.0, 0, 1], [2000, 0, 1], [2000, 2000, 1], [0, 2000, 1]])
    corners = np.array([0, 1, 2, 0, 2, 3], "<u2")
    write_glb(tmp_path / "a.glb", glb_document(4, 6), glb_vertices(square) + corners.tobytes())
    write_scan_list(tmp_path / "scans.toml", inspect_scans([tmp_path / "a.glb"]))
    edit_list(tmp_path / "scans.toml", {"units": "mm"})
    xyz = read_points(open_input_files([tmp_path / "scans.toml"], 0.1))
    assert abs(len(xyz) - 400) <= 1
    # glTF has y up: the square in its xy plane stands upright, and its front looks to -y.
    assert (xyz[:, 1] == -0.001).all() and xyz[:, 2].max() <= 2 and xyz[:, 2].max() > 1.9


def test_the_crs_of_a_las_and_an_e57_is_in_the_list(folder: Path) -> None:
    wkt = 'PROJCS["WGS 84 / UTM zone 17N"]'
    record = struct.pack("<2x16sHH32x", b"LASF_Projection", 2112, len(wkt) + 1) + wkt.encode() + b"\0"
    keys = struct.pack("<12H", 1, 1, 0, 2, 1024, 0, 1, 1, 3072, 0, 1, 32617)
    old = struct.pack("<2x16sHH32x", b"LASF_Projection", 34735, len(keys)) + keys
    for name, vlr, expected in (("w", record, wkt), ("k", old, "model 1; projected EPSG 32617")):
        data = bytearray((folder / "a.las").read_bytes())
        header_size, start = struct.unpack_from("<HI", data, 94)
        (count,) = struct.unpack_from("<I", data, 100)
        struct.pack_into("<II", data, 96, start + len(vlr), count + 1)
        data[header_size:header_size] = vlr
        (folder / f"{name}.las").write_bytes(data)
        (entry,) = inspect_scans([folder / f"{name}.las"])
        assert (entry.crs, entry.count, entry.fault) == (expected, 50, "")
    columns = {f"cartesian{axis}": np.arange(3.0) for axis in "XYZ"}
    write_e57(folder / "p.e57", [{"columns": columns}], crs=wkt)
    assert inspect_scans([folder / "p.e57"])[0].crs == wkt
