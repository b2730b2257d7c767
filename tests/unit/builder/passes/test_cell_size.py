"""Test the choice of the cell size for a number of leaf cells: a build with every size is the judge."""

from pathlib import Path
from typing import Any

import interrupted_builds
import numpy as np
import pytest
from archive_edits import Build, Files, same_scene
from archive_edits import built as built  # the fixtures
from archive_edits import files as files
from small_builds import build, content
from solidcloud.builder import build_limits
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.edit.edit_archive import add_scans, remove_scans
from solidcloud.builder.kernels.points.octree_cells import count_capacities, split_octree, voxel_codes
from solidcloud.builder.passes import build_shards
from solidcloud.builder.passes.cell_size import CellCounts, add_counts, nearest_limit
from solidcloud.builder.passes.cell_summary import summarize_cells
from solidcloud.builder.voxel.balance_cells import tree_limits
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.errors import BadRequestError, SolidcloudError
from synthetic_scans import WITH_POINTS, make_scan, make_steps, write_xyz


@pytest.mark.interpreted
@pytest.mark.parametrize("kind", WITH_POINTS)
@pytest.mark.parametrize("largest", [4, 8, 10])
def test_one_traversal_counts_the_cells_of_every_capacity(kind: str, largest: int) -> None:
    codes = np.sort(voxel_codes(make_steps(kind, 5, 200, 1000)))
    n = len(codes)
    counted = np.cumsum(count_capacities(codes, 10, largest)[1:])
    for capacity in range(1, n + 1):
        starts, sizes = split_octree(codes, 10, largest, capacity)
        expected = 0 if sizes.max() == 10 else len(starts)
        root_is_a_leaf_cell = largest >= 10 and n <= capacity
        assert root_is_a_leaf_cell == (expected == 0)
        # The root itself is not counted: the children of a root that is not split end with it.
        assert counted[capacity - 1] == expected, f"capacity {capacity}"


@pytest.mark.interpreted
def test_nearest_number_of_cells_and_ties() -> None:
    counts = CellCounts(np.array([1, 5, 9, 20, 1 << 21]), np.array([100, -40, -20, -30, -9]))
    for asked, limit in [(1000, 1), (81, 1), (80, 1), (79, 5), (60, 5), (50, 5), (49, 9), (10, 20), (1, 20)]:
        assert nearest_limit(counts, asked) == limit, f"{asked} cells"
    both = add_counts([counts, CellCounts(np.array([1, 7]), np.array([10, -3]))])
    assert both.limits.tolist() == [1, 5, 7, 9, 20, 1 << 21]
    assert both.changes.tolist() == [110, -40, -3, -20, -30, -9]


def scans(folder: Path) -> list[Path]:
    """Write two scans: a corner and noise, 250 points each, in several voxels of 0.9 m."""
    return [write_xyz(folder / f"{kind}.xyz", make_scan(kind, 4, 250)) for kind in ("corner", "noise")]


def cells_of(archive: Path) -> tuple[int, int]:
    """Return the number of leaf cells of an archive, and the `cell_points` that it states."""
    with Archive(archive) as opened:
        return summarize_cells(opened).cells, int(opened.header.options["cell_points"])


@pytest.mark.parametrize("kind", ["octree", "balanced"])
@pytest.mark.parametrize("dense", [1 << 20, 40])
def test_cells_are_as_many_as_the_best_of_all_sizes_gives(
    kind: str, dense: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(build_limits, "DENSE_POINTS", dense)
    paths = scans(tmp_path)
    sizes = [4 * 4**h for h in range(4)] if kind == "balanced" else range(1, 26)
    by_size = {}
    # Few voxels, where there are 29 builds.
    options: dict[str, Any] = {
        "voxel": 0.9 if kind == "balanced" else 1.8,
        "leaf": 4,
        "radius": 0.01,
        "overwrite": True,
    }
    for size in sizes:
        build(paths, tmp_path / "a", cells=kind, cell_points=size, **options)
        by_size[size] = cells_of(tmp_path / "a")[0]
    assert len(set(by_size.values())) > 2
    for asked in (1, min(by_size.values()) + 7, 150, 5000):
        build(paths, tmp_path / "b", cells=kind, leaf_cells=asked, **options)
        found, size = cells_of(tmp_path / "b")
        assert asked == 1 or min(by_size.values()) < asked, "larger sizes give still fewer cells"
        least = min(abs(cells - asked) for cells in by_size.values())
        if asked == 1 and kind == "octree":
            assert found <= min(by_size.values()), "more points than any size that was tried"
            continue
        assert abs(found - asked) == least
        assert found == max(cells for cells in by_size.values() if abs(cells - asked) == least)
        assert by_size[size] == found and size == min(s for s in by_size if by_size[s] == found)


def test_archive_states_the_request_and_the_size_and_is_otherwise_the_same(tmp_path: Path) -> None:
    paths = scans(tmp_path)
    build(paths, tmp_path / "asked", leaf_cells=60)
    cells, size = cells_of(tmp_path / "asked")
    assert abs(cells - 60) <= 10
    build(paths, tmp_path / "given", cell_points=size)
    with Archive(tmp_path / "asked") as asked, Archive(tmp_path / "given") as given:
        assert asked.header.options == {**given.header.options, "leaf_cells": 60}
        assert summarize_cells(asked).asked == 60 and summarize_cells(given).asked is None
        for row in range(len(given.voxels)):
            for a, b in zip(asked.read_voxel(row)[0][2:4], given.read_voxel(row)[0][2:4], strict=True):
                assert all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))
    again = build(paths[::-1], tmp_path / "asked", leaf_cells=60)
    assert again.already, "the same request for the same scans"
    build(paths[::-1], tmp_path / "jobs", leaf_cells=60, jobs=2, memory_bytes=300 << 20)
    assert content(tmp_path / "jobs") == content(tmp_path / "asked")


def test_an_interrupted_build_resumes_and_another_number_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    paths = interrupted_builds.two_scans(tmp_path, monkeypatch)
    interrupted_builds.build(tmp_path / "whole", paths, leaf_cells=30)
    # Interrupted before the first shard, and after the first of two.
    interrupted_builds.interrupted(tmp_path / "a", paths, monkeypatch, leaf_cells=30)
    for other in ({"leaf_cells": 31}, {}):
        with pytest.raises(BadRequestError, match=r"--leaf-cells was 30.*--leaf-cells 30"):
            interrupted_builds.build(tmp_path / "a", paths, **other)
    written: list[int] = []
    write = build_shards.build_shard

    def second_fails(unit: build_shards.ShardUnit) -> build_shards.Shard:
        if written:
            raise SolidcloudError("stopped")
        written.append(unit.number)
        return write(unit)

    with monkeypatch.context() as patch:
        patch.setattr(build_shards, "build_shard", second_fails)
        with pytest.raises(SolidcloudError, match="stopped"):
            interrupted_builds.build(tmp_path / "a", paths, leaf_cells=30)
    assert len(written) == 1
    interrupted_builds.build(tmp_path / "a", paths, leaf_cells=30)
    assert content(tmp_path / "a") == content(tmp_path / "whole")


@pytest.mark.parametrize("kind", ["octree", "balanced"])
def test_added_scans_get_cells_of_the_size_that_the_build_chose(
    kind: str, built: Build, files: Files, tmp_path: Path
) -> None:
    options = {"cells": kind, "leaf": 4, "degree": 4, "keep": frozenset({"scan"})}
    target = built(tmp_path / "x", "a", leaf_cells=60, **options)
    before, size = content(target), cells_of(target)[1]
    assert size != BuildConfig().cell_points
    with Archive(target) as archive:
        stored = archive.header.options
    add_scans(target, [files.b], jobs=1)
    with Archive(target) as archive:
        assert archive.header.options == stored and archive.header.generation == 1
    same_scene(target, built(tmp_path / "ab", "ab", cell_points=size, **options))
    remove_scans(target, [str(files.b)], jobs=1)
    same_scene(target, built(tmp_path / "a", "a", cell_points=size, **options))
    assert content(built(tmp_path / "y", "a", leaf_cells=60, **options)) == before


def test_summary_counts_balanced_cells_with_too_few_points(tmp_path: Path) -> None:
    build(scans(tmp_path), tmp_path / "a", cells="balanced", resolution=1e-5, voxel=0.9)
    with Archive(tmp_path / "a") as archive:
        found = summarize_cells(archive)
        held = np.concatenate([archive.read_voxel(row)[0].cells.points for row in range(len(archive.voxels))])
    fewest, most = tree_limits(60, 16, 4)
    assert (found.fewest, found.most) == (fewest, most) == (17, 64)
    assert found.heights == {2: found.cells} and found.cells == len(held)
    assert found.small == (held < fewest).sum() > 0


def test_options_of_a_build_name_the_request_only_if_there_is_one() -> None:
    assert "leaf_cells" not in BuildConfig().identity()
    config = BuildConfig(leaf_cells=7)
    stored = {**config.identity(), "cell_points": 33}
    assert config.is_identity(stored) and not BuildConfig(leaf_cells=8).is_identity(stored)
    assert not BuildConfig(cell_points=33).is_identity(stored)
    assert not BuildConfig().is_identity(BuildConfig(cell_points=33).identity())
