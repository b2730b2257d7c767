"""Test index files that are damaged, truncated, of another kind, or not written by solidcloud."""

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.errors import FormatError


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


def test_no_file_has_a_heap_without_checksum(built: Path) -> None:
    # One flipped byte in a global heap made HDF5 loop for ever; a flip test cannot show that it does not.
    for path in built.rglob("*.h5"):
        assert b"GCOL" not in path.read_bytes()


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
    "other version": (set_attribute("format_version", np.uint32(5)), "format version 5, .* reads 1, 2, 3, 4"),
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
