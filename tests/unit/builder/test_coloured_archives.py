"""Archives with colours and classes: every point keeps its own, through builds, changes, levels and exports."""

from pathlib import Path

import numpy as np
import pytest
import solidcloud.builder.build_limits as build_limits
import solidcloud.builder.passes.survey_pass as survey
from coloured_scans import (
    WRITERS,
    Coloured,
    coloured,
    has_classes,
    read_archive,
    read_scan,
    table,
    write_las,
    write_ply,
)
from small_builds import build, content
from solidcloud.builder.edit.edit_archive import add_scans, remove_scans
from solidcloud.builder.export.export_archive import export_archive
from solidcloud.builder.passes.verify import verify_archive
from solidcloud.builder.voxel.record_points import voxel_points
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.archive.level import open_level

KEEP = frozenset({"scan", "intensity", "rgb", "classification"})
GRID = {"resolution": 0.001, "radius": 0.001}


def joined(*parts: Coloured) -> Coloured:
    """Several sets of points as one."""
    return Coloured(*map(np.concatenate, zip(*parts, strict=True)))


def stacked(seed: int, count: int = 400) -> Coloured:
    """Points at few places, most of them several times in different colours."""
    truth = coloured(seed, count)
    places = np.random.default_rng(seed).integers(0, 4, (count, 3)) * 0.5
    return truth._replace(xyz=places, rgb=truth.rgb // 128 * 200)


def test_every_format_builds_into_one_archive_with_its_colours(tmp_path: Path) -> None:
    paths, truths = [], []
    for number, (name, write) in enumerate(WRITERS.items()):
        truth = coloured(number)
        paths.append(write(tmp_path / name, truth))
        truths.append(truth if has_classes(name) else truth._replace(classes=np.zeros(300, np.uint8)))
    plain = coloured(99)
    paths.append(tmp_path / "plain.xyz")
    np.savetxt(paths[-1], plain.xyz, "%.3f")
    truths.append(plain._replace(rgb=plain.rgb * 0, classes=plain.classes * 0))
    summary = build(paths, tmp_path / "a", keep=KEEP, **GRID)
    assert np.array_equal(table(read_archive(tmp_path / "a")), table(joined(*truths)))
    assert verify_archive(tmp_path / "a", deep=True).faults == ()
    with_classes = 300 * sum(map(has_classes, WRITERS))
    assert summary.columns["rgb"] == 300 * len(WRITERS) == summary.points - 300
    assert summary.columns["classification"] == with_classes
    again = build(paths, tmp_path / "a", keep=KEEP, **GRID)
    assert again.already and again.columns == summary.columns


@pytest.mark.parametrize("keep", [{"rgb"}, {"classification"}, set(KEEP)])
def test_the_kept_columns_and_no_others_are_stored(keep: set[str], tmp_path: Path) -> None:
    truth = coloured(1)
    path = write_las(tmp_path / "a.laz", truth)
    build([path], tmp_path / "a", keep=frozenset(keep), **GRID)
    with Archive(tmp_path / "a") as archive:
        assert archive.header.format_version == 5
        assert (archive.header.rgb, archive.header.classification) == (
            "rgb" in keep,
            "classification" in keep,
        )
    expected = truth._replace(
        rgb=truth.rgb * ("rgb" in keep), classes=truth.classes * ("classification" in keep)
    )
    assert np.array_equal(table(read_archive(tmp_path / "a")), table(expected))


def test_the_bytes_of_stacked_points_do_not_depend_on_order_runs_or_parts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(survey, "RANGE_POINTS", (100, 100))
    paths = [
        write_las(tmp_path / "a.las", stacked(1)),
        write_ply(tmp_path / "b.ply", stacked(2), text=False, kind="u1"),
    ]
    keep = frozenset({"rgb", "classification"})
    build(paths, tmp_path / "one", keep=keep, **GRID)
    build(paths[::-1], tmp_path / "two", keep=keep, memory_bytes=64 << 20, **GRID)
    assert content(tmp_path / "one") == content(tmp_path / "two")
    assert np.array_equal(table(read_archive(tmp_path / "one")), table(joined(stacked(1), stacked(2))))
    monkeypatch.setattr(build_limits, "DENSE_POINTS", 100)
    build(paths, tmp_path / "parts", keep=keep, **GRID)
    assert np.array_equal(table(read_archive(tmp_path / "parts")), table(joined(stacked(1), stacked(2))))


def test_the_scan_and_not_the_range_decides_how_many_bits_a_channel_has(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A dark range of a scan in 16 bits must not be taken for one in eight."""
    monkeypatch.setattr(survey, "RANGE_POINTS", (100, 100))
    truth = coloured(3)
    truth.rgb[:100] = 0
    path = write_las(tmp_path / "a.las", truth)
    import laspy

    las = laspy.read(path)
    las.red[:100] = 200  # less than one step of eight bits
    las.write(str(path))
    build([path], tmp_path / "a", keep=frozenset({"rgb"}), **GRID)
    assert np.array_equal(read_archive(tmp_path / "a").rgb.sum(axis=0), truth.rgb.sum(axis=0))


def test_adding_and_removing_keeps_the_colours_of_all_others(tmp_path: Path) -> None:
    parts = [coloured(8), coloured(9), stacked(10)]
    paths = [
        write_las(tmp_path / "a.las", parts[0], 3, 1),
        write_las(tmp_path / "b.laz", parts[1]),
        write_ply(tmp_path / "c.ply", parts[2], text=False, kind="u2"),
    ]
    target = tmp_path / "a"
    build(paths[:1], target, keep=KEEP, **GRID)
    origin = [
        np.rint((part.xyz - parts[0].xyz.min(axis=0)) * 1000) for part in parts
    ]  # the lattice is that of the first scan
    assert all((steps == np.rint(steps)).all() for steps in origin)
    add_scans(target, paths[1:], jobs=1)
    assert np.array_equal(table(read_archive(target)), table(joined(*parts)))
    remove_scans(target, [str(paths[1])], jobs=1)
    assert np.array_equal(table(read_archive(target)), table(joined(parts[0], parts[2])))
    with Archive(target) as archive:
        assert archive.header.format_version == 5 and archive.header.generation == 2
        level = open_level(archive)
        assert level is not None and level.header.rgb
        level.close()
    assert verify_archive(target, deep=True).faults == ()


# --- the level and the preview ------------------------------------------------------------------------------


def level_rows(folder: Path, archive_folder: Path) -> list[tuple]:
    """Position, intensity, colour and class of the points of an archive or a level."""
    rows = []
    with Archive(folder) as archive:
        for row in range(len(archive.voxels)):
            voxel, links = archive.read_voxel(row)
            steps = voxel_points(voxel, links) + archive.coordinates[row] * archive.header.lattice.voxel_steps
            columns = (steps, voxel.intensity, voxel.rgb, voxel.classification)
            rows += zip(*(column.tolist() for column in columns), strict=True)
    return [(*map(tuple, (xyz, rgb)), light, kind) for xyz, light, rgb, kind in rows]


def test_representatives_have_the_columns_of_the_points_that_they_are(tmp_path: Path) -> None:
    paths = [write_las(tmp_path / "a.las", stacked(11)), write_las(tmp_path / "b.las", coloured(12, 2000))]
    build(paths, tmp_path / "a", keep=KEEP, **GRID)
    points = level_rows(tmp_path / "a", tmp_path / "a")
    chosen = level_rows(tmp_path / "a" / "level", tmp_path / "a")
    assert 20 < len(chosen) < len(points)
    assert set(chosen) <= set(points)
    with Archive(tmp_path / "a") as archive:
        level = open_level(archive)
        assert level is not None
        with level:
            assert not level.header.scan_index
            assert level.header.intensity and level.header.rgb and level.header.classification


# --- export -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("suffix", "bright"), [("laz", True), ("las", False), ("ply", True)])
def test_an_export_builds_into_the_same_points_and_colours(suffix: str, bright: bool, tmp_path: Path) -> None:
    truth = coloured(18)
    if not bright:
        truth = truth._replace(rgb=truth.rgb // 200)
    build([write_ply(tmp_path / "a.ply", truth, text=False, kind="u1")], tmp_path / "a", keep=KEEP, **GRID)
    export_archive(tmp_path / "a", tmp_path / f"out.{suffix}")
    found = read_scan(tmp_path / f"out.{suffix}")
    assert np.array_equal(table(found), table(truth))
