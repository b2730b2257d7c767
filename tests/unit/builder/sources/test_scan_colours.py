"""Colours and classes that readers deliver, and how the channels of a file become eight bits."""

import os
from pathlib import Path

import numpy as np
import pytest
from coloured_scans import WRITERS, coloured, has_classes, read_scan, write_las
from solidcloud.builder.sources.common.colours import eight_bits
from solidcloud.builder.sources.placed_scan import place_scan
from solidcloud.builder.sources.scan_files import inspect_scans, open_scans

REAL = Path(os.environ.get("SOLIDCLOUD_SCANS", "")) / "format_samples"


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("block_points", [1 << 18, 37])
def test_a_reader_delivers_the_colours_and_classes_of_its_file(
    name: str, block_points: int, tmp_path: Path
) -> None:
    truth = coloured(3)
    found = read_scan(WRITERS[name](tmp_path / name, truth), block_points)
    assert np.array_equal(np.rint(found.xyz * 1000), np.rint(truth.xyz * 1000))
    assert np.array_equal(found.rgb, truth.rgb)
    assert np.array_equal(found.classes, truth.classes if has_classes(name) else np.zeros(300))


@pytest.mark.parametrize(
    "name", ["7.laz", "bytes.e57", "bytes.ply", "a.ptx", "bare.pts", "float.pcd", "named.csv"]
)
def test_colours_that_nobody_wants_are_not_read(name: str, tmp_path: Path) -> None:
    (scan,) = open_scans(WRITERS[name](tmp_path / name, coloured(4)))
    assert "rgb" in scan.columns
    assert all(block.rgb is None and block.classification is None for block in scan.blocks())


@pytest.mark.parametrize("name", ["7.laz", "bytes.ply", "2.las"])
def test_a_range_of_a_scan_has_the_colours_of_its_points(name: str, tmp_path: Path) -> None:
    truth = coloured(5)
    (scan,) = open_scans(WRITERS[name](tmp_path / name, truth))
    scan.wanted = frozenset({"rgb", "classification"})
    blocks = list(scan.blocks(11, 40, 120))
    found = np.concatenate([eight_bits(block.rgb, 65535) for block in blocks])
    assert np.array_equal(found, truth.rgb[40:120])
    assert np.array_equal(np.concatenate([block.classification for block in blocks]), truth.classes[40:120])


def test_a_placed_scan_keeps_colours_and_classes(tmp_path: Path) -> None:
    truth = coloured(6)
    placed = place_scan(open_scans(WRITERS["bytes.ply"](tmp_path / "a.ply", truth))[0], units="cm", up="y")
    placed.wanted = frozenset({"rgb", "classification"})
    (block,) = placed.blocks()
    assert placed.columns == {"rgb", "classification"}
    assert np.array_equal(block.rgb, truth.rgb)
    assert np.array_equal(block.classification, truth.classes)


@pytest.mark.parametrize("name", list(filter(has_classes, WRITERS)))
def test_points_of_classes_that_are_left_out_are_counted(name: str, tmp_path: Path) -> None:
    """Issue 35, row 8, in every format that has classes."""
    truth = coloured(9)
    (scan,) = open_scans(WRITERS[name](tmp_path / name, truth))
    scan.drop_classes = frozenset({int(truth.classes[0]), int(truth.classes[1])})
    kept = ~np.isin(truth.classes, list(scan.drop_classes))
    xyz = np.concatenate([block.xyz for block in scan.blocks(50)])
    assert np.abs(xyz - truth.xyz[kept]).max() < 1e-3
    assert scan.dropped == {f"class {k}": (truth.classes == k).sum() for k in scan.drop_classes}


@pytest.mark.parametrize("format", [1, 3, 6, 8])
def test_las_classes_are_without_the_flags_beside_them(format: int, tmp_path: Path) -> None:
    truth = coloured(7, classes=256 if format > 5 else 32)
    path = write_las(tmp_path / "a.las", truth, format)
    import laspy

    las = laspy.read(path)
    las.synthetic[:], las.key_point[:] = 1, 1
    las.write(str(path))
    assert np.array_equal(read_scan(path).classes, truth.classes)


def test_the_brightest_channel_decides_between_eight_and_sixteen_bits() -> None:
    words = np.array([[0, 128, 255], [256, 40000, 65535]], np.uint16)
    assert eight_bits(words[:1], 255.0).tolist() == [[0, 128, 255]]
    assert eight_bits(words, 65535.0).tolist() == [[0, 0, 0], [1, 156, 255]]
    # A range without a bright point has the depth of its scan.
    assert eight_bits(words[:1], 65535.0).tolist() == [[0, 0, 0]]
    assert eight_bits(words[:1].astype(np.uint8), 65535.0).tolist() == [[0, 128, 255]]
    fractions = np.array([[0, 0.5, 1.0], [np.nan, -3, 0.1]], np.float32)
    assert eight_bits(fractions, 1.0).tolist() == [[0, 128, 255], [0, 0, 26]]
    assert eight_bits(fractions, 200.0).tolist() == [[0, 0, 1], [0, 0, 0]]


def test_e57_without_limits_and_of_floats_has_fractions(tmp_path: Path) -> None:
    from scan_formats import cartesian, write_e57

    truth = coloured(9)
    channels = {
        f"color{n}": (truth.rgb[:, k] / 255).astype(np.float32)
        for k, n in enumerate(("Red", "Green", "Blue"))
    }
    path = write_e57(tmp_path / "a.e57", [{"columns": {**cartesian(truth.xyz), **channels}}])
    assert np.array_equal(read_scan(path).rgb, truth.rgb)


def test_e57_colours_marked_as_invalid_are_black(tmp_path: Path) -> None:
    from scan_formats import cartesian, write_e57

    truth = coloured(10)
    channels = {f"color{n}": truth.rgb[:, k].copy() for k, n in enumerate(("Red", "Green", "Blue"))}
    invalid = (np.arange(300) % 3 == 0).astype(np.int8)
    columns = {**cartesian(truth.xyz), **channels, "isColorInvalid": invalid}
    path = write_e57(tmp_path / "a.e57", [{"columns": columns}])
    assert np.array_equal(read_scan(path).rgb, np.where(invalid[:, None], 0, truth.rgb))


def test_inspect_names_the_columns_of_each_scan(tmp_path: Path) -> None:
    WRITERS["7.las"](tmp_path / "a.las", coloured(1))
    WRITERS["named.csv"](tmp_path / "b.csv", coloured(1))
    (tmp_path / "c.xyz").write_text("1 2 3\n4 5 6\n")
    found = {entry.path.name: entry.columns for entry in inspect_scans(sorted(tmp_path.iterdir()))}
    assert found == {
        "a.las": ("classification", "intensity", "rgb"),
        "b.csv": ("classification", "rgb"),
        "c.xyz": (),
    }


@pytest.mark.skipif(not REAL.is_dir(), reason="SOLIDCLOUD_SCANS names no folder with format_samples")
def test_a_real_ptx_file_has_the_colours_of_its_rows() -> None:
    path = REAL / "1.2-with-color.ptx"
    rows = np.array([line.split() for line in path.read_text().splitlines()[10:]], np.float64)
    rows = rows[(rows[:, :3] != 0).any(axis=1)]
    assert np.array_equal(read_scan(path).rgb, rows[:, 4:])
    assert len(np.unique(rows[:, 4:], axis=0)) > 1


@pytest.mark.skipif(not REAL.is_dir(), reason="SOLIDCLOUD_SCANS names no folder with format_samples")
def test_real_las_and_e57_files_have_the_colours_that_their_libraries_read() -> None:
    import laspy
    import pye57

    las = laspy.read(REAL.parent / "cupola_las" / "r2.las")
    found = read_scan(REAL.parent / "cupola_las" / "r2.las")
    words = np.stack([las.red, las.green, las.blue], axis=1)
    assert words.max() > 255 and np.array_equal(found.rgb, words >> 8)
    assert np.array_equal(found.classes, las.classification)
    path = REAL.parent / "pumpA.e57"
    columns = pye57.E57(str(path)).read_scan(0, colors=True, ignore_missing_fields=True)
    channels = [columns[name] for name in ("colorRed", "colorGreen", "colorBlue")]
    assert np.array_equal(read_scan(path).rgb, np.stack(channels, axis=1))
