"""Test PTX and PTS: several scans a file, their positions and headers, missing and surplus rows."""

from pathlib import Path

import numpy as np
import pytest
from scan_formats import ptx_scan, text_rows, write_pts
from solidcloud.builder.sources.scan_files import open_scans
from solidcloud.schemas.errors import ScanError

POSE = np.array([[0.0, -1.0, 0.0, 10.0], [1.0, 0.0, 0.0, 20.0], [0.0, 0.0, 1.0, 30.0], [0, 0, 0, 1]])
CHUNK = "solidcloud.builder.sources.common.counted_rows.CHUNK_BYTES"


def points(seed: int, count: int = 60) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.uniform(-5, 5, (count, 3)).round(4), rng.integers(0, 256, count).astype(np.float32)


def read_each(path: Path, block_points: int = 1 << 18) -> list[np.ndarray]:
    return [
        np.concatenate([np.empty((0, 3)), *(block.xyz for block in scan.blocks(block_points))])
        for scan in open_scans(path)
    ]


@pytest.mark.parametrize("chunk", [7, 64, 1 << 22])
def test_scans_of_one_ptx_are_each_where_their_pose_puts_them(
    chunk: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(CHUNK, chunk)
    path = tmp_path / "a.ptx"
    (one, light), (two, dark) = points(1), points(2, 20)
    path.write_text(ptx_scan(one, light, POSE, 4) + ptx_scan(two, dark) + "\n \n")
    first, second = open_scans(path)
    assert (first.index, second.index) == (0, 1) and first.format == "ptx"
    assert np.array_equal(first.pose, POSE) and np.array_equal(second.pose, np.eye(4))
    found = read_each(path)
    turned = np.column_stack([10 - one[:, 1], 20 + one[:, 0], 30 + one[:, 2]])
    assert np.abs(found[0] - turned).max() < 1e-12 and found[0].shape == turned.shape
    assert np.array_equal(found[1], two)
    assert all(
        np.array_equal(a.view(np.uint64), b.view(np.uint64))
        for a, b in zip(found, read_each(path, 7), strict=True)
    )
    assert np.array_equal(np.concatenate([b.intensity for b in second.blocks()]), dark)


def test_directions_without_a_return_are_left_out_and_counted(tmp_path: Path) -> None:
    path = tmp_path / "a.ptx"
    xyz, light = points(1)
    xyz[10:15] = 0
    xyz[20] = [0, 0, 1e-3]  # a point by the scanner's axis is one
    path.write_text(ptx_scan(xyz, light, POSE))
    (scan,) = open_scans(path)
    found = np.concatenate([block.xyz for block in scan.blocks(3)])
    assert scan.dropped == {"no return": 5} and scan.declared_count == 60
    assert len(found) == 55 and np.abs(found[15] - [10, 20, 30.001]).max() < 1e-12


def lines_of(count: int = 4) -> list[str]:
    return ptx_scan(*points(1, count), POSE).splitlines()


PTX_FAULTS = {
    "a grid of no number": (0, "four", "line 1 is 'four', expected the columns"),
    "a grid of a thousand digits": (1, "9" * 1000, "line 2 is '9"),
    "a grid too large": (1, "999999999", "rows at most, expected the 999999999"),
    "a position of two numbers": (2, "1 2", "line 3 is '1 2', expected 3 numbers"),
    "a matrix with a word": (7, "1 0 x 0", "line 8 is '1 0 x 0', expected 4 numbers"),
    "a matrix that is flat": (6, "0 0 0 0", "expected an invertible matrix with last column"),
    "a matrix of zeros beside axes": ((6, 7, 8), "0 0 0 0", "expected an invertible matrix with last column"),
    "a matrix that projects": (6, "1 0 0 1", "expected an invertible matrix with last column"),
    "a matrix without a value": (6, "nan 0 0 0", "expected an invertible matrix with last column"),
    "a row of two": (10, "1 2", "line 11 is '1 2', expected x y z"),
    "another row of two": (11, "1 2", "line 12 is '1 2', expected 4 numbers"),
}


@pytest.mark.parametrize("fault", PTX_FAULTS)
def test_a_broken_ptx_is_refused_with_its_line(fault: str, tmp_path: Path) -> None:
    at, text, message = PTX_FAULTS[fault]
    lines = lines_of()
    for each in at if isinstance(at, tuple) else (at,):
        lines[each] = text
    path = tmp_path / "a.ptx"
    path.write_text("\n".join(lines))
    with pytest.raises(ScanError, match=message):
        read_each(path)


@pytest.mark.parametrize("count", [3, 4, 5, 6, 7, 9])
@pytest.mark.parametrize("head", ["2\n", "# by hand\n2\n", ""])
def test_pts_rows_may_have_any_columns_behind_x_y_and_z(head: str, count: int, tmp_path: Path) -> None:
    """Issue 35: five were refused."""
    path = tmp_path / "a.pts"
    rows = [[1.5, 2, 3, 40, 50, 60, 70, 80, 90][:count], [4, 5, 6, 41, 51, 61, 71, 81, 91][:count]]
    path.write_text(head + "".join(" ".join(map(str, row)) + "\n" for row in rows))
    (scan,) = open_scans(path)
    scan.wanted = frozenset(["rgb"])
    (block,) = scan.blocks()
    assert block.xyz.tolist() == [[1.5, 2, 3], [4, 5, 6]]
    assert (block.intensity is not None) == (count in (4, 5, 7)) == ("intensity" in scan.columns)
    assert (block.rgb is not None) == (count in (6, 7)) == ("rgb" in scan.columns)
    assert block.rgb is None or block.rgb[1].tolist() == rows[1][-3:]


@pytest.mark.parametrize("chunk", [7, 1 << 22])
def test_blank_lines_and_comments_are_not_counted_as_rows(
    chunk: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Issue 35."""
    monkeypatch.setattr(CHUNK, chunk)
    path = tmp_path / "a.pts"
    path.write_text("\n# by hand\n2\n\n1 2 3\n\n // c\n\r\n 4 5 6 # d\n\n1\n; e\n7 8 9\n  \n1\n\n1 1 1\n#")
    assert [xyz.tolist() for xyz in read_each(path)] == [[[1, 2, 3], [4, 5, 6]], [[7, 8, 9]], [[1, 1, 1]]]
    path.write_text("2\n1 2 3\n\n4 5 6\n\n7 8 9\n")
    with pytest.raises(ScanError, match="line 6 is '7 8 9' after the last of 2 points"):
        read_each(path)
    path.write_text("3\n1 2 3\r4 5 6\n7 8 9\r\n1\n4 4 4", newline="")
    assert [len(xyz) for xyz in read_each(path)] == [3, 1]
    path.write_text("3\n1 2 3\n\n4 5 6\n#\n\n\n\n")
    with pytest.raises(ScanError, match="2 rows at most, expected the 3"):
        read_each(path)


@pytest.mark.parametrize("kept", [5, 9, 10, 12, 13])
def test_a_ptx_cut_after_a_line_is_refused(kept: int, tmp_path: Path) -> None:
    path = tmp_path / "a.ptx"
    path.write_text("\n".join(lines_of()[:kept]) + "\n")
    with pytest.raises(ScanError, match="expected"):
        read_each(path)


def test_a_ptx_with_a_row_too_many_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.ptx"
    path.write_text("\n".join([*lines_of(), "1 2 3 4"]))
    with pytest.raises(ScanError, match="line 15 is '1 2 3 4', expected the columns"):
        read_each(path)


@pytest.mark.parametrize("chunk", [7, 1 << 22])
def test_blocks_of_a_pts_are_scans(chunk: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(CHUNK, chunk)
    one, two = points(1), points(2, 33)
    path = write_pts(tmp_path / "a.pts", [one, two, (np.empty((0, 3)), np.empty(0))])
    assert [scan.declared_count for scan in open_scans(path)] == [60, 33, 0]
    found = read_each(path)
    assert [len(xyz) for xyz in found] == [60, 33, 0]
    assert np.array_equal(found[0], one[0]) and np.array_equal(found[1], two[0])


def test_a_pts_whose_counts_do_not_fit_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.pts"
    rows = text_rows(points(1, 5)[0])
    for count, message in (
        (4, "line 6 is .* after the last of 4 points"),
        (6, "5 rows at most, expected the 6"),
    ):
        path.write_text(f"{count}\n{rows}")
        with pytest.raises(ScanError, match=message):
            read_each(path)
    path.write_text(f"{10**17}\n{rows}")
    with pytest.raises(ScanError, match=f"expected the {10**17} declared"):
        read_each(path)


def test_a_pts_without_a_count_is_text(tmp_path: Path) -> None:
    path = tmp_path / "a.pts"
    xyz, light = points(1, 5)
    path.write_text(text_rows(xyz, light))
    (scan,) = open_scans(path)
    (block,) = scan.blocks()
    assert scan.format == "text" and np.array_equal(block.xyz, xyz) and np.array_equal(block.intensity, light)
