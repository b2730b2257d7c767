"""Colours and classes that readers deliver, and how the channels of a file become eight bits."""

from pathlib import Path

import numpy as np
import pytest
from coloured_scans import WRITERS, coloured, has_classes, read_scan, write_las
from solidcloud.builder.sources.common.colours import eight_bits
from solidcloud.builder.sources.placed_scan import place_scan
from solidcloud.builder.sources.scan_files import open_scans


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
