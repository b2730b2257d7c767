"""The archive on disk: FORMAT.md's worked example, and every fault of an index or a shard."""

import ast
import re
import shutil
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import solidcloud.schemas.index as index_module
from scans import WITH_POINTS, make_scan, write_xyz
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.pipeline import build_archive
from solidcloud.builder.radius import voxel_points
from solidcloud.schemas.archive import Archive
from solidcloud.schemas.codec import encode_voxel
from solidcloud.schemas.errors import CorruptError, FormatError
from solidcloud.schemas.index import RadiusNow
from solidcloud.schemas.index_file import write_index
from solidcloud.schemas.radius_model import LOCAL_RADII
from solidcloud.schemas.shard import DATASETS, file_checksum, shard_name, write_shard

FORMAT = Path(index_module.__file__).with_name("FORMAT.md")
# Of version 3, with dead voxels in its shards.
LATER = Path(__file__).resolve().parents[2] / "golden" / "archive-3"
ORIGIN = np.array([512345.678901, 5612345.123456, -7.25])


def dataset() -> list[tuple[np.ndarray, np.ndarray]]:
    """Six scans, georeferenced: points (n, 3) [m], negative heights among them, and intensities (n,)."""
    scans = []
    for seed, kind in enumerate(WITH_POINTS):
        xyz = make_scan(kind, seed, 200) + ORIGIN
        scans.append((xyz, np.random.default_rng(seed).uniform(0, 4096, len(xyz)).astype(np.float32)))
    return scans


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An archive of `dataset` in several voxels of several cells, with both optional columns. Not to be changed."""
    folder = tmp_path_factory.mktemp("built")
    files = [write_xyz(folder / f"{i}.xyz", *scan) for i, scan in enumerate(dataset())]
    config = BuildConfig(
        voxel=0.9, cell_points=60, leaf=16, degree=4, keep=frozenset({"scan", "intensity"}), jobs=1
    )
    build_archive(files, folder / "archive", config)
    return folder / "archive"


@pytest.fixture
def copy(built: Path, tmp_path: Path) -> Path:
    """A copy of `built` to be broken."""
    return Path(shutil.copytree(built, tmp_path / "archive"))


def worked_example() -> str:
    """The code block of FORMAT.md, "Every point with numpy"."""
    text = FORMAT.read_text().split("## Every point with numpy")[1]
    found = re.search(r"```python\n(.*?)```", text, re.DOTALL)
    assert found
    return found[1]


def rows_of(xyz: np.ndarray, *columns: np.ndarray) -> np.ndarray:
    """Rows (n, 3 + c) float64 in an order of their own."""
    rows = np.column_stack([xyz, *columns])
    return rows[np.lexsort(rows.T)]


def test_format_md_imports_h5py_hdf5plugin_and_numpy_alone() -> None:
    nodes = [n for n in ast.walk(ast.parse(worked_example())) if isinstance(n, ast.Import | ast.ImportFrom)]
    names = {n.module for n in nodes if isinstance(n, ast.ImportFrom)}
    names |= {alias.name for n in nodes if isinstance(n, ast.Import) for alias in n.names}
    assert names == {"h5py", "hdf5plugin", "numpy", "pathlib"}


def test_format_md_gives_every_point_back(built: Path) -> None:
    names: dict[str, Callable] = {}
    exec(compile(worked_example(), str(FORMAT), "exec"), names)
    world, rows = names["read_archive"](built)
    with Archive(built) as archive:
        header = archive.header
    assert len(archive.voxels) > 8
    # The source scan by the file's name: scans are numbered by their content.
    number = {Path(s.path).stem: i for i, s in enumerate(header.sources)}
    source = np.concatenate([xyz for xyz, _ in dataset()])
    scan = np.concatenate([np.full(len(xyz), number[str(i)]) for i, (xyz, _) in enumerate(dataset())])
    intensity = np.concatenate([column for _, column in dataset()])
    assert np.array(header.lattice.origin).tobytes() == source.min(axis=0).tobytes()
    quantised = np.rint((source - source.min(axis=0)) / header.lattice.step) * header.lattice.step
    expected = rows_of(quantised + source.min(axis=0), scan, intensity)
    assert np.array_equal(rows_of(world, rows["scan_index"], rows["intensity"]), expected)
    assert header.moved_max <= header.lattice.step * 0.501
    assert np.abs(quantised + source.min(axis=0) - source).max() == header.moved_max


def test_format_md_reads_an_archive_without_columns(tmp_path: Path) -> None:
    xyz = make_scan("corner", 4, 300) - 1.0
    write_xyz(tmp_path / "a.xyz", xyz)
    build_archive([tmp_path / "a.xyz"], tmp_path / "a", BuildConfig(voxel=8.0, jobs=1, resolution=0.001))
    names: dict[str, Callable] = {}
    exec(compile(worked_example(), str(FORMAT), "exec"), names)
    world, rows = names["read_archive"](tmp_path / "a")
    assert rows.dtype.names == ("xyz",)
    quantised = np.rint((xyz - xyz.min(axis=0)) / 0.001) * 0.001 + xyz.min(axis=0)
    assert np.array_equal(rows_of(world), rows_of(quantised))


def test_format_md_names_every_dataset_and_field(built: Path) -> None:
    text = FORMAT.read_text()
    with h5py.File(built / "index.h5") as index:
        names = [*index, *index.attrs, *index["voxels"].dtype.names, *index["shards"].dtype.names]
    with h5py.File(built / "shards" / shard_name(0)) as shard:
        voxel = next(iter(shard["voxels"].values()))
        names += [*shard, *shard.attrs, *voxel, *(f for name in voxel for f in voxel[name].dtype.names)]
        sizes = [voxel[name].dtype.itemsize for name in ("cells", "nodes")]
    for name in names:
        assert f"`{name}`" in text, name
    assert f"c >= 1 rows of {sizes[0]} bytes" in text
    assert f"n >= 1 rows of {sizes[1]} bytes" in text
    assert f"packed, {index_module.VOXEL_DTYPE.itemsize} bytes" in text


def test_format_md_reads_and_names_an_archive_with_radius_classes(tmp_path: Path) -> None:
    xyz = make_scan("corner", 4, 300) - 1.0
    write_xyz(tmp_path / "a.xyz", xyz)
    models = frozenset({"mean", "local", "border"})
    build_archive([tmp_path / "a.xyz"], tmp_path / "a", BuildConfig(voxel=0.8, jobs=1, models=models))
    names: dict[str, Callable] = {}
    exec(compile(worked_example(), str(FORMAT), "exec"), names)
    world, rows = names["read_archive"](tmp_path / "a")
    assert rows.dtype.names == ("xyz", "radius_class")
    quantised = np.rint((xyz - xyz.min(axis=0)) / 1e-4) * 1e-4 + xyz.min(axis=0)
    assert np.array_equal(rows_of(world), rows_of(quantised))
    text = FORMAT.read_text()
    with (
        h5py.File(tmp_path / "a" / "index.h5") as index,
        h5py.File(tmp_path / "a/shards" / shard_name(0)) as shard,
    ):
        assert index.attrs["format_version"] == shard.attrs["format_version"] == 2
        assert np.array_equal(np.bincount(rows["radius_class"], minlength=32), index["radius_counts"])
        assert index["columns"][:].tolist() == [0, 0, 1, 1]
        for name in (*index, *rows.dtype.names):
            assert f"`{name}`" in text, name
    for radius in LOCAL_RADII:
        assert re.search(rf"\b{radius}\b", text), radius


def test_format_md_reads_and_names_an_archive_of_several_generations() -> None:
    names: dict[str, Callable] = {}
    exec(compile(worked_example(), str(FORMAT), "exec"), names)
    world, rows = names["read_archive"](LATER)
    with Archive(LATER) as archive:
        header = archive.header
        expected = [
            voxel_points(*archive.read_voxel(row)) + archive.coordinates[row] * header.lattice.voxel_steps
            for row in range(len(archive.voxels))
        ]
        in_shards = 0
        for number in range(archive.shard_count()):
            with h5py.File(archive.shard_path(number)) as shard:
                in_shards += len(shard["voxels"])
                assert shard.attrs["format_version"] == 2
        assert in_shards > len(archive.voxels), "some are dead"
    assert np.array_equal(rows_of(world), rows_of(header.lattice.to_world(np.concatenate(expected))))
    # Of the scan that was removed there is none.
    assert sorted(np.unique(rows["scan_index"]).tolist()) == [
        i for i, s in enumerate(header.sources) if s.count
    ]
    text = FORMAT.read_text()
    with h5py.File(LATER / "index.h5") as index:
        assert index.attrs["format_version"] == 3
        for name in index:
            assert f"`{name}`" in text, name


def test_hdf5_says_what_a_shard_is(built: Path) -> None:
    with h5py.File(built / "shards" / shard_name(0)) as shard, Archive(built) as archive:
        assert shard.attrs["format"] == b"solidcloud shard"
        assert int(shard.attrs["format_version"]) == 1
        assert shard.attrs["archive_id"].tobytes() == archive.header.archive_id
        assert list(shard["voxels"]) == [f"{key:016x}" for key in archive.voxels["key"]]
        for voxel in shard["voxels"].values():
            for name in DATASETS:
                assert voxel[name].chunks == voxel[name].shape
                assert voxel[name].shuffle
                properties = voxel[name].id.get_create_plist()
                assert [properties.get_filter(i)[0] for i in range(properties.get_nfilters())] == [2, 32015]
                # A name of its own: a nameless filter would be written under the name of a plugin, if one is loaded.
                assert properties.get_filter(1)[1:] == (h5py.h5z.FLAG_OPTIONAL, (3,), b"zstd")


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


# --- broken indices ---------------------------------------------------------------------------------------


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
    "other version": (set_attribute("format_version", np.uint32(4)), "format version 4, this software reads 1, 2, 3"),
    "other format": (set_attribute("format", np.bytes_("solidcloud shard")), "not a solidcloud index"),
    "other units": (set_attribute("units", np.bytes_("ft")), "units 'ft', expected 'm'"),
    "text of variable length": (set_attribute("format", "solidcloud"), "not a solidcloud index"),
    "other id": (set_attribute("archive_id", np.zeros(16, "u1")), "checksum differs"),
    "other number": (lambda f: f["origin"].__setitem__(0, 1.0), "checksum differs"),
    "dataset gone": (lambda f: f.__delitem__("origin"), "checksum differs"),
    "dataset more": (lambda f: f.__setitem__("zzz", [1]), "checksum differs"),
    "checksum gone": (lambda f: f.attrs.__delitem__("sha256"), "not a readable archive index"),
    "external link": (
        replace_with("origin", lambda f, n: f.__setitem__(n, h5py.ExternalLink("other.h5", "/x"))),
        "origin is no plain dataset",
    ),
    "soft link": (replace_with("origin", lambda f, n: f.__setitem__(n, h5py.SoftLink("/step"))), "origin is no"),
    "virtual dataset": (replace_with("origin", virtual), "origin is no plain dataset"),
    "external storage": (
        replace_with(
            "origin", lambda f, n: f.create_dataset(n, (3,), "<f8", external=[("/etc/hostname", 0, 24)])
        ),
        "origin is no plain dataset",
    ),
    "group": (replace_with("origin", lambda f, n: f.create_group(n)), "origin is no plain dataset"),
    "chunked": (
        replace_with("origin", lambda f, n: f.create_dataset(n, (1 << 30,), "<f8", chunks=(8,))), "origin is no",
    ),
    "text": (
        replace_with("origin", lambda f, n: f.create_dataset(n, data=["x"], dtype=h5py.string_dtype())),
        "origin claims more",
    ),
    "never written": (
        replace_with("origin", lambda f, n: f.create_dataset(n, (1 << 40,), "<f8")), "origin claims more",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", EDITS)
def test_an_index_of_another_kind_is_refused(name: str, copy: Path) -> None:
    change, message = EDITS[name]
    edit(copy / "index.h5", change)
    with pytest.raises(FormatError, match=rf"index\.h5: .*{message}"):
        Archive(copy)


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


# --- broken shards ----------------------------------------------------------------------------------------


def test_a_missing_shard_is_refused(copy: Path) -> None:
    (copy / "shards" / shard_name(0)).unlink()
    with pytest.raises(FormatError, match=r"0-000000\.h5: missing"):
        Archive(copy)


@pytest.mark.parametrize("delta", [-1, 1])
def test_a_shard_of_another_length_is_refused(delta: int, copy: Path) -> None:
    path = copy / "shards" / shard_name(0)
    data = path.read_bytes()
    path.write_bytes(data[:-1] if delta < 0 else data + b"\0")
    with pytest.raises(FormatError, match=rf"{len(data) + delta} bytes, expected {len(data)}"):
        Archive(copy)


def rewrite_index(folder: Path, change: Callable[[np.ndarray], None]) -> None:
    """Write an index with a valid checksum over changed rows."""
    with Archive(folder) as archive:
        header, voxels = archive.header, archive.voxels.copy()
        shards = [(p.name, p.stat().st_size) for p in map(archive.shard_path, range(archive.shard_count()))]
    change(voxels)
    write_index(folder, header, voxels, shards)


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
    with pytest.raises(FormatError, match="generation 1, radius_now"):
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
    with pytest.raises(FormatError, match="does not add up"):
        Archive(copy)


def test_an_index_that_names_a_voxel_twice_is_refused(copy: Path) -> None:
    rewrite_index(copy, lambda rows: rows["key"].__setitem__(1, rows["key"][0]))
    with pytest.raises(FormatError, match="does not add up"):
        Archive(copy)


def test_a_shard_name_that_leads_elsewhere_is_refused(copy: Path) -> None:
    with Archive(copy) as archive:
        write_index(copy, archive.header, archive.voxels, [("../../secret.h5", 10)])
    with pytest.raises(FormatError, match="shard name"):
        Archive(copy)


@pytest.mark.parametrize("field", DATASETS)
def test_a_wrong_offset_cannot_deliver_another_frame(field: str, copy: Path) -> None:
    k = DATASETS.index(field)

    def swap(rows: np.ndarray) -> None:
        for name in ("frame_offset", "frame_bytes"):
            rows[name][[0, 1], k] = rows[name][[1, 0], k]

    rewrite_index(copy, swap)
    with Archive(copy) as archive, pytest.raises(CorruptError, match=rf"0-000000\.h5: voxel .*, {field}: "):
        archive.read_voxel(0)


def test_a_whole_record_in_anothers_place_is_refused(copy: Path) -> None:
    def swap(rows: np.ndarray) -> None:
        for name in ("frame_offset", "frame_bytes", "frame_checksum", "rows", "leaves", "low", "high"):
            rows[name][[0, 1]] = rows[name][[1, 0]]

    rewrite_index(copy, swap)
    with Archive(copy) as archive, pytest.raises(CorruptError, match="another voxel's or another archive's"):
        archive.read_voxel(0)


def test_another_archives_record_is_refused(copy: Path) -> None:
    with Archive(copy) as archive:
        voxels = [archive.read_voxel(row)[0] for row in range(len(archive.voxels))]
        header, rows = archive.header, archive.voxels
    bounds = zip(rows["low"].astype(np.int64), rows["high"].astype(np.int64), strict=True)
    records = [(v, encode_voxel(v, bytes(16)), *b) for v, b in zip(voxels, bounds, strict=True)]
    path = copy / "shards" / shard_name(0)
    table, checksum = write_shard(path, 0, bytes(16), records)
    assert checksum == file_checksum(path) == zlib.crc32(path.read_bytes())
    write_index(copy, header, table, [(path.name, path.stat().st_size)])
    with Archive(copy) as archive, pytest.raises(CorruptError, match="another archive's"):
        archive.read_voxel(0)


def test_a_flipped_byte_in_a_record_is_refused_and_says_where(copy: Path) -> None:
    with Archive(copy) as archive:
        entry = archive.voxels[2]
        path = archive.shard_path(0)
    data = bytearray(path.read_bytes())
    data[int(entry["frame_offset"][2]) + int(entry["frame_bytes"][2]) // 2] ^= 0x55
    path.write_bytes(data)
    with Archive(copy) as archive:
        where = re.escape(archive.where(2))
        with pytest.raises(CorruptError, match=rf"^{where}: voxel 0x[0-9a-f]+, points: .*restore the shard"):
            archive.read_voxel(2)
        archive.read_voxel(1)


def test_a_shard_truncated_while_open_is_an_error(copy: Path) -> None:
    with Archive(copy) as archive:
        archive.read_voxel(0)
        path = archive.shard_path(0)
        with open(path, "r+b") as file:
            file.truncate(1000)
        with pytest.raises(CorruptError, match="bytes that are not the record's"):
            archive.read_voxel(len(archive.voxels) - 1)


def test_a_failed_shard_leaves_no_file(tmp_path: Path, built: Path) -> None:
    with Archive(built) as archive:
        voxel, _ = archive.read_voxel(0)

    def voxels() -> object:
        yield voxel, encode_voxel(voxel, bytes(16)), np.zeros(3, np.int64), np.zeros(3, np.int64)
        raise OSError("disk on fire")

    with pytest.raises(OSError, match="disk on fire"):
        write_shard(tmp_path / shard_name(0), 0, bytes(16), voxels())
    assert not list(tmp_path.iterdir())


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
    with pytest.raises(FormatError, match="does not add up"):
        Archive(copy)


def test_bounds_of_voxels_that_are_not_the_scenes_are_refused(copy: Path) -> None:
    def widen(rows: np.ndarray) -> None:
        rows["high"] += 1000

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
