"""Archives with colours and classes: every point keeps its own, through builds, changes, levels and exports."""

import shutil
from collections.abc import Callable
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
from forged_archives import Columns, forge, put_rows, read_index, read_rows, write_index
from interrupted_builds import interrupted
from numpy.typing import NDArray
from small_builds import build, content
from solidcloud.builder.edit.edit_archive import add_scans, remove_scans
from solidcloud.builder.export.export_archive import export_archive
from solidcloud.builder.passes.verify import verify_archive
from solidcloud.builder.voxel.record_points import voxel_points
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.archive.level import open_level
from solidcloud.schemas.archive.vtkhdf import PREVIEW_NAME, read_points
from solidcloud.schemas.errors import BadRequestError, FormatError
from solidcloud.server.archives.masked_archive import MaskedArchive

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


@pytest.mark.parametrize("keep", [{"rgb"}, {"classification"}, {"rgb", "classification"}, set(KEEP)])
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


def test_radius_classes_stand_beside_colours(tmp_path: Path) -> None:
    truth = coloured(2)
    models = frozenset({"mean", "local", "border"})
    write_las(tmp_path / "a.las", truth)
    build([tmp_path / "a.las"], tmp_path / "a", keep=KEEP, models=models, **GRID)
    assert verify_archive(tmp_path / "a", deep=True).faults == ()
    assert np.array_equal(table(read_archive(tmp_path / "a")), table(truth))


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


def test_the_id_is_that_of_points_with_their_colours(tmp_path: Path) -> None:
    ids = []
    for number, change in enumerate(("none", "rgb", "classes")):
        truth = coloured(4)
        if change != "none":
            getattr(truth, change)[17] ^= 1
        path = write_las(tmp_path / f"{number}.las", truth)
        build([path], tmp_path / f"{number}", keep=frozenset({"rgb", "classification"}), **GRID)
        with Archive(tmp_path / f"{number}") as archive:
            ids.append(archive.header.archive_id)
    assert len(set(ids)) == 3


def thinned(points: Coloured) -> NDArray[np.int64]:
    """Of equal positions the first by colour and class: as `--thin` of one step keeps them, brute force."""
    rows = table(points)
    rows = rows[np.lexsort(rows[:, ::-1].T)]
    first = np.append(True, (rows[1:, :3] != rows[:-1, :3]).any(axis=1))
    return rows[first][np.lexsort(rows[first].T)]


def test_thinning_keeps_the_first_by_colour_and_class(tmp_path: Path) -> None:
    truth = stacked(5)
    paths = []
    for number, part in enumerate((slice(0, 150), slice(150, None))):
        points = Coloured(*(column[part] for column in truth))
        paths.append(write_ply(tmp_path / f"{number}.ply", points, text=False, kind="u1"))
    keep = frozenset({"rgb", "classification"})
    # One scan, so that the order of scans does not decide.
    whole = write_ply(tmp_path / "whole.ply", truth, text=False, kind="u1")
    build([whole], tmp_path / "a", keep=keep, thin=0.001, **GRID)
    assert np.array_equal(table(read_archive(tmp_path / "a")), thinned(truth))
    build(paths, tmp_path / "b", keep=keep, thin=0.001, **GRID)
    build(paths[::-1], tmp_path / "c", keep=keep, thin=0.001, **GRID)
    assert content(tmp_path / "b") == content(tmp_path / "c")


def test_a_resumed_build_has_the_bytes_of_an_undisturbed_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(survey, "RANGE_POINTS", (100, 100))
    paths = [
        write_las(tmp_path / "a.las", coloured(6)),
        WRITERS["words.ply"](tmp_path / "b.ply", coloured(7)),
    ]
    options = {"keep": KEEP, **GRID}
    interrupted(tmp_path / "killed", paths, monkeypatch, **options)
    options |= {"voxel": 0.9, "cell_points": 60, "leaf": 16, "degree": 4}
    build(paths, tmp_path / "killed", **options)
    build(paths, tmp_path / "whole", **options)
    assert content(tmp_path / "killed") == content(tmp_path / "whole")


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


def test_a_level_of_another_colour_is_a_fault(tmp_path: Path) -> None:
    build([write_las(tmp_path / "a.las", coloured(13))], tmp_path / "a", keep=KEEP, **GRID)
    level = tmp_path / "a" / "level"

    def change(columns: Columns) -> None:
        rows = read_rows(level, columns, 0, 2)
        rows["rgb"][0, 1] ^= 4
        put_rows(level, columns, 0, 2, rows)

    forge(level, change)
    assert verify_archive(tmp_path / "a").faults == ()
    faults = verify_archive(tmp_path / "a", deep=True).faults
    assert len(faults) == 1 and "is not the level of the archive's points" in faults[0]


def test_a_level_without_the_columns_of_its_archive_is_refused(tmp_path: Path) -> None:
    path = write_las(tmp_path / "a.las", coloured(14))
    build([path], tmp_path / "a", keep=frozenset({"rgb"}), **GRID)
    level = tmp_path / "a" / "level"
    index = read_index(level)
    index.columns["columns"][:] = [0, 0, 0, 0, 0, 0, 1]
    write_index(level, index)
    with Archive(tmp_path / "a") as archive, pytest.raises(FormatError, match="columns"):
        open_level(archive)


def test_the_preview_has_colours_and_classes(tmp_path: Path) -> None:
    truth = coloured(15)
    build([write_las(tmp_path / "a.las", truth)], tmp_path / "a", keep=KEEP, **GRID)
    found = read_points(tmp_path / "a" / PREVIEW_NAME)
    assert found.columns["rgb"].shape == (len(found.points), 3)
    known = {tuple(row) for row in np.column_stack([truth.rgb, truth.classes]).tolist()}
    held = np.column_stack([found.columns["rgb"], found.columns["classification"]])
    assert {tuple(row) for row in held.tolist()} == known


def test_a_voxel_without_some_points_keeps_the_colours_of_the_rest(tmp_path: Path) -> None:
    truth = joined(coloured(16, 2000), stacked(17))
    build([write_las(tmp_path / "a.las", truth)], tmp_path / "a", keep=KEEP, **GRID)
    low, high = np.array([0.2005, 0.2005, 0.2005]), np.array([1.3005, 1.1005, 1.4005])
    stays = ~((truth.xyz >= low) & (truth.xyz <= high)).all(axis=1)
    rows = []
    with MaskedArchive(tmp_path / "a", [np.stack([low, high])]) as archive:
        lattice = archive.header.lattice
        for row in range(len(archive.voxels)):
            voxel, links = archive.read_voxel(row)
            steps = voxel_points(voxel, links) + archive.coordinates[row] * lattice.voxel_steps
            rows.append(Coloured(lattice.to_world(steps), voxel.rgb, voxel.classification))
    expected = Coloured(*(column[stays] for column in truth))
    assert np.array_equal(table(joined(*rows)), table(expected))


# --- export -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", ["las", "laz", "ply"])
@pytest.mark.parametrize("bright", [True, False])
def test_an_export_builds_into_the_same_points_and_colours(suffix: str, bright: bool, tmp_path: Path) -> None:
    truth = coloured(18)
    if not bright:
        truth = truth._replace(rgb=truth.rgb // 200)
    build([write_ply(tmp_path / "a.ply", truth, text=False, kind="u1")], tmp_path / "a", keep=KEEP, **GRID)
    export_archive(tmp_path / "a", tmp_path / f"out.{suffix}")
    found = read_scan(tmp_path / f"out.{suffix}")
    assert np.array_equal(table(found), table(truth))


def test_an_export_to_vtkhdf_has_colours_of_three_components(tmp_path: Path) -> None:
    truth = coloured(19)
    build([write_las(tmp_path / "a.las", truth)], tmp_path / "a", keep=KEEP, **GRID)
    export_archive(tmp_path / "a", tmp_path / "out.vtkhdf")
    found = read_points(tmp_path / "out.vtkhdf")
    points = Coloured(found.points, found.columns["rgb"], found.columns["classification"])
    assert np.array_equal(table(points), table(truth))


# --- what is refused ----------------------------------------------------------------------------------------


def test_an_unknown_column_is_refused() -> None:
    from solidcloud.builder.config import BuildConfig

    with pytest.raises(BadRequestError, match="rgb, classification"):
        BuildConfig(keep=frozenset({"colour"}))


@pytest.mark.parametrize(
    ("flags", "version", "match"),
    [
        ([1, 1, 0, 0, 0, 0, 0], 5, "columns"),  # seven flags for nothing
        ([1, 1, 0, 0, 0, 1], 5, "columns"),
        ([1, 1, 0, 0, 0, 1, 1, 0], 5, "columns"),
        ([1, 1, 0, 0, 0, 2, 1], 5, "columns"),
        ([1, 1, 0, 0, 1, 1, 1], 5, "the fifth 0"),
        ([1, 1, 1, 0, 0, 1, 1], 5, "datasets"),  # classes without their counts
        ([1, 1, 0, 0, 0, 1, 1], 3, "format_version"),
        ([1, 1, 0, 0, 0, 1, 0], 5, "frame"),  # rows are wider than the columns say: found as they are read
    ],
)
def test_flags_that_do_not_fit_the_archive_are_refused(
    flags: list[int], version: int, match: str, tmp_path: Path
) -> None:
    build([write_las(tmp_path / "a.las", coloured(20))], tmp_path / "a", keep=KEEP, level=False, **GRID)
    index = read_index(tmp_path / "a")
    index.columns["columns"] = np.array(flags, np.uint8)
    write_index(tmp_path / "a", index._replace(version=version))
    if match == "frame":
        assert match in verify_archive(tmp_path / "a").faults[0]
        return
    with pytest.raises(FormatError, match=match):
        Archive(tmp_path / "a")


@pytest.mark.parametrize(
    "change",
    [
        lambda columns: columns["columns"].__setitem__(0, 1),
        lambda columns: columns["columns"].__setitem__(2, 1),
    ],
)
def test_a_level_has_no_scans_or_classes_of_its_own(
    change: Callable[[Columns], None], tmp_path: Path
) -> None:
    build([write_las(tmp_path / "a.las", coloured(21))], tmp_path / "a", keep=KEEP, **GRID)
    shutil.copytree(tmp_path / "a" / "level", tmp_path / "level")
    Archive(tmp_path / "level").close()
    forge(tmp_path / "level", change)
    with pytest.raises(FormatError, match="level and columns"):
        Archive(tmp_path / "level")
