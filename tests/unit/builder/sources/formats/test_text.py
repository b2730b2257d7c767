"""Test text scans: the rules for columns, headers and counts, and broken lines."""

import io
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scan_cases import read_all
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.pipeline import build_archive
from solidcloud.builder.sources.common.text_rows import LONGEST_LINE, number_rows
from solidcloud.builder.sources.scan_files import inspect_scans, open_scans
from solidcloud.schemas.errors import ScanError


def intensities(path: Path) -> list[float] | None:
    """The intensities of a file with one scan, None where it has none."""
    found = [block.intensity for scan in open_scans(path) for block in scan.blocks()]
    return None if found[0] is None else np.concatenate(found).tolist()


@pytest.mark.parametrize(
    ("name", "text", "expected", "intensity"),
    [
        ("a.pts", "2\n1 2 3 -4\n5 6 7 -8\n", [[1, 2, 3], [5, 6, 7]], [-4, -8]),
        ("a.pts", "1\n1 2 3 4 255 0 0\n", [[1, 2, 3]], [4]),
        ("a.pts", "1\n1 2 3 255 0 0\n", [[1, 2, 3]], None),  # the fourth of six is red
        ("a.pts", "1 2 3\n", [[1, 2, 3]], None),
        ("a.xyz", "1 2 3 4\n", [[1, 2, 3]], None),  # a fourth column may mean anything
        ("a.xyz", "1 2 3", [[1, 2, 3]], None),
        ("a.csv", "intensity;Z;Y;X\n9;3;2;1\n", [[1, 2, 3]], [9]),
        ("a.csv", "\ufeffx, y, z\n1, 2, 3\n\n4, 5, 6\n", [[1, 2, 3], [4, 5, 6]], None),
        ("a.txt", "//X Y Z Scalar_Intensity\n1 2 3 4\n", [[1, 2, 3]], [4]),
        ("a.txt", "# by hand\n\n# y x z\n2 1 3\n#\n5 4 6 # end\n", [[1, 2, 3], [4, 5, 6]], None),
        ("a.txt", "# of x, y and z\n1 2 3\n", [[1, 2, 3]], None),  # a sentence, no header
        ("a.txt", "nan 1e999 -3\n", [[np.nan, np.inf, -3]], None),  # counted by the caller
        ("a.txt", "# nothing\n\n", [], None),
        # Issue 35: what other programs write and read.
        ("a.txt", "1 2 1.#QNAN\n-1.#IND00 5 -nan(ind)\n", [[1, 2, np.nan], [np.nan, 5, np.nan]], None),
        ("a.txt", "1 2 3\n4 5 1.#INF # 3\n7 8 9 # (nan)\n", [[1, 2, 3], [4, 5, np.nan], [7, 8, 9]], None),
        ("a.csv", "1,2,3,\n4,5,6,\n", [[1, 2, 3], [4, 5, 6]], None),
        ("a.csv", "x,y,z,\n1,2,3\n4,5,6,,\n", [[1, 2, 3], [4, 5, 6]], None),
        ("a.csv", "X;Y;Z\n1,5;2;-3,25\n4;5,5;6e-1\n", [[1.5, 2, -3.25], [4, 5.5, 0.6]], None),
        ("a.csv", "1;2;3\n4,5;6;7\n", [[1, 2, 3], [4.5, 6, 7]], None),
        ("a.txt", "1,5\t2\t-3,25\n4\t5,5\t6\n", [[1.5, 2, -3.25], [4, 5.5, 6]], None),
        ("a.txt", "1 2 3\n4,5 5 6\n", [[1, 2, 3], [4.5, 5, 6]], None),
        ("a.csv", 'sep=;\n"X";"Y";"Z"\n"1";"2";"3"\n', [[1, 2, 3]], None),
        ("a.csv", '"1.5","2","3"\n"4",5,"6"\n', [[1.5, 2, 3], [4, 5, 6]], None),
        ("a.csv", '"1,5";"2";"3"\n', [[1.5, 2, 3]], None),
        ("a.csv", 'x,y,z,"mean, of all"\n1,2,3,4\n', [[1, 2, 3]], None),
        ("a.txt", "X\tY\tZ\tScalar field\n1\t2\t3\t4\n", [[1, 2, 3]], None),
        ("a.txt", "; by hand\n1 2 3\n// 9 9 9\n ; by hand\n4 5 6 # c\n", [[1, 2, 3], [4, 5, 6]], None),
        ("a.csv", "i;x;y;z\n0;1;2;3\n", [[1, 2, 3]], None),
        ("a.csv", ";x;y;z\n0;1;2;3\n", [[1, 2, 3]], None),
        ("a.csv", "// ok; 1,2.5\n1;2;3\n# 1.5, no\n4,5;6;7\n", [[1, 2, 3], [4.5, 6, 7]], None),
        ("a.txt", "x y z\n2\n1 2 3\n4 5 6\n", [[1, 2, 3], [4, 5, 6]], None),
        ("a.xyz", "1 2 3\n4 5 6\r7 8 9\r\n", [[1, 2, 3], [4, 5, 6], [7, 8, 9]], None),
        ("a.xyz", "1 2 3\r\r\n4 5 6\r\r\n", [[1, 2, 3], [4, 5, 6]], None),
        ("a.xyz", "1 2 3\n4 5 6\n\x1a\r\n", [[1, 2, 3], [4, 5, 6]], None),
        ("a.xyz", "1 2 3\n4 5 6\x1a", [[1, 2, 3], [4, 5, 6]], None),
        ("a.pts", "0\n", [], None),
    ],
)
def test_text_layouts(
    name: str, text: str, expected: list, intensity: list[float] | None, tmp_path: Path
) -> None:
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    assert np.array_equal(read_all(path), np.reshape(expected, (-1, 3)), equal_nan=True)
    if expected:
        assert intensities(path) == intensity


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 2 3\n4 5 6\n7 8\n", "line 3 is '7 8', expected 3 numbers"),
        ("1 2 3\n\n# c\n4 5 6 7\n", "line 4 is '4 5 6 7'"),
        ("1 2 3\n4 5 x6\n", "line 2 is '4 5 x6'"),
        ("1,2,3\n4,,6\n", "line 2 is '4,,6'"),
        ("1,2,3\n4 5 6\n", "line 2"),
        ("1,5;2;3\n1.234;6;7\n", "decimal commas and points"),  # one of them separates thousands
        ("1.5;2;3\n1,234;6;7\n", "decimal commas and points"),
        ("1.234,5;2;3\n", "line 1 is '1.234,5;2;3', expected at least three numbers"),
        ("1 2 3\n4,5 6\n", "line 2 is '4,5 6'"),
        ("1 2 3\n4, 5, 6\n", "line 2 is '4, 5, 6'"),
        ('"1,5","2,5","3,5"\n', "check that its numbers have decimal points"),
        ("1;2;3\n;5;6\n", "line 2 is ';5;6'"),  # no comment
        ("1 2 3\n; 5 6\n", "line 2 is '; 5 6'"),
        ("; 5 6\n1 2 3\n", "line 1"),
        ("1,2,3,4\n5,6,7,\n", "line 2 is '5,6,7,'"),
        ("1,2,3\n5,6,\n", "line 2 is '5,6,'"),
        ("1,2,3\n4,5,6,7,\n", "line 2 is '4,5,6,7,'"),
        ("1 2 3\n4 5\x1a6\n7 8 9\n", "line 2 is"),
        ("1 2 3\n\x1a\n7 8 9\n", "line 2 is"),
        ("1 2 3\n4 5 6#7 8 9\n", "line 2 is '4 5 6#7 8 9'"),  # a damaged line end is no comment
        ("1 2 3 wall\n", "expected at least three numbers .*, and nothing else: .* remove columns"),
        ("1 2\n3 4\n", "line 1 is '1 2', expected at least three numbers"),
        ("1 2 z\n", "line 1"),
        ("x y z\nx y z\n1 2 3\n", "line 2 is 'x y z'"),
        ("x y\n1 2 3\n", "line 1 names the columns 'x y'"),
        ("x y x\n1 2 3\n", "x, y and z once each"),
        ("x y z\n", "no rows of numbers"),
        ("3\n1 2 3\n4 5 6\n", "2 points, expected the 3"),
        ("1\n1 2 3\n4 5 6\n", "2 points, expected the 1"),
        ("5\n", "no rows of numbers"),
        ("a chapter\n" * 3, "line 2"),
        ("1 2 3\n4 5\0 6\n", "line 2 holds a zero byte"),
        ("1 2 3\n" + "1" * (6 * LONGEST_LINE), "line 2 is longer than"),
    ],
)
def test_broken_text_is_refused_with_its_line(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text(text)
    with pytest.raises(ScanError, match=message):
        read_all(path)


def test_text_is_read_right_across_chunks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.xyz"
    xyz = np.random.default_rng(5).normal(size=(300, 3)).round(6)
    lines = [f"{x} {y} {z}" for x, y, z in xyz.tolist()]
    path.write_text("\n".join(lines))
    monkeypatch.setattr("solidcloud.builder.sources.common.text_rows.CHUNK_BYTES", 100)
    assert np.array_equal(read_all(path), xyz)
    lines[222] = "1 2"
    path.write_text("\n".join(lines))
    with pytest.raises(ScanError, match="line 223 is '1 2'"):
        read_all(path)


def ply_of(count: int) -> str:
    """The header of a PLY of so many vertices in text."""
    axes = "".join(f"property float {axis}\n" for axis in "xyz")
    return f"ply\nformat ascii 1.0\nelement vertex {count}\n{axes}end_header\n"


def pcd_of(count: int) -> str:
    """The header of a PCD of so many points in text."""
    return f"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH {count}\nHEIGHT 1\nDATA ascii\n"


@pytest.mark.parametrize(("name", "head"), [("a.ply", ply_of), ("a.pcd", pcd_of)])
def test_a_row_that_makes_the_declared_points_too_many_to_hold_is_a_fault_of_the_file(
    name: str, head: Callable[[int], str], tmp_path: Path
) -> None:
    """800 GB for 250,000 rows like the first, in a file of 2.3 MB: others of the same build are no worse for it."""
    path = tmp_path / name
    path.write_text(head(250_000) + "1 " * 400_000 + "\n" * 1_500_000)
    with pytest.raises(ScanError, match=r"line \d+ is '1 1 1 .*, expected 3 numbers like the first row"):
        read_all(path)
    good = tmp_path / "b.xyz"
    good.write_text("1 2 3\n4 5 6\n")
    inspected = {entry.path: entry.fault for entry in inspect_scans([path, good])}
    assert inspected[good] == ""
    config = BuildConfig(jobs=1, skip_bad=True, resolution=0.001)
    summary = build_archive([path, good], tmp_path / "hall", config)
    assert summary.points == 2
    assert [name in fault for fault in summary.faults] == [True]


def test_no_more_rows_are_made_room_for_than_the_bytes_hold(tmp_path: Path) -> None:
    """Of 1,000 rows of 20,000 numbers, 160 MB, one is there, and blank lines."""
    data = io.BytesIO(b"1 " * 20_000 + b"\n" * 1_000_000)
    tracemalloc.start()
    try:
        (rows,) = number_rows(data, tmp_path, columns=20_000, delimiter=None, first_line=1, limit=1000)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert rows.shape == (1, 20_000)
    assert peak < 40 << 20


@pytest.mark.parametrize(
    ("header", "units"),
    [
        ("x_mm,y_mm,z_mm", "mm"),
        ("X [cm],Y [cm],Z [cm],Intensity", "cm"),
        ("X (m);Y (m);Z (m)", "m"),
        ("# x (us-ft), y (us-ft), z (m)", "us-ft+m"),
        ("x,y,z_mm", None),
        ("x_mm,y_m,z_mm", None),
        ("x_ell,y_ell,z_ell", None),
    ],
)
def test_the_unit_behind_the_names_of_coordinates_is_used_or_they_are_refused(
    header: str, units: str | None, tmp_path: Path
) -> None:
    """Issue 35, row 5."""
    delimiter = ";" if ";" in header else ","
    (tmp_path / "a.csv").write_text(
        f"{header}\n" + delimiter.join("1234"[: header.count(delimiter) + 1]) + "\n"
    )
    if units is None:
        with pytest.raises(ScanError, match="names the columns"):
            open_scans(tmp_path / "a.csv")
        return
    (scan,) = open_scans(tmp_path / "a.csv")
    assert (scan.units, bool(scan.units_note)) == (units, units != "m")
    assert next(scan.blocks()).xyz.tolist() == [[1, 2, 3]]
