"""Scans added to an archive and removed from it: what a build of all of them would have held."""

from pathlib import Path

import archive_cases
import numpy as np
import synthetic_scans
from archive_edits import (
    EVERYTHING,
    MODELS,
    A,
    B,
    Build,
    C,
    Files,
    all_points,
    content,
    same_scene,
    sort_points,
)
from archive_edits import built as built  # the fixtures
from archive_edits import files as files
from solidcloud.builder.edit.edit_archive import add_scans, remove_scans
from solidcloud.builder.passes.verify import verify_archive
from solidcloud.schemas.archive.archive import Archive
from solidcloud.server.scene import Scene


def test_what_is_added_is_as_if_built_together(built: Build, files: Files, tmp_path: Path) -> None:
    options = {"models": MODELS[-1], "keep": frozenset()}
    target = built(tmp_path / "x", "a", **options)
    summary = add_scans(target, [files.b], jobs=1)
    assert (summary.generation, summary.points_before, summary.points) == (1, len(A), len(A) + len(B))
    same_scene(target, built(tmp_path / "ab", "ab", **options))
    assert np.array_equal(all_points(target), sort_points(A, B))
    summary = add_scans(target, [files.c], jobs=1)
    assert summary.generation == 2
    same_scene(target, built(tmp_path / "abc", "abc", **options))
    assert not verify_archive(target).notes, "the preview is of this generation"


def test_what_is_left_is_as_if_built_without(built: Build, files: Files, tmp_path: Path) -> None:
    options = {"models": MODELS[0], "keep": EVERYTHING}
    target = built(tmp_path / "x", "abc", **options)
    summary = remove_scans(target, [str(files.b)], jobs=1)
    assert (summary.generation, summary.points, summary.scans) == (1, len(A) + len(C), (f"{files.b}[0]",))
    assert summary.gone > 0, "voxels of B alone are not there any more"
    same_scene(target, built(tmp_path / "ac", "ac", **options))
    assert np.array_equal(all_points(target), sort_points(A, C))


def test_neighbours_count_across_several_voxels(built: Build, files: Files, tmp_path: Path) -> None:
    """Where a voxel is smaller than the reach of a neighbour, voxels change in which nothing was added."""
    options = {"models": frozenset({"mean", "local", "border"}), "keep": frozenset({"scan"}), "voxel": 0.3}
    target = built(tmp_path / "x", "a", **options)
    with Archive(built(tmp_path / "ab", "ab", **options)) as both, Archive(target) as archive:
        voxels, steps = len(both.voxels), both.header.lattice.voxel_steps
        assert 0 < archive.header.radius_capped != both.header.radius_capped
    summary = add_scans(target, [files.b], jobs=1)
    of_b = {tuple(voxel) for voxel in (np.rint(B / 1e-3).astype(int) // steps).tolist()}
    assert len(of_b) < summary.built < voxels, "some were, some were not"
    same_scene(target, tmp_path / "ab")
    remove_scans(target, [str(files.a)], jobs=1)
    with Archive(target) as archive:
        assert archive.header.points == len(B)
    assert not verify_archive(target, deep=True).faults


def test_added_and_removed_again_is_as_before(built: Build, files: Files, tmp_path: Path) -> None:
    target = built(tmp_path / "x", "a", keep=EVERYTHING)
    before = content(target)
    add_scans(target, [files.b, files.c], jobs=1)
    assert content(target) != before
    remove_scans(target, [str(files.b), f"{files.c}[0]"], jobs=1)
    assert content(target) == before
    add_scans(target, [files.b], jobs=1)  # removed, and so not in
    same_scene(target, built(tmp_path / "ab", "ab", keep=EVERYTHING))


def test_what_is_not_touched_keeps_its_bytes(built: Build, files: Files, tmp_path: Path) -> None:
    target = built(tmp_path / "x", "a")
    with Archive(target) as archive:
        old = {int(r["key"]): (archive.shards()[r["shard"]][0], r.tobytes()) for r in archive.voxels}
        radius, archive_id = archive.header.radius, archive.header.archive_id
    with (tmp_path / "far.ply").open("w"):
        synthetic_scans.write_ply(tmp_path / "far.ply", np.array([[0.3, 0.3, 0.3], [3.1, 3.1, 3.1]]))
    summary = add_scans(target, [tmp_path / "far.ply"], jobs=1)
    assert summary.built == 2 and summary.dead_bytes > 0
    with Archive(target) as archive:
        names = [name for name, _ in archive.shards()]
        assert names == ["0-000000.h5", "1-000000.h5"]
        moved = 0
        for row in archive.voxels:
            if names[row["shard"]].startswith("0-"):
                assert old[int(row["key"])] == ("0-000000.h5", row.tobytes())
            else:
                moved += 1
        assert moved == 2
        header = archive.header
        assert (header.radius, header.archive_id) == (radius, archive_id), "as they were built"
        assert header.generation == 1 and header.format_version == 3


def test_the_figure_of_now_stands_beside_the_one_that_is_stored(
    built: Build, files: Files, tmp_path: Path
) -> None:
    target = built(tmp_path / "x", "a")
    with Archive(target) as archive:
        stored = archive.header.radius
    summary = add_scans(target, [files.b], jobs=1)
    with Archive(built(tmp_path / "ab", "ab")) as archive:
        expected = archive.header
    with Archive(target) as archive:
        now = archive.header.radius_now
    assert now is not None and summary.radius_now == now
    assert (now.radius, now.error, now.sample) == (
        expected.radius, expected.radius_error, expected.radius_sample,
    )  # fmt: skip
    assert summary.radius == stored != now.radius
    with Scene.open(target) as scene:
        info = scene.info()
        assert (info.generation, info.radius, info.radius_now) == (1, stored, now.radius)


def test_what_touches_is_by_brute_force_the_same(built: Build, files: Files, tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    body = np.array([[0.0, 0, 0], [0.1, 0, 0.05]])
    target = built(tmp_path / "x", "a", keep=EVERYTHING, radius=0.01)
    for change, points in (
        (lambda: add_scans(target, [files.b, files.c], jobs=1), np.vstack([A, B, C])),
        (lambda: remove_scans(target, [str(files.a)], jobs=1), np.vstack([B, C])),
    ):
        change()
        case = archive_cases.Case(target, points)
        poses = archive_cases.near_poses(rng, points, body, 200, 0.1)
        expected = case.judge(body, 0.02, poses)
        assert 20 < expected.sum() < 180
        assert archive_cases.ask(case, body, 0.02, poses).astype(bool).tolist() == expected.tolist()


def test_contacts_name_the_scan_they_are_of(built: Build, files: Files, tmp_path: Path) -> None:
    target = built(tmp_path / "x", "ab", keep=EVERYTHING, radius=0.01)
    remove_scans(target, [str(files.b)], jobs=1)
    add_scans(target, [files.c], jobs=1)
    with Scene.open(target) as scene:
        info = scene.info()
        scene.add_avatar("al", np.zeros((1, 3)), 0.001)
        for name, point in (("a.ply", A[5]), ("c.ply", C[5])):
            found = scene.contacts("al", archive_cases.pose_of(np.eye(3), point)[None])
            named = {Path(info.sources[scan].path).name for scan in found.scan_index.tolist()}
            assert name in named and "b.ply" not in named
        gone = next(source for source in info.sources if source.path == str(files.b))
        assert (gone.count, "removed in generation 1" in gone.fault) == (0, True)
