"""Test an opened archive: its content, an index that contradicts it, and changes meanwhile."""

import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from six_scans import LATER, dataset, rewrite_index, rows_of
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.voxel.record_points import voxel_points
from solidcloud.schemas.archive.archive import Archive
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
            mine = lattice[(lattice // header.lattice.voxel_steps == archive.coordinates[row]).all(axis=1)]
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


def test_an_index_that_points_beyond_its_shard_is_refused(copy: Path) -> None:
    rewrite_index(copy, lambda rows: rows["frame_offset"].__setitem__((0, 0), 1 << 40))
    with pytest.raises(FormatError, match="beyond a shard's end"):
        Archive(copy)


def test_rows_out_of_order_are_refused(copy: Path) -> None:
    # The broad phase searches ascending keys: it would call clear what it does not find.
    def reverse(rows: np.ndarray) -> None:
        rows[:] = rows[::-1].copy()

    rewrite_index(copy, reverse)
    with pytest.raises(FormatError, match="is inconsistent"):
        Archive(copy)


def same_index(folder: Path, expected: Archive) -> bool:
    """Whether an archive's header and rows are the expected ones, byte for byte."""
    with Archive(folder) as archive:
        shards = [archive.shard_path(i).name for i in range(archive.shard_count())]
        return (
            repr(archive.header) == repr(expected.header)
            and archive.voxels.tobytes() == expected.voxels.tobytes()
            and shards == [expected.shard_path(i).name for i in range(expected.shard_count())]
        )


def test_flipped_bytes_of_the_index_are_refused_or_mean_nothing(copy: Path, built: Path) -> None:
    path = copy / "index.h5"
    good = path.read_bytes()
    passed = 0
    # Every byte takes over a minute (done once with 14,303: none silently wrong, no hang); a sample of them here.
    chosen = np.random.default_rng(len(good)).choice(len(good), 200, replace=False)
    with Archive(built) as expected:
        for at in chosen.tolist():
            broken = bytearray(good)
            broken[at] ^= 0xFF
            path.write_bytes(broken)
            try:
                assert same_index(copy, expected), f"byte {at}"
                passed += 1
            except FormatError as error:
                assert str(path) in str(error), f"byte {at}"
    assert passed < len(chosen) // 2  # what HDF5 leaves unused between and in its blocks


@pytest.mark.parametrize("share", [0.0, 0.01, 0.3, 0.9, 0.999])
def test_a_truncated_index_is_refused(share: float, copy: Path) -> None:
    path = copy / "index.h5"
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * share)])
    with pytest.raises(FormatError, match=r"index\.h5: not a readable archive index .*restore or rebuild"):
        Archive(copy)


def test_what_is_no_archive_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"nothing: no archive here .*solidcloud build"):
        Archive(tmp_path / "nothing")
    with pytest.raises(FormatError, match="no archive here"):
        Archive(tmp_path)
    (tmp_path / "index.h5").write_text("no HDF5 at all\n" * 100)
    with pytest.raises(FormatError, match="not a readable archive index"):
        Archive(tmp_path)
    (tmp_path / "index.h5").unlink()
    with h5py.File(tmp_path / "index.h5", "w") as file:
        file["points"] = [1]
    with pytest.raises(FormatError, match="not a solidcloud index"):
        Archive(tmp_path)


def edit(path: Path, change: Callable[[h5py.File], None]) -> None:
    """Change an index in place."""
    with h5py.File(path, "r+", libver=("v110", "v110")) as file:
        change(file)


def set_attribute(name: str, value: object) -> Callable[[h5py.File], None]:
    """A change of one attribute of the root."""
    return lambda file: file.attrs.__setitem__(name, value)


def replace_with(name: str, make: Callable[[h5py.File, str], None]) -> Callable[[h5py.File], None]:
    """A change of one dataset for something else."""

    def change(file: h5py.File) -> None:
        del file[name]
        make(file, name)

    return change


def virtual(file: h5py.File, name: str) -> None:
    """A dataset whose bytes are in another file."""
    layout = h5py.VirtualLayout((3,), "<f8")
    layout[:] = h5py.VirtualSource("/etc/hostname", "x", (3,))
    file.create_virtual_dataset(name, layout)


EDITS: dict[str, tuple[Callable[[h5py.File], None], str]] = {
    "other version": (set_attribute("format_version", np.uint32(6)), "format version 6, .* reads 1, 2, 3, 5"),
    "other format": (set_attribute("format", np.bytes_("solidcloud shard")), "not a solidcloud index"),
    "other units": (set_attribute("units", np.bytes_("ft")), "units 'ft', expected 'm'"),
    "text of variable length": (set_attribute("format", "solidcloud"), "not a solidcloud index"),
    "other id": (set_attribute("archive_id", np.zeros(16, "u1")), "checksum differs"),
    "other number": (lambda f: f["origin"].__setitem__(0, 1.0), "checksum differs"),
    "dataset gone": (lambda f: f.__delitem__("origin"), "checksum differs"),
    "dataset more": (lambda f: f.__setitem__("zzz", [1]), "dataset 'zzz': expected one of"),
    "checksum gone": (lambda f: f.attrs.__delitem__("sha256"), "not a readable archive index"),
    "external link": (
        replace_with("origin", lambda f, n: f.__setitem__(n, h5py.ExternalLink("other.h5", "/x"))),
        "origin is not a plain dataset",
    ),
    "soft link": (replace_with("origin", lambda f, n: f.__setitem__(n, h5py.SoftLink("/step"))), "origin is no"),
    "virtual dataset": (replace_with("origin", virtual), "origin is not a plain dataset"),
    "external storage": (
        replace_with(
            "origin", lambda f, n: f.create_dataset(n, (3,), "<f8", external=[("/etc/hostname", 0, 24)])
        ),
        "origin is not a plain dataset",
    ),
    "group": (replace_with("origin", lambda f, n: f.create_group(n)), "origin is not a plain dataset"),
    "chunked": (
        replace_with("origin", lambda f, n: f.create_dataset(n, (1 << 30,), "<f8", chunks=(8,))), "origin is no",
    ),
    "text": (
        replace_with("origin", lambda f, n: f.create_dataset(n, data=["x"], dtype=h5py.string_dtype())),
        "origin .O .1,.: expected <f8",
    ),
    "never written": (
        replace_with("texts", lambda f, n: f.create_dataset(n, (1 << 40,), "u1")), "texts claims more",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", EDITS)
def test_an_index_of_another_kind_is_refused(name: str, copy: Path) -> None:
    change, message = EDITS[name]
    edit(copy / "index.h5", change)
    with pytest.raises(FormatError, match=rf"index\.h5: .*{message}"):
        Archive(copy)
