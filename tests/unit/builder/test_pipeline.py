"""Scans in, one archive out: the same bytes however it is made, and what is stored. Errors: test_pipeline_errors.py."""

from pathlib import Path

import h5py
import hdf5plugin  # noqa: F401  see test_two_jobs_write_the_bytes_of_one
import numpy as np
import pytest
import solidcloud.builder.build_limits as build_limits
import solidcloud.builder.passes.spool_pass as partition
import solidcloud.builder.passes.survey_pass as survey
import solidcloud.builder.pipeline as pipeline
from small_builds import build, content, six_files
from solidcloud.builder.passes.verify import verify_archive
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.errors import ScanError
from synthetic_scans import make_scan, write_las, write_ply, write_xyz


def records(archive: Path) -> list[tuple[int, bytes, bytes]]:
    """Key, nodes and points of each voxel as compressed: everything of a record but the archive's id."""
    with Archive(archive) as opened:
        return [(int(r["key"]), *opened.read_frames(i)[1:]) for i, r in enumerate(opened.voxels)]


@pytest.fixture
def scans(tmp_path: Path) -> list[Path]:
    """Six scans as text."""
    return six_files(tmp_path)


@pytest.fixture
def out(tmp_path: Path) -> Path:
    """An empty folder for archives."""
    folder = tmp_path / "out"
    folder.mkdir()
    return folder


# --- the same bytes ---------------------------------------------------------------------------------------


@pytest.mark.case(
    27,
    "an archive's bytes for any order of files and any bound on memory",
)
def test_the_bytes_do_not_depend_on_order_jobs_or_memory(
    scans: list[Path], out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Several shards and several runs, though the dataset is small.
    keep = frozenset({"scan", "intensity"})
    monkeypatch.setattr(build_limits, "SHARD_POINTS", 1200)
    first = build(scans, out / "a", keep=keep)
    assert first.shards > 1
    assert first.voxels > 8
    build(scans[::-1], out / "b", keep=keep)
    build([scans[0].parent], out / "c", keep=keep)
    build(scans, out / "d", keep=keep, memory_bytes=64 << 20)
    assert content(out / "a") == content(out / "b") == content(out / "d")
    assert content(out / "a") == content(out / "c")


@pytest.mark.case(27, "an archive's bytes for one job and two")
def test_two_jobs_write_the_bytes_of_one(scans: list[Path], out: Path) -> None:
    # Here a plugin for the zstd filter is loaded, in the spawned processes it is not: HDF5 would write its name.
    assert h5py.h5z.filter_avail(32015)  # zstd
    build(scans, out / "a")
    build(scans, out / "b", jobs=2)
    assert content(out / "a") == content(out / "b")


@pytest.mark.case(27, "an archive's bytes from one run of points and from three")
def test_a_small_memory_bound_gives_several_runs_and_the_same_bytes(
    out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    raw = np.random.default_rng(5).integers(0, 4000, (600_000, 3)) * [1, 1, 0]
    write_las(tmp_path / "a.las", raw)
    runs: list[int] = []
    spool = pipeline.spool_scans

    def counted(*args: object) -> object:
        result = spool(*args)
        runs.append(sum(len(s.runs) for s in result))
        return result

    monkeypatch.setattr(pipeline, "spool_scans", counted)
    options = {"radius": 0.001, "leaf": 32, "degree": 8, "cell_points": 4096}
    build([tmp_path / "a.las"], out / "a", **options)
    # 64 MB, and 100,000 bytes a point claimed by the spool: runs of 2^18 points.
    monkeypatch.setattr(partition, "SPOOL_BYTES_A_POINT", 100_000)
    monkeypatch.setattr(partition, "MIN_RUN_POINTS", 1 << 18)
    build([tmp_path / "a.las"], out / "b", memory_bytes=64 << 20, **options)
    monkeypatch.setattr(survey, "RANGE_POINTS", (1 << 17, 1 << 17))
    build([tmp_path / "a.las"], out / "c", **options)
    assert runs == [1, 3, 5]
    assert content(out / "a") == content(out / "b") == content(out / "c")


def test_a_georeferenced_scene_has_the_records_of_one_at_the_origin(out: Path, tmp_path: Path) -> None:
    # NUMERICS.md case 1; a shift exact in float64 for coordinates that are whole 2^-20 m.
    xyz = np.round(make_scan("corner", 3, 400) * 2**20) / 2**20
    shift = np.array([5e5, 5.6e6, 128.0])
    assert np.array_equal((xyz + shift) - shift, xyz)
    build([write_xyz(tmp_path / "a.xyz", xyz)], out / "a")
    build([write_xyz(tmp_path / "b.xyz", xyz + shift)], out / "b")
    assert records(out / "a") == records(out / "b")
    with Archive(out / "a") as a, Archive(out / "b") as b:
        assert np.array_equal(np.array(b.header.lattice.origin) - shift, a.header.lattice.origin)
        assert np.array(b.header.lattice.origin).tobytes() == (xyz + shift).min(axis=0).tobytes()
        assert a.header.radius == b.header.radius
        assert a.header.archive_id != b.header.archive_id


# --- what is stored and said ------------------------------------------------------------------------------


def test_quantising_moves_no_point_by_more_than_half_a_step(out: Path, tmp_path: Path) -> None:
    xyz = make_scan("noise", 3, 300) + np.array([5e5, 5.6e6, 0])
    summary = build([write_xyz(tmp_path / "a.xyz", xyz)], out / "a", resolution=0.01)
    low = xyz.min(axis=0)
    moved = np.abs(np.rint((xyz - low) / 0.01) * 0.01 + low - xyz).max()
    assert summary.moved_max == moved
    assert 0.0045 < moved <= 0.005 + 1e-9


def test_the_sources_own_lattice_is_kept_to_the_bit_of_their_steps(out: Path, tmp_path: Path) -> None:
    raw = np.random.default_rng(1).integers(-1000, 1000, (2, 200, 3))
    write_las(tmp_path / "a.las", raw[0], scale=0.002, offset=(500.0, 0.0, 0.0))
    write_las(tmp_path / "b.las", raw[1], scale=0.002, offset=(500.25, 0.0, 0.0))
    summary = build([tmp_path / "a.las"], out / "a")
    assert (summary.lattice_step, summary.lattice_source) == (0.002, "sources")
    assert summary.moved_max < 1e-9
    summary = build([tmp_path / "a.las", tmp_path / "b.las"], out / "b")
    assert (summary.lattice_step, summary.lattice_source) == (0.002, "sources")
    write_las(tmp_path / "c.las", raw[1], scale=0.002, offset=(500.0, 0.001, 0.0))
    summary = build([tmp_path / "a.las", tmp_path / "c.las"], out / "c")
    assert (summary.lattice_step, summary.lattice_source) == (0.0001, "default")
    summary = build([tmp_path / "a.las"], out / "d", resolution=0.004)
    assert (summary.lattice_step, summary.lattice_source) == (0.004, "given")


def test_points_that_are_not_finite_are_counted(out: Path, tmp_path: Path) -> None:
    xyz = make_scan("noise", 3, 100)
    xyz[7, 0], xyz[8, 1], xyz[9, 2] = np.nan, -np.inf, 1e300
    write_ply(tmp_path / "a.ply", xyz)
    summary = build([tmp_path / "a.ply"], out / "a")
    assert summary.points == 97
    assert summary.skipped == {"not finite": 2, "beyond 1e9 m": 1}
    assert verify_archive(out / "a", deep=True).faults == ()
    found = r"a\.ply: 2 points that are not finite and 1 points beyond 1e9 m, expected none with --strict"
    with pytest.raises(ScanError, match=found):
        build([tmp_path / "a.ply"], out / "b", strict=True)
    assert [p.name for p in out.iterdir()] == ["a"]
