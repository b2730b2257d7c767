"""Test that FORMAT.md's worked example returns every point, and that it names every dataset and field."""

import ast
import re
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
from six_scans import dataset, rows_of
from solidcloud.schemas.archive import index as index_module
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.archive.index import VOXEL_DTYPE, shard_name

FORMAT = Path(index_module.__file__).parents[1] / "FORMAT.md"


def worked_example() -> str:
    """The code block of FORMAT.md, "Every point with numpy"."""
    text = FORMAT.read_text().split("## Every point with numpy")[1]
    found = re.search(r"```python\n(.*?)```", text, re.DOTALL)
    assert found
    return found[1]


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
    assert f"packed, {VOXEL_DTYPE.itemsize} bytes" in text


def test_format_md_reads_and_names_an_archive_with_colours_and_its_level() -> None:
    names: dict[str, Callable] = {}
    exec(compile(worked_example(), str(FORMAT), "exec"), names)
    folder = Path(__file__).resolve().parents[3] / "golden" / "archive-5"
    world, rows = names["read_archive"](folder)
    coloured = np.loadtxt(folder.parent / "scan-3.xyz", skiprows=1)[:, [0, 1, 2, *range(4, 8)]]
    known = {tuple(row) for row in coloured.tolist()} | {(*row, 0, 0, 0, 0) for row in world.tolist()}
    found = np.column_stack([world, rows["rgb"], rows["classification"]])
    assert {(*map(lambda x: round(x, 3), row[:3]), *row[3:]) for row in found.tolist()} <= {
        (*map(lambda x: round(x, 3), row[:3]), *row[3:]) for row in known
    }
    assert np.count_nonzero(found[:, 3:].any(axis=1)) >= 140
    level, representatives = names["read_archive"](folder / "level")
    assert 0 < len(level) < len(world)
    chosen = np.column_stack([level, representatives["rgb"], representatives["classification"]])
    assert {tuple(row) for row in chosen.tolist()} <= {tuple(row) for row in found.tolist()}
    text = FORMAT.read_text()
    for root in (folder, folder / "level"):
        with h5py.File(root / "index.h5") as index, h5py.File(root / "shards" / shard_name(0)) as shard:
            assert index.attrs["format_version"] == shard.attrs["format_version"] == 5
            for name in (*index, *rows.dtype.names):
                assert f"`{name}`" in text, name
