"""Test every scan reader on the same points: read whole, in small blocks, and from a truncated file.

The expected points never pass through the code under test.
"""

import os
import sys
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scan_cases import CASES, Case, Truth
from scan_formats import ptx_scan
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.edit.edit_archive import add_scans
from solidcloud.builder.pipeline import build_archive
from solidcloud.builder.sources.common.scan import Scan, sha256_of
from solidcloud.builder.sources.format_table import FORMATS
from solidcloud.builder.sources.scan_files import find_scan_files, header_bounds, inspect_scans, open_scans
from solidcloud.builder.sources.scan_list import write_scan_list
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.errors import BadRequestError, ScanError
from solidcloud.server.cli.main import run

COUNT = 1000  # no multiple of the small block, 7


@pytest.fixture(scope="module")
def truth() -> Truth:
    rng = np.random.default_rng(20240611)
    xyz = rng.uniform(-50.0, 50.0, (COUNT, 3)) + np.array([1000.0, -2000.0, 30.0])
    return Truth(xyz, rng.integers(0, 2000, COUNT).astype(np.float32))


@pytest.fixture(params=CASES, ids=[case.name for case in CASES])
def case(request: pytest.FixtureRequest) -> Case:
    return request.param


@pytest.fixture
def written(case: Case, truth: Truth, tmp_path: Path) -> Path:
    path = tmp_path / case.name
    case.write(path, truth)
    return path


def read(scan: Scan, block_points: int = 1 << 18) -> tuple[np.ndarray, np.ndarray | None]:
    """Return all points of a scan and their intensities; check each block's size and types."""
    blocks = list(scan.blocks(block_points))
    for block in blocks:
        assert block.xyz.dtype == np.float64 and block.xyz.shape[1] == 3
        assert len(block.xyz) <= block_points
        assert block.intensity is None or (block.intensity.dtype == np.float32)
        assert block.intensity is None or block.intensity.shape == block.xyz.shape[:1]
    xyz = np.concatenate([np.empty((0, 3)), *(block.xyz for block in blocks)])
    intensities = [block.intensity for block in blocks if block.intensity is not None]
    return xyz, np.concatenate(intensities) if intensities else None


def test_every_point_is_read_as_it_was_written(case: Case, written: Path, truth: Truth) -> None:
    (scan,) = open_scans(written)
    xyz, intensity = read(scan)
    expected = np.concatenate([truth.xyz, np.repeat(truth.xyz[-1:], case.repeats, axis=0)])
    assert xyz.shape == expected.shape
    assert np.abs(xyz - expected).max() <= case.error
    assert (intensity is not None) == case.intensity
    if intensity is not None:
        assert np.array_equal(intensity, truth.intensity)
    assert scan.declared_count in (None, len(expected))
    assert scan.dropped == {}


def test_small_blocks_give_the_same_bits_as_large_ones(case: Case, written: Path) -> None:
    (scan,) = open_scans(written)
    xyz, intensity = read(scan)
    for block_points in (7, 1):
        small_xyz, small_intensity = read(scan, block_points)
        assert np.array_equal(small_xyz.view(np.uint64), xyz.view(np.uint64))
        assert (intensity is None) == (small_intensity is None)
        assert intensity is None or np.array_equal(small_intensity, intensity)


def binary_start(case: Case, data: bytes) -> int:
    """Return where the binary data after a header in text begin; the length of a file that is text."""
    if case.name in ("little.ply", "big.ply", "single.ply"):
        return data.index(b"end_header\n") + 11
    if case.name in ("binary.pcd", "packed.pcd"):
        return data.index(b"\n", data.index(b"DATA")) + 1
    return len(data)


def unlike_plain(case: Case, data: bytes, kind: str) -> bytes:
    """Return a file with the same points and with what editors and other programs add to text."""
    start = binary_start(case, data)
    head, rest = data[:start], data[start:]
    if kind == "mark":
        return b"\xef\xbb\xbf" + data
    if kind == "cr":
        return head.replace(b"\r\n", b"\n").replace(b"\n", b"\r") + rest
    if kind == "ctrl-z":
        return head + b"\x1a" + rest if not rest else data
    letters = "Süd — ß\x9b\x1b[31m".encode(kind.removeprefix("letters "), "replace")
    comment = {
        ".ply": b"comment %s\nobj_info %s\n" % (letters, letters),
        ".obj": b"# %s\ng %s\nusemtl %s\n" % (letters, letters, letters),
        ".stl": b"",
    }.get(Path(case.name).suffix, b"# %s\n" % letters)
    first = data.index(b"\n") + 1 if case.name.endswith(".ply") else 0
    named = data.replace(b"solid a\n", b"solid %s\n" % letters)
    return named[:first] + comment + named[first:]


IN_TEXT = [
    case
    for case in CASES
    if not case.name.endswith((".las", ".laz", ".e57", ".glb")) and case.name != "binary.stl"
]


@pytest.mark.parametrize("kind", ["mark", "cr", "ctrl-z", "letters utf-8", "letters latin-1"])
@pytest.mark.parametrize("case", IN_TEXT, ids=[case.name for case in IN_TEXT])
def test_text_is_read_whatever_an_editor_made_of_it(
    case: Case, kind: str, truth: Truth, tmp_path: Path
) -> None:
    """Issue 35: marks, line ends and letters of text stopped builds; a mesh is sampled from the same text."""
    path, other = tmp_path / case.name, tmp_path / f"other{Path(case.name).suffix}"
    case.write(path, truth)
    other.write_bytes(unlike_plain(case, path.read_bytes(), kind))
    for spacing in (None, 20.0):
        (plain,), (found,) = open_scans(path, spacing=spacing), open_scans(other, spacing=spacing)
        (xyz, intensity), (other_xyz, other_intensity) = read(plain), read(found)
        assert len(xyz) and np.array_equal(other_xyz, xyz)
        assert (intensity is None) == (other_intensity is None)
        assert intensity is None or np.array_equal(other_intensity, intensity)


@pytest.mark.parametrize("name", ["a.xyz", "a.obj", "a.pts", "a.ptx"])
def test_joined_files_with_byte_order_marks_are_read(name: str, tmp_path: Path) -> None:
    """Issue 35: a mark before a vertex of an OBJ file would hide it."""
    one = {
        "a.obj": "v 1 2 3\nV 4 5 6\n",
        "a.pts": "2\n1 2 3\n4 5 6\n",
        "a.ptx": ptx_scan(np.array([[1.0, 2, 3], [4, 5, 6]]), np.zeros(2)),
    }.get(name, "1 2 3\n4 5 6\n")
    path = tmp_path / name
    path.write_bytes(2 * one.encode("utf-8-sig"))
    found = np.concatenate([read(scan)[0] for scan in open_scans(path)])
    assert found.tolist() == 2 * [[1, 2, 3], [4, 5, 6]]


@pytest.mark.parametrize("code", ["utf-16", "utf-16-le", "utf-16-be"])
@pytest.mark.parametrize("case", IN_TEXT, ids=[case.name for case in IN_TEXT])
def test_utf_16_is_called_that(case: Case, code: str, truth: Truth, tmp_path: Path) -> None:
    """Issue 35: Windows calls it Unicode."""
    path = tmp_path / case.name
    case.write(path, truth)
    path.write_bytes(path.read_bytes().decode("latin-1").encode(code))
    with pytest.raises(ScanError, match=r"text in UTF-16, expected ASCII or UTF-8: save it as UTF-8"):
        read(*open_scans(path))


@pytest.fixture
def few(truth: Truth) -> Truth:
    """Return points that lie in one voxel."""
    return Truth(truth.xyz[:64] / 100 + [990.0, -1980.0, 30.0], truth.intensity[:64])


def test_names_of_any_letters_reach_the_index(few: Truth, tmp_path: Path) -> None:
    """Issue 35: libE57Format refused a file name that is not UTF-8."""
    paths = []
    for case in CASES:
        paths.append(Path(os.fsdecode(os.fsencode(tmp_path) + b"/S\xfcd \x1b[31m " + case.name.encode())))
        case.write(tmp_path / case.name, few)
        (tmp_path / case.name).rename(paths[-1])
    assert [entry.fault for entry in inspect_scans(paths)] == [""] * len(CASES)
    summary = build_archive(paths, tmp_path / "hall", BuildConfig(jobs=1, resolution=0.001))
    with Archive(summary.archive) as archive:
        assert {source.path for source in archive.header.sources} == set(map(str, paths))


def test_millimetres_of_a_map_are_called_that_and_are_read_as_such(few: Truth, tmp_path: Path) -> None:
    """Issue 35: "holds no usable point: leave it out". The integers of LAS cannot reach so far."""
    cases = [case for case in CASES if not case.name.endswith((".las", ".laz"))]
    paths = [tmp_path / case.name for case in cases]
    for case, path in zip(cases, paths, strict=True):
        case.write(path, Truth(few.xyz * 1000 + [5.0e8, 5.4e9, 1e6], few.intensity))
    with pytest.raises(ScanError) as caught:
        build_archive(paths, tmp_path / "hall", BuildConfig(jobs=1))
    what = (
        "points beyond 1e9 m, expected all within it: the coordinates are probably in millimetres: write a list with "
        '`solidcloud inspect`, set units = "mm" in it, and build the list'
    )
    for case, path in zip(cases, paths, strict=True):
        assert f"{path}: scan 0 holds {len(few.xyz) + case.repeats} {what}" in str(caught.value)
    entries = inspect_scans(paths)
    assert all(entry.warnings[0] == f"{entry.path}: {what}" for entry in entries)
    listed = tmp_path / "scans.toml"
    write_scan_list(listed, [replace(entry, units="mm", up="z") for entry in entries])
    assert not any(what in warning for entry in inspect_scans([listed]) for warning in entry.warnings)
    summary = build_archive([listed], tmp_path / "hall", BuildConfig(jobs=1, resolution=0.001))
    assert summary.points == sum(len(few.xyz) + case.repeats for case in cases) and summary.skipped == {}


SEEKABLE = {"a.las", "a.laz", "little.ply", "big.ply", "single.ply", "binary.stl", "binary.pcd"}


def test_a_range_gives_the_points_that_a_run_through_gives_there(case: Case, written: Path) -> None:
    (scan,) = open_scans(written)
    assert scan.seekable == (case.name in SEEKABLE)
    if not scan.seekable:
        for start, stop in ((1, None), (0, 5)):
            with pytest.raises(ValueError, match="cannot seek"):
                list(scan.blocks(100, start, stop))
        return
    xyz, intensity = read(scan)
    for start, stop in (
        (0, None),
        (0, 0),
        (0, 1),
        (1, 5),
        (499, 731),
        (998, 1000),
        (700, None),
        (1000, 1000),
    ):
        blocks = list(scan.blocks(100, start, stop))
        assert all(0 < len(block.xyz) <= 100 for block in blocks)
        assert np.array_equal(np.concatenate([np.empty((0, 3)), *(b.xyz for b in blocks)]), xyz[start:stop])
        for block, at in zip(blocks, np.cumsum([start, *(len(b.xyz) for b in blocks)]), strict=False):
            assert intensity is None or np.array_equal(block.intensity, intensity[at : at + len(block.xyz)])
    for start, stop in ((-1, 5), (5, 4), (0, len(xyz) + 1)):
        with pytest.raises(ValueError, match=f"of a scan of {len(xyz)}"):
            list(scan.blocks(100, start, stop))


@pytest.mark.parametrize("kept", [0.04, 0.5, 0.97])
def test_a_truncated_file_is_an_error(case: Case, written: Path, truth: Truth, kept: float) -> None:
    whole = written.read_bytes()
    end = int(len(whole) * kept)
    if written.suffix in (".xyz", ".txt", ".csv", ".obj"):
        # Text that declares no count shows a cut only within a row's x or y: cut in the middle of an x.
        keyword = b"\nv " if written.suffix == ".obj" else b"\n"
        end = whole.rfind(keyword, 0, end) + len(keyword) + 3
    written.write_bytes(whole[:end])
    with pytest.raises(ScanError, match="expected") as caught:
        for scan in open_scans(written):
            read(scan)
    assert str(caught.value).startswith(f"{written}: ")


def test_memory_is_that_of_a_block_and_not_of_the_file(
    case: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Read 20,000 points, 0.5 MB as float64, in blocks of 500; text in pieces of 16 kB."""
    for module in ("common.text_rows", "common.counted_rows"):
        monkeypatch.setattr(f"solidcloud.builder.sources.{module}.CHUNK_BYTES", 1 << 14)
    monkeypatch.setattr("solidcloud.builder.sources.formats.pcd_lzf.PIECE_BYTES", 1 << 12)
    rng = np.random.default_rng(3)
    count = 20_008  # three points a triangle and one; whole columns of 8
    many = Truth(rng.uniform(-50, 50, (count, 3)), rng.integers(0, 99, count).astype(np.float32))
    path = tmp_path / case.name
    case.write(path, many)
    next(open_scans(path)[0].blocks(500))  # what is loaded or compiled on first use
    tracemalloc.start()
    seen = sum(len(block.xyz) for scan in open_scans(path) for block in scan.blocks(500))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert seen >= count
    assert peak < 250_000


@pytest.mark.parametrize("suffix", [row.suffix for row in FORMATS])
def test_an_empty_file_is_an_error(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"a{suffix}"
    path.touch()
    with pytest.raises(ScanError, match="an empty file"):
        open_scans(path)


@pytest.mark.parametrize("suffix", [row.suffix for row in FORMATS])
def test_garbage_is_an_error_and_bounds_of_it_are_unknown(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"a{suffix}"
    path.write_bytes(np.random.default_rng(7).bytes(20_000))
    assert header_bounds(path) is None
    with pytest.raises(ScanError):
        for scan in open_scans(path):
            read(scan)


def test_a_missing_file_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ScanError, match="no such file or folder, expected a scan: check the path"):
        open_scans(tmp_path / "gone.las")
    with pytest.raises(ScanError, match="no such file"):
        find_scan_files([tmp_path / "gone"])
    with pytest.raises(ScanError, match="gone"):
        sha256_of(tmp_path / "gone.las")


def test_an_unknown_suffix_names_the_known_ones(tmp_path: Path) -> None:
    path = tmp_path / "a.rcp"
    path.write_text("1\n1\n")
    with pytest.raises(ScanError, match=r"'\.rcp', expected one of \.las \.laz \.e57 \.ply .*\.stl"):
        open_scans(path)


def test_a_folder_is_no_scan(tmp_path: Path) -> None:
    (tmp_path / "a.las").mkdir()
    with pytest.raises(ScanError, match="folder"):
        open_scans(tmp_path / "a.las")


def test_a_folder_gives_its_scans_sorted_and_files_stay_as_given(tmp_path: Path) -> None:
    for name in ("b/z.laz", "b/a.LAS", "a/deep/er/x.e57", "a/readme.md", "c.ply", "c.FLS"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    odd = tmp_path / "a" / "readme.md"
    below = [tmp_path / name for name in ("a/deep/er/x.e57", "b/a.LAS", "b/z.laz", "c.FLS", "c.ply")]
    assert find_scan_files([odd, tmp_path]) == [odd, *below]
    with pytest.raises(ScanError, match=r"the suffix '\.fls', expected one of"):
        open_scans(tmp_path / "c.FLS")
    (tmp_path / "none").mkdir()
    with pytest.raises(ScanError, match="a folder without scans"):
        find_scan_files([tmp_path / "none"])


def test_companions_of_macos_are_skipped_in_folders_with_a_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Issue 35: macOS puts ._a.xyz beside a.xyz on foreign disks, and .DS_Store into each folder."""
    folder = tmp_path / "hall"
    folder.mkdir()
    for name in ("._a.xyz", "._b.las", ".DS_Store", "._.DS_Store", "Thumbs.db"):
        (folder / name).write_bytes(b"\0\5\x16\7\0\2\0\0Mac OS X")
    (folder / "a.xyz").write_text("1 2 3\n4 5 6\n")
    line = f"{folder}: 2 files of macOS skipped, ._a.xyz first"
    assert find_scan_files([folder]) == [folder / "a.xyz"]
    summary = build_archive([folder], tmp_path / "archive", BuildConfig(jobs=1, resolution=0.001))
    assert summary.points == 2 and line in summary.warnings
    added = add_scans(tmp_path / "archive", [folder], again=True, jobs=1)
    assert line in added.warnings
    for command in ("inspect", "plan", "build"):
        capsys.readouterr()
        assert (
            run([command, str(folder), *(["-o", str(tmp_path / command)] if command != "plan" else [])]) == 0
        )
        assert line in capsys.readouterr().err.replace("\n", "")
    (folder / "a.xyz").unlink()
    with pytest.raises(ScanError, match="a folder without scans"):
        find_scan_files([folder])
    assert find_scan_files([folder / "._a.xyz"]) == [folder / "._a.xyz"]  # given by name


@pytest.mark.parametrize("spacing", [0.0, -1.0, float("nan"), float("inf")])
def test_a_spacing_that_is_no_length_is_refused(spacing: float, tmp_path: Path) -> None:
    with pytest.raises(BadRequestError, match="spacing"):
        open_scans(tmp_path / "a.obj", spacing=spacing)


@pytest.mark.parametrize(
    ("name", "library"), [("a.laz", "lazrs"), ("a.e57", "pye57"), ("little.ply", "plyfile")]
)
def test_a_missing_library_says_what_to_install(
    name: str, library: str, truth: Truth, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / name
    next(case for case in CASES if case.name == name).write(path, truth)
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(ScanError, match=r"pip install 'solidcloud\[readers\]'"):
        for scan in open_scans(path):
            read(scan)
