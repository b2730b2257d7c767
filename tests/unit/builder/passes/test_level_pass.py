"""Levels of detail as written: every point is covered, every bound encloses, and changes renew them."""

import shutil
from pathlib import Path

import archive_cases
import numpy as np
import pytest
import synthetic_scans
from archive_edits import Build
from archive_edits import built as built  # the fixtures
from archive_edits import files as files
from forged_archives import Columns, forge, put_rows, read_rows
from numpy.typing import NDArray
from solidcloud.builder.edit.edit_archive import add_scans
from solidcloud.builder.passes.level_pass import write_level
from solidcloud.builder.passes.verify import verify_archive
from solidcloud.builder.voxel.exact_enclosure import loose_nodes
from solidcloud.builder.voxel.record_points import voxel_points
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.archive.level import COVER_RADII, LEVEL_FOLDER, level_id, open_level

# Scans of all kinds; and points farther apart than any cover radius.
KINDS = ["corner", "duplicates", "one point", "sparse"]


def scan(kind: str, count: int = 3000) -> NDArray[np.float64]:
    if kind == "sparse":
        return np.random.default_rng(5).uniform(0, 60, (count // 10, 3)).round(3)
    return synthetic_scans.make_scan(kind, 3, count)


def lattice_points(archive: Archive, row: int) -> NDArray[np.int64]:
    """The points of a voxel (n, 3) [voxel steps]."""
    return voxel_points(*archive.read_voxel(row)).astype(np.int64)


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.mark.parametrize("kind", KINDS)
def test_every_point_is_covered_by_a_point_of_its_voxel(kind: str, tmp_path: Path) -> None:
    folder = archive_cases.build(tmp_path, scan(kind), voxel=4.0).archive
    with Archive(folder) as archive:
        level = open_level(archive)
        assert level is not None and level.header.archive_id == level_id(archive.header)
        assert level.header.is_level and level.header.format_version == 5
        step = archive.header.lattice.step
        kept = 0
        with level:
            for row in range(len(archive.voxels)):
                points = lattice_points(archive, row)
                (at,) = np.flatnonzero(level.voxels["key"] == archive.voxels["key"][row])
                voxel, links = level.read_voxel(int(at))
                chosen = voxel_points(voxel, links).astype(np.int64)
                kept += len(chosen)
                assert voxel.radius_class is not None
                assert {tuple(p) for p in chosen.tolist()} <= {tuple(p) for p in points.tolist()}
                assert len({tuple(p) for p in chosen.tolist()}) == len(chosen)
                cover = np.array(COVER_RADII)[voxel.radius_class] / 1e6 / step
                for point in points:
                    apart = np.sqrt(((chosen - point) ** 2).sum(axis=1))
                    assert (apart <= cover * (1 + 1e-12)).any(), point
        assert kept == level.header.points
        assert verify_archive(folder, deep=True).faults == ()


@pytest.mark.parametrize("kind", ["noise", "sparse", "duplicates"])
def test_bounds_enclose_all_points_below(kind: str, tmp_path: Path) -> None:
    """Every point lies inside all nodes above some representative that covers it."""
    folder = archive_cases.build(tmp_path, scan(kind), voxel=4.0, leaf=8).archive
    with Archive(folder) as archive, open_level(archive) as level:  # type: ignore[union-attr]  # it has one
        step = archive.header.lattice.step
        for row in range(len(archive.voxels)):
            points = lattice_points(archive, row)
            voxel, links = level.read_voxel(row)
            assert loose_nodes(voxel, links, list(range(len(voxel.nodes.count)))) == []
            chosen, leaves = voxel_points(voxel, links).astype(np.int64), leaf_of_points(voxel, links)
            cover = np.array(COVER_RADII)[voxel.radius_class] / 1e6 / step
            inside = [
                enclosed(voxel, links, node, points, archive.header.lattice.voxel_steps)
                for node in range(len(voxel.nodes.count))
            ]
            parents = parents_of(voxel, links)
            for i, point in enumerate(points):
                near = np.flatnonzero(np.sqrt(((chosen - point) ** 2).sum(axis=1)) <= cover * (1 + 1e-12))
                assert any(all(inside[node][i] for node in above(leaves[at], parents)) for at in near), point


def parents_of(voxel, links):  # type: ignore[no-untyped-def]
    parents = np.full(len(voxel.nodes.count), -1)
    for node in np.flatnonzero(~links.is_leaf):
        parents[links.first[node] : links.first[node] + voxel.nodes.count[node]] = node
    return parents


def leaf_of_points(voxel, links):  # type: ignore[no-untyped-def]
    leaf = np.flatnonzero(links.is_leaf)
    leaf = leaf[np.argsort(links.first[leaf], kind="stable")]
    return np.repeat(leaf, voxel.nodes.count[leaf].astype(int))


def above(node: int, parents: NDArray[np.int64]) -> list[int]:
    found = []
    while node >= 0:
        found.append(int(node))
        node = parents[node]
    return found


def enclosed(voxel, links, node, points, voxel_steps):  # type: ignore[no-untyped-def]
    """Which points (n,) a node encloses, by FORMAT.md."""
    cell = links.cell[node]
    unit = 1 if cell >= 0 else 1 << max(0, int(voxel_steps - 1).bit_length() - 16)
    corner = voxel.cells.low[cell].astype(np.int64) if cell >= 0 else 0
    apart = points - (corner + voxel.nodes.center[node].astype(np.int64) * unit)
    along = apart @ voxel.nodes.normal[node].astype(np.int64)
    low, high = voxel.nodes.slab[node]
    in_slab = (low <= along) & (along <= high) if voxel.nodes.normal[node].any() else True
    return ((apart**2).sum(axis=1) <= (int(voxel.nodes.radius[node]) * unit) ** 2) & in_slab


def test_bytes_depend_on_the_archive_alone(tmp_path: Path) -> None:
    folder = archive_cases.build(tmp_path, scan("noise"), voxel=2.0).archive
    before = contents(folder / LEVEL_FOLDER)
    write_level(folder)
    assert contents(folder / LEVEL_FOLDER) == before


def test_a_change_renews_the_level(built: Build, tmp_path: Path) -> None:
    target = built(tmp_path / "x", "a")
    old = contents(target / LEVEL_FOLDER)
    more = synthetic_scans.write_ply(tmp_path / "more.ply", np.array([[1.1, 1.1, 1.1]]))
    kept = shutil.copytree(target / LEVEL_FOLDER, tmp_path / "kept")
    add_scans(target, [more], jobs=1)
    assert contents(target / LEVEL_FOLDER) != old
    assert verify_archive(target, deep=True).faults == ()
    shutil.rmtree(target / LEVEL_FOLDER)
    shutil.copytree(kept, target / LEVEL_FOLDER)
    with Archive(target) as archive:
        assert open_level(archive) is None, "a level of another generation is none"
    report = verify_archive(target, deep=True)
    assert report.faults == () and any("another archive or generation" in note for note in report.notes)


def test_a_level_that_claims_less_than_it_covers_is_a_fault(tmp_path: Path) -> None:
    """Its checksums are right and its records sound: only the archive's points contradict it."""
    folder = archive_cases.build(tmp_path, scan("noise"), voxel=4.0).archive

    def change(columns: Columns) -> None:
        for voxel in range(len(columns["voxels"])):
            rows = read_rows(folder / LEVEL_FOLDER, columns, voxel, 2)
            rows["radius_class"] = 0
            put_rows(folder / LEVEL_FOLDER, columns, voxel, 2, rows)
        columns["radius_counts"][:] = 0
        columns["radius_counts"][0] = columns["points"][0]

    forge(folder / LEVEL_FOLDER, change)
    assert verify_archive(folder).faults == ()
    faults = verify_archive(folder, deep=True).faults
    assert faults and all("is not the level of the archive's points" in fault for fault in faults)


def test_points_outside_their_voxel_are_faults_and_no_indices(tmp_path: Path) -> None:
    """With bounds checked, making the level of such points would raise IndexError."""
    folder = archive_cases.build(tmp_path, scan("noise"), voxel=4.0).archive

    def change(columns: Columns) -> None:
        rows = read_rows(folder, columns, 0, 2)
        rows["xyz"] = np.iinfo(np.uint16).max
        put_rows(folder, columns, 0, 2, rows)

    forge(folder, change)
    faults = verify_archive(folder, deep=True).faults
    assert faults and "outside its cell" in faults[0]
