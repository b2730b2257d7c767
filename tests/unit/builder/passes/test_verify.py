"""`verify_archive` finds nothing in a sound archive, and each fault put into one."""

import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import solidcloud.builder.run.executor as executor_module
from opened_records import points_of
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.passes.verify import verify_archive
from solidcloud.builder.pipeline import build_archive
from solidcloud.builder.spool.run_files import position_hash
from solidcloud.builder.voxel.exact_enclosure import sample_nodes
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.archive.archive_writer import write_index, write_shard
from solidcloud.schemas.archive.codec import encode_voxel
from solidcloud.schemas.archive.index import Header, shard_name
from solidcloud.schemas.archive.voxel import VoxelData
from solidcloud.schemas.errors import FormatError
from solidcloud.server.cli.main import run
from synthetic_scans import WITH_POINTS, make_scan, write_xyz


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sound archive: several voxels of several cells. Not to be changed."""
    folder = tmp_path_factory.mktemp("built")
    files = [write_xyz(folder / f"{i}.xyz", make_scan(kind, i, 200)) for i, kind in enumerate(WITH_POINTS)]
    build_archive(files, folder / "a", BuildConfig(voxel=1.1, cell_points=50, leaf=8, degree=3, jobs=1))
    return folder / "a"


@pytest.fixture
def copy(built: Path, tmp_path: Path) -> Path:
    """A copy of it to be broken."""
    return Path(shutil.copytree(built, tmp_path / "a"))


def rewrite(
    folder: Path,
    spoil: Callable[[VoxelData], VoxelData] = lambda voxel: voxel,
    header_with: Callable[[Header], Header] = lambda header: header,
) -> None:
    """Write shard and index anew, every checksum right, with voxel 1 spoilt, or the header."""
    with Archive(folder) as archive:
        header, rows = archive.header, archive.voxels
        voxels = [archive.read_voxel(row)[0] for row in range(len(rows))]
    voxels[1] = spoil(voxels[1])
    records = [
        (v, encode_voxel(v, header.archive_id), r["low"].astype(np.int64), r["high"].astype(np.int64))
        for v, r in zip(voxels, rows, strict=True)
    ]
    path = folder / "shards" / shard_name(0)
    table, _ = write_shard(path, 0, header.archive_id, records, version=header.format_version)
    write_index(folder, header_with(header), table, [(path.name, path.stat().st_size)])


def test_a_sound_archive_has_no_faults(built: Path) -> None:
    for deep in (False, True):
        report = verify_archive(built, deep=deep)
        assert report.faults == ()
        assert report.voxels > 4
        assert report.points == 5 * 200 + 1


@pytest.mark.parametrize("dataset", [0, 1, 2])
def test_a_flipped_byte_is_one_fault_that_says_where(dataset: int, copy: Path) -> None:
    with Archive(copy) as archive:
        entry, where, path = archive.voxels[2], archive.where(2), archive.shard_path(0)
        points = archive.header.points
    data = bytearray(path.read_bytes())
    data[int(entry["frame_offset"][dataset]) + int(entry["frame_bytes"][dataset]) // 2] ^= 0x10
    path.write_bytes(data)
    report = verify_archive(copy)
    assert len(report.faults) == 1
    assert report.faults[0].startswith(where)
    assert report.points == points - entry["rows"][2]


def shrink_radius(row: Callable[[VoxelData], int]) -> Callable[[VoxelData], VoxelData]:
    """A change of one node's radius, by a tenth."""

    def apply(voxel: VoxelData) -> VoxelData:
        radius = voxel.nodes.radius.copy()
        assert radius[row(voxel)] > 10
        radius[row(voxel)] -= radius[row(voxel)] // 10
        return voxel._replace(nodes=voxel.nodes._replace(radius=radius))

    return apply


def shift_slab(side: int) -> Callable[[VoxelData], VoxelData]:
    """A change of the root's slab, by one step from one side."""

    def apply(voxel: VoxelData) -> VoxelData:
        slab = voxel.nodes.slab.copy()
        slab[0, side] += 1 - 2 * side
        return voxel._replace(nodes=voxel.nodes._replace(slab=slab))

    return apply


LOOSE = {
    "the root's radius": shrink_radius(lambda voxel: 0),
    "a cell's radius": shrink_radius(lambda v: len(v.nodes.count) - int(v.cells.nodes.sum())),
    "a leaf node's radius": shrink_radius(lambda v: int(np.flatnonzero(v.nodes.radius > 10)[-1])),
    "the slab's low side": shift_slab(0),
    "the slab's high side": shift_slab(1),
}


@pytest.mark.parametrize("check", ["deep", "exact"])
@pytest.mark.parametrize("name", list(LOOSE)[1:4])
def test_a_loose_bound_is_found_by_the_checks_of_bounds_alone(name: str, check: str, copy: Path) -> None:
    rewrite(copy, LOOSE[name])
    assert verify_archive(copy).faults == ()
    report = verify_archive(copy, **{check: True})
    (fault,) = report.faults
    with Archive(copy) as archive:
        assert fault.startswith(archive.where(1))
    assert "does not enclose its points" in fault
    assert report.exact_nodes == (report.nodes - 1 if check == "exact" else 0)
    assert run(["validate", str(copy), f"--{check}"]) == 3


def test_a_sample_is_of_nodes_all_over_the_archive_and_the_same_again(built: Path, copy: Path) -> None:
    whole = verify_archive(built, exact=True)
    assert whole.faults == () and whole.exact_nodes == whole.nodes > 100
    for sample, proved in ((1, 1), (60, 60), (whole.nodes - 1, whole.nodes - 1), (10**9, whole.nodes)):
        assert verify_archive(built, exact=True, sample=sample).exact_nodes == proved
    counts = np.array([5, 0, 1000, 1, 7, 0])
    drawn = sample_nodes(counts, 600)
    assert sum(map(len, drawn)) == 600 and [part.tolist() for part in sample_nodes(counts, 600)] == [
        part.tolist() for part in drawn
    ]
    for part, count in zip(drawn, counts, strict=True):
        assert len(np.unique(part)) == len(part) and ((part >= 0) & (part < count)).all()
    assert len(drawn[2]) > 550 and drawn[2].min() < 20 and drawn[2].max() > 980
    # All radii of a voxel halved: a sample finds some of them, of a node it drew.
    rewrite(copy, lambda v: v._replace(nodes=v.nodes._replace(radius=v.nodes.radius // 2)))
    some = verify_archive(copy, exact=True, sample=whole.nodes // 2)
    every = verify_archive(copy, exact=True)
    assert 3 < len(some.faults) < len(every.faults) and set(some.faults) <= set(every.faults)


def test_points_that_are_not_where_the_index_says_are_found(copy: Path) -> None:
    def move(voxel: VoxelData) -> VoxelData:
        leaf = int(np.flatnonzero(voxel.nodes.block_low.any(axis=1))[0])
        low = voxel.nodes.block_low.copy()
        low[leaf] -= low[leaf] > 0
        low[:, 0] //= 2
        return voxel._replace(nodes=voxel.nodes._replace(block_low=low))

    rewrite(copy, move)
    (fault,) = verify_archive(copy).faults
    assert "points from [" in fault and "the index says from [" in fault


def test_points_that_are_not_those_expected_are_a_fault(copy: Path) -> None:
    with Archive(copy) as archive:
        lattice = archive.header.lattice
        places = sum(
            position_hash(int(archive.voxels["key"][row]), points_of(archive.open_voxel(row))[0], lattice)
            for row in range(len(archive.voxels))
        ) % (1 << 64)
    assert verify_archive(copy, places=places).faults == ()
    assert "not those of the scans" in verify_archive(copy, places=places ^ 1).faults[0]


def test_a_wrong_count_in_the_index_is_found(copy: Path) -> None:
    rewrite(copy, header_with=lambda header: replace(header, points=header.points + 1))
    with pytest.raises(FormatError, match=r"1001 points.*expected .*1002"):
        verify_archive(copy)


def test_radius_classes_that_are_not_those_counted_are_a_fault(tmp_path: Path) -> None:
    scan = write_xyz(tmp_path / "a.xyz", make_scan("noise", 1, 200))
    models = frozenset({"mean", "local"})
    build_archive([scan], tmp_path / "a", BuildConfig(voxel=1.1, models=models, radius=0.01, jobs=1))
    assert verify_archive(tmp_path / "a").faults == ()
    with Archive(tmp_path / "a") as archive:
        counts = archive.header.radius_counts.copy()
    used = int(np.flatnonzero(counts)[0])
    counts[used] -= 1
    counts[31] += 1
    rewrite(tmp_path / "a", header_with=lambda header: replace(header, radius_counts=counts))
    (fault,) = verify_archive(tmp_path / "a").faults
    assert "radius classes counted" in fault and str(counts.tolist()) in fault


class Backwards:
    """An executor of four jobs that are one, the last unit first; it counts what it is given."""

    jobs = 4
    given = 0

    def map(
        self, function: Callable[[Any], Any], units: Sequence[Any], progress: object, size: object
    ) -> Iterator[Any]:
        self.given = len(units)
        return iter([function(unit) for unit in reversed(units)][::-1])


@pytest.mark.parametrize("options", [{}, {"exact": True, "sample": 60}])
def test_units_give_the_same_report(
    copy: Path, options: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    rewrite(copy, lambda v: v._replace(nodes=v.nodes._replace(radius=v.nodes.radius // 2)))
    with Archive(copy) as archive:
        entry, path = archive.voxels[4], archive.shard_path(0)
    data = bytearray(path.read_bytes())
    data[int(entry["frame_offset"][2]) + 20] ^= 0x10
    path.write_bytes(data)
    expected = verify_archive(copy, **options)
    assert len(expected.faults) >= (2 if options else 1)
    monkeypatch.setattr(executor_module, "_MIN_POINTS", 1)
    executor = Backwards()
    assert verify_archive(copy, executor=executor, **options) == expected  # type: ignore[arg-type]
    assert executor.given > 4


def test_a_shard_that_no_voxel_is_in_is_a_note(copy: Path) -> None:
    with Archive(copy) as archive:
        header, rows = archive.header, archive.voxels
    dead = copy / "shards" / shard_name(1)
    dead.write_bytes(b"once a shard")
    shards = [(p.name, p.stat().st_size) for p in (copy / "shards" / shard_name(0), dead)]
    write_index(copy, header, rows, shards)
    report = verify_archive(copy)
    assert report.faults == () and report.notes == (f"{dead}: no voxel uses this shard any more",)


def test_other_leaf_nodes_than_the_index_says_are_a_fault(copy: Path) -> None:
    with Archive(copy) as archive:
        header, rows, where = archive.header, archive.voxels.copy(), archive.where(2)
    rows["leaves"][2] += 1
    path = copy / "shards" / shard_name(0)
    write_index(copy, header, rows, [(path.name, path.stat().st_size)])
    (fault,) = verify_archive(copy).faults
    assert fault.startswith(where) and "leaf nodes, the index says" in fault


def test_a_point_outside_its_cell_is_a_fault(copy: Path) -> None:
    def stretch(voxel: VoxelData) -> VoxelData:
        points = voxel.points.copy()
        points[-1] = 60_000
        return voxel._replace(points=points)

    rewrite(copy, stretch)
    (fault,) = verify_archive(copy).faults
    with Archive(copy) as archive:
        assert fault.startswith(archive.where(1)) and "a point outside its cell: restore the shard" in fault
