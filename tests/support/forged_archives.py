"""Forged archives with correct checksums: changed fields and rows, compression bombs."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import h5py
import numpy as np
import zstandard
from numpy.typing import NDArray
from solidcloud.schemas.archive.codec import CELL_DTYPE, NODE_DTYPE, point_dtype
from solidcloud.schemas.archive.index import index_digest
from solidcloud.schemas.archive.zstd_frame import pack

Columns = dict[str, NDArray]


class RawIndex(NamedTuple):
    """The content of an index, unchecked."""

    version: int
    archive_id: bytes
    columns: Columns


def read_index(folder: Path) -> RawIndex:
    """Read an index without the checks of a reader."""
    with h5py.File(folder / "index.h5") as file:
        columns = {name: file[name][()] for name in file}
        return RawIndex(int(file.attrs["format_version"]), file.attrs["archive_id"].tobytes(), columns)


def write_index(folder: Path, index: RawIndex) -> None:
    """Write an index of any content, with a correct checksum."""
    (folder / "index.h5").unlink(missing_ok=True)
    with h5py.File(folder / "index.h5", "w", libver=("v110", "v110")) as file:
        file.attrs["format"] = np.bytes_("solidcloud")
        file.attrs["format_version"] = np.uint32(index.version)
        file.attrs["units"] = np.bytes_("m")
        file.attrs["archive_id"] = np.frombuffer(index.archive_id, np.uint8)
        file.attrs["sha256"] = np.frombuffer(index_digest(index.archive_id, index.columns), np.uint8)
        for name, column in index.columns.items():
            file.create_dataset(name, data=column)


def forge(folder: Path, change: Callable[[Columns], None]) -> None:
    """Change the datasets of an index in place."""
    index = read_index(folder)
    change(index.columns)
    write_index(folder, index)


def row_types(columns: Columns) -> tuple[np.dtype, np.dtype, np.dtype]:
    """Return the row types of the cells, nodes and points of an archive."""
    scan, intensity, local, border, _, rgb, classes = np.pad(columns["columns"], (0, 7))[:7].tolist()
    points = point_dtype(
        scan_index=bool(scan),
        intensity=bool(intensity),
        radius_class="level" in columns or bool(local or border),
        rgb=bool(rgb),
        classification=bool(classes),
    )
    return CELL_DTYPE, NODE_DTYPE, points


def read_rows(folder: Path, columns: Columns, voxel: int, i: int) -> NDArray:
    """Return the rows of dataset i of a voxel."""
    plain = zstandard.decompress(_frame(folder, columns, voxel, i))
    dtype = row_types(columns)[i]
    planes = np.frombuffer(plain, np.uint8).reshape(dtype.itemsize, -1)
    return planes.T.copy().view(dtype)[:, 0]


def _frame(folder: Path, columns: Columns, voxel: int, i: int) -> bytes:
    entry = columns["voxels"][voxel]
    data = (folder / "shards" / columns["shards"]["name"][entry["shard"]].decode()).read_bytes()
    begin = int(entry["frame_offset"][i])
    return data[begin : begin + int(entry["frame_bytes"][i])]


def put_frame(folder: Path, columns: Columns, voxel: int, i: int, frame: bytes) -> None:
    """Append another frame to its shard, and let the index refer to it."""
    entry, shards = columns["voxels"][voxel], columns["shards"]
    number = int(entry["shard"])
    with open(folder / "shards" / shards["name"][number].decode(), "ab") as file:
        entry["frame_offset"][i] = file.tell()
        file.write(frame)
        shards["bytes"][number] = file.tell()
    entry["frame_bytes"][i] = len(frame)
    entry["frame_checksum"][i] = int.from_bytes(frame[-4:], "little")


def put_rows(folder: Path, columns: Columns, voxel: int, i: int, rows: NDArray) -> None:
    """Replace the rows of dataset i of a voxel."""
    put_frame(folder, columns, voxel, i, pack(np.ascontiguousarray(rows)))


def bomb(size: int) -> bytes:
    """Return a frame with a checksum that is as short as a frame of `size` zeros can be, 32,768 to 1."""
    compressor = zstandard.ZstdCompressor(level=19, write_checksum=True).compressobj(size=size)
    zeros, parts = bytes(1 << 20), []
    for begin in range(0, size, len(zeros)):
        parts.append(compressor.compress(zeros[: size - begin]))
    return b"".join([*parts, compressor.flush()])
