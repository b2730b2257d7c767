"""Test an opened archive: its content, an index that contradicts it, and changes meanwhile."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from six_scans import LATER, dataset, rewrite_index, rows_of
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.voxel.record_points import voxel_points
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.archive.archive_writer import write_index
from solidcloud.schemas.archive.index import RadiusNow
from solidcloud.schemas.errors import FormatError


def test_the_index_tells_what_went_in(built: Path) -> None:
    with Archive(built) as archive:
        header = archive.header
        scans = dataset()
        assert header.points == sum(len(xyz) for xyz, _ in scans) == archive.voxels["rows"][:, 2].sum()
        assert sorted(s.count for s in header.sources) == sorted(len(xyz) for xyz, _ in scans)
        assert [s.sha256 for s in header.sources] == sorted(s.sha256 for s in header.sources)
        assert (header.degree, header.leaf, header.scan_index, header.intensity) == (4, 16, True, True)
        assert header.options == BuildConfig(
            voxel=0.9, cell_points=60, leaf=16, degree=4, keep=frozenset({"scan", "intensity"})
        ).identity()  # fmt: skip
        assert header.unknown.shape == (0, 2, 3)
        assert not header.unknown_everywhere
        lattice = np.concatenate([header.lattice.to_lattice(xyz) for xyz, _ in scans])
        assert np.array_equal(header.low, lattice.min(axis=0))
        assert np.array_equal(header.high, lattice.max(axis=0))
        for row in range(len(archive.voxels)):
            voxel, links = archive.read_voxel(row)
            local = voxel_points(voxel, links)
            mine = lattice[(header.lattice.voxel_of(lattice) == archive.coordinates[row]).all(axis=1)]
            base = archive.coordinates[row] * header.lattice.voxel_steps
            assert np.array_equal(rows_of(local + base), rows_of(mine))
            assert np.array_equal(archive.voxels["low"][row], local.min(axis=0))
            assert np.array_equal(archive.voxels["high"][row], local.max(axis=0))
            assert archive.voxels["leaves"][row] == links.is_leaf.sum()


def test_an_archive_that_changes_while_it_is_opened_is_read_once_more(
    copy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    index, shards = copy / "index.h5", copy / "shards"
    checked = Archive._check_shards
    done = []

    def change(archive: Archive) -> None:
        """What adds a scan does: shards of other names, the index replaced, the old ones deleted."""
        checked(archive)
        if not done:
            done.append(True)
            shutil.copytree(LATER, copy / "new")
            for path in (copy / "new" / "shards").iterdir():
                path.rename(shards / path.name)
            (copy / "new" / "index.h5").replace(index)
            (shards / "0-000000.h5").unlink()

    monkeypatch.setattr(Archive, "_check_shards", change)
    with Archive(copy) as archive:
        assert archive.header.generation == 2
        archive.read_voxel(0)
    (shards / "1-000000.h5").unlink()
    with pytest.raises(FormatError, match=r"1-000000\.h5: missing"):
        Archive(copy)


@pytest.mark.parametrize(
    "change",
    [
        {"generation": 1, "radius_now": RadiusNow(float("nan"), 0.0, 3)},
        {"generation": 1, "radius_now": RadiusNow(-0.1, 0.0, 3)},
        {"generation": 1, "radius_now": RadiusNow(0.1, float("inf"), 3)},
        {"generation": 1, "radius_now": RadiusNow(0.1, 0.0, -3)},
    ],
)
def test_a_generation_that_is_none_is_refused(change: dict[str, Any], copy: Path) -> None:
    with Archive(copy) as archive:
        header, shards = archive.header, archive.shards()
        write_index(copy, replace(header, **change), archive.voxels, shards)
    with pytest.raises(FormatError, match=r"radius_now .*expected a radius"):
        Archive(copy)
    good = RadiusNow(0.25, 0.125, 7)
    write_index(copy, replace(header, generation=2**32 - 1, radius_now=good), archive.voxels, shards)
    with Archive(copy) as archive:
        assert (archive.header.generation, archive.header.radius_now) == (2**32 - 1, good)
    write_index(copy, replace(header, generation=1), archive.voxels, shards)
    with Archive(copy) as archive:
        assert (archive.header.generation, archive.header.radius_now) == (1, None)


def test_an_index_that_points_beyond_its_shard_is_refused(copy: Path) -> None:
    rewrite_index(copy, lambda rows: rows["frame_offset"].__setitem__((0, 0), 1 << 40))
    with pytest.raises(FormatError, match="beyond a shard's end"):
        Archive(copy)


def test_an_index_that_names_no_shard_of_its_own_is_refused(copy: Path) -> None:
    rewrite_index(copy, lambda rows: rows["shard"].__setitem__(0, 1))
    with pytest.raises(FormatError, match="is inconsistent"):
        Archive(copy)


def test_an_index_that_names_a_voxel_twice_is_refused(copy: Path) -> None:
    rewrite_index(copy, lambda rows: rows["key"].__setitem__(1, rows["key"][0]))
    with pytest.raises(FormatError, match="is inconsistent"):
        Archive(copy)


def test_a_key_of_more_than_three_coordinates_is_refused(copy: Path) -> None:
    # Its coordinates are those of the key without the bit: two voxels in one place.
    def widen(rows: np.ndarray) -> None:
        rows["key"][-1] |= np.uint64(1 << 63)

    rewrite_index(copy, widen)
    with pytest.raises(FormatError, match="is inconsistent"):
        Archive(copy)


def test_a_shard_name_that_leads_elsewhere_is_refused(copy: Path) -> None:
    with Archive(copy) as archive:
        write_index(copy, archive.header, archive.voxels, [("../../secret.h5", 10)])
    with pytest.raises(FormatError, match="shard name"):
        Archive(copy)


def test_a_closed_archive_is_not_read(built: Path) -> None:
    with Archive(built) as archive:
        archive.read_frames(0)
    with pytest.raises(ValueError, match="closed"):
        archive.read_frames(0)


def test_rows_out_of_order_are_refused(copy: Path) -> None:
    # The broad phase searches ascending keys: it would call clear what it does not find.
    def reverse(rows: np.ndarray) -> None:
        rows[:] = rows[::-1].copy()

    rewrite_index(copy, reverse)
    with pytest.raises(FormatError, match="is inconsistent"):
        Archive(copy)


def test_bounds_of_voxels_that_are_not_the_scenes_are_refused(copy: Path) -> None:
    def widen(rows: np.ndarray) -> None:
        rows["high"][:, 2] += 1

    rewrite_index(copy, widen)
    with pytest.raises(FormatError, match="bounds are not the scene's"):
        Archive(copy)


def test_an_archive_that_is_replaced_stays_the_one_opened(copy: Path) -> None:
    with Archive(copy) as archive:
        shutil.rmtree(copy)
        assert len(archive.read_voxel(0)[0].points) > 0


def test_a_shard_that_is_deleted_while_it_is_looked_at_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As by a change that ends just then: whoever opens the archive may take the new index, and no bare OSError."""
    shutil.copytree(LATER, tmp_path / "hall")
    look = Path.stat

    def looked(path: Path, **more: Any) -> Any:
        held = look(path, **more)
        if path.suffix == ".h5" and path.name != "index.h5":
            path.unlink()
        return held

    with monkeypatch.context() as patch:
        patch.setattr(Path, "stat", looked)
        with pytest.raises(FormatError, match=r"\.h5: "):
            Archive(tmp_path / "hall")
