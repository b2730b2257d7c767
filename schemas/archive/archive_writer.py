"""Writer of an archive's HDF5 files: shards with the records of many voxels, and the index.

A shard is read back by offsets and verified before it gets its final name. The index is written
last. FORMAT.md documents the same; change both together. archive.py reads these files.
"""

import base64
import functools
import os
import zlib
from collections.abc import Iterable
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from ..errors import CorruptError
from ..runtime.interrupts import check_interrupt
from ..runtime.new_file import new_path
from ..runtime.new_hdf5_file import hdf5_file, new_hdf5_file
from .codec import CELL_DTYPE, NODE_DTYPE, Record, voxel_point_dtype
from .index import (
    DATASETS,
    INDEX_NAME,
    VOXEL_DTYPE,
    Header,
    index_columns,
    index_digest,
)
from .voxel import VoxelData
from .zstd_frame import Frame

# Block size for reading back a shard that was just written [bytes].
READ_BYTES = 1 << 20

# An HDF5 file of 463 bytes with one dataset, x, of one int8 in one chunk. It was made with a filter
# class registered as "zstd" through ctypes, because h5py cannot set the name of a filter. Without a
# set name, HDF5 writes the name that a loaded plugin states, or no name, and builds would differ.
_PROPERTIES = (
    rb"c-rgqaB<`1lHy|K;9!7(|4?wA5yCfsinmX3)${jo31U*1u$&<q8CNg~A!~#IE+z(`5o|mRK#H;AFwA@p2C4zY86rtwCjl*B6"
    rb"k%XsVgv%H9E@h>VPF*CfblsPSb?r$=H`}VU}RzfIgk-7!(Yn^W>poJq%bgp6v{9#umDvcnTQfP480743lx@TKLG&yO*Ul"
)


@functools.cache
def _creation_properties() -> h5py.h5p.PropDCID:
    """Return the creation properties of a record's dataset; callers must copy them.

    They are: shuffle, then an optional filter zstd named "zstd", and no stored times.
    """
    image = zlib.decompress(base64.b85decode(_PROPERTIES))
    return h5py.h5d.open(h5py.h5f.open_file_image(image), b"x").get_create_plist()


def _write_frame(group: h5py.Group, name: str, frame: Frame, rows: int, dtype: np.dtype) -> tuple[int, int]:
    """Write one dataset of one chunk from its frame; return the chunk's offset and size [bytes]."""
    properties = _creation_properties().copy()
    properties.set_chunk((rows,))
    space = h5py.h5s.create_simple((rows,))
    kind = h5py.h5t.py_create(dtype, logical=True)
    dataset = h5py.h5d.create(group.id, name.encode(), kind, space, properties)
    dataset.write_direct_chunk((0,), frame)
    chunk = dataset.get_chunk_info(0)
    return chunk.byte_offset, chunk.size


def write_shard(
    path: Path,
    number: int,
    archive_id: bytes,
    voxels: Iterable[tuple[VoxelData, Record, NDArray[np.int64], NDArray[np.int64]]],
    *,
    version: int = 1,
) -> tuple[NDArray, int]:
    """Write one shard; return its index rows (VOXEL_DTYPE) and its `file_checksum`.

    voxels: per voxel its data, its record, and the bounds low, high (3,) of its points [voxel
    steps, inclusive].
    version: of the format, as the index will state it.
    The file is verified by offsets before it is given its name.
    """
    rows = []
    with new_path(path) as temporary:
        with hdf5_file(temporary) as file:
            file.attrs["format"] = np.bytes_("solidcloud shard")
            file.attrs["format_version"] = np.uint32(version)
            file.attrs["archive_id"] = np.frombuffer(archive_id, np.uint8)
            parent = file.create_group("voxels", track_times=False)
            for voxel, record, low, high in voxels:
                dtypes = (CELL_DTYPE, NODE_DTYPE, voxel_point_dtype(voxel))
                group = parent.create_group(f"{voxel.key:016x}", track_times=False)
                counts = (record.cell_rows, record.node_rows, record.point_rows)
                frames = (record.cells, record.nodes, record.points)
                row = np.zeros((), VOXEL_DTYPE)
                row["key"], row["shard"], row["rows"], row["low"], row["high"] = (
                    voxel.key,
                    number,
                    counts,
                    low,
                    high,
                )
                row["leaves"] = record.leaf_rows
                for i, name in enumerate(DATASETS):
                    offset, size = _write_frame(group, name, frames[i], counts[i], dtypes[i])
                    row["frame_offset"][i], row["frame_bytes"][i] = offset, size
                    row["frame_checksum"][i] = int.from_bytes(frames[i][-4:], "little")
                rows.append(row)
                file.check()
        table = np.array(rows, VOXEL_DTYPE)
        checksum = _verify_frames(temporary, table)
    return table, checksum


def file_checksum(path: Path) -> int:
    """Return the CRC-32 of a file's bytes.

    It covers HDF5's own structures, which the checksums of records do not.
    """
    checksum, buffer = 0, memoryview(bytearray(READ_BYTES))
    with open(path, "rb", buffering=0) as file:
        while got := file.readinto(buffer):
            check_interrupt()
            checksum = zlib.crc32(buffer[:got], checksum)
    return checksum


def _verify_frames(path: Path, table: NDArray) -> int:
    """Check the end of every frame of a shard by its offset; return the shard's `file_checksum`.

    A full disk may go unnoticed until here.
    """
    with open(path, "rb") as file:
        for row in table:
            for i, name in enumerate(DATASETS):
                end = int(row["frame_offset"][i]) + int(row["frame_bytes"][i])
                checksum = os.pread(file.fileno(), 4, end - 4)
                if checksum != int(row["frame_checksum"][i]).to_bytes(4, "little"):
                    raise CorruptError(
                        f"{path}: voxel {int(row['key']):#x}, {name}: differs from what was written: is the disk full?"
                    )
    return file_checksum(path)


def write_index(folder: Path, header: Header, voxels: NDArray, shards: list[tuple[str, int]]) -> None:
    """Write index.h5, the last file of an archive, which completes it.

    voxels: VOXEL_DTYPE rows sorted by key.
    shards: name and bytes of each, in the order of their numbers.
    """
    columns = index_columns(header, voxels, shards)
    with new_hdf5_file(folder / INDEX_NAME) as file:
        file.attrs["format"] = np.bytes_("solidcloud")
        file.attrs["format_version"] = np.uint32(header.format_version)
        file.attrs["units"] = np.bytes_("m")
        file.attrs["archive_id"] = np.frombuffer(header.archive_id, np.uint8)
        file.attrs["sha256"] = np.frombuffer(index_digest(header.archive_id, columns), np.uint8)
        for name, column in columns.items():
            file.create_dataset(name, data=column)
