"""Test shards: what HDF5 reads from one, and every fault of their bytes."""

import re
import zlib
from pathlib import Path

import h5py
import numpy as np
import pytest
from six_scans import rewrite_index
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.archive.archive_writer import file_checksum, write_index, write_shard
from solidcloud.schemas.archive.codec import encode_voxel
from solidcloud.schemas.archive.index import DATASETS, shard_name
from solidcloud.schemas.errors import CorruptError, FormatError


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
    with Archive(copy) as archive, pytest.raises(CorruptError, match="belongs to another voxel or archive"):
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
    with Archive(copy) as archive, pytest.raises(CorruptError, match="another voxel or archive"):
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
        with pytest.raises(CorruptError, match="bytes that do not match the index"):
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
