"""Reader and writer of `index.h5`: the columns of schemas/archive/index.py as plain HDF5 datasets.

FORMAT.md documents the same; change both together. The index is the last file of an archive to be
written.
"""

from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from ..errors import CorruptError, FormatError
from ..process.new_file import new_file, publish
from .index import Header, index_columns, index_digest
from .index_limits import check_columns, check_layout

# Versions that this software reads. It writes the lowest version that can represent the header
# (schemas/archive/index.py).
FORMAT_VERSIONS = (1, 2, 3, 4)
INDEX_NAME = "index.h5"
# Limits of the members of the root and of a text attribute's bytes: more than any version has.
MOST_MEMBERS, MOST_NAME = 64, 64


def write_index(folder: Path, header: Header, voxels: NDArray, shards: list[tuple[str, int]]) -> None:
    """Write index.h5, the last file of an archive, which completes it.

    voxels: VOXEL_DTYPE rows sorted by key.
    shards: name and bytes of each, in the order of their numbers.
    """
    path = folder / INDEX_NAME
    columns = index_columns(header, voxels, shards)
    with new_file(path) as file:
        file.attrs["format"] = np.bytes_("solidcloud")
        file.attrs["format_version"] = np.uint32(header.format_version)
        file.attrs["units"] = np.bytes_("m")
        file.attrs["archive_id"] = np.frombuffer(header.archive_id, np.uint8)
        file.attrs["sha256"] = np.frombuffer(index_digest(header.archive_id, columns), np.uint8)
        for name, column in columns.items():
            file.create_dataset(name, data=column)
    publish(path)


def _text_attribute(file: h5py.File, name: str) -> str:
    """Return a text attribute of fixed length, "" if there is none.

    Text of variable length is stored in HDF5's global heap, which has no checksum: with one byte
    flipped there, HDF5 2.0 hung. This software therefore neither writes nor reads it.
    """
    if name not in file.attrs:
        return ""
    attribute = file.attrs.get_id(name)
    if attribute.dtype.kind != "S" or attribute.shape != () or attribute.dtype.itemsize > MOST_NAME:
        return ""
    return bytes(file.attrs[name]).decode("ascii", "replace")


def _number_attribute(file: h5py.File, name: str, dtype: str, shape: tuple[int, ...]) -> NDArray:
    """Return a numeric attribute, after checking its type and shape. Raises ValueError."""
    if name not in file.attrs:
        raise ValueError(f"attribute {name} not found")
    attribute = file.attrs.get_id(name)
    if attribute.dtype != np.dtype(dtype) or attribute.shape != shape:
        raise ValueError(
            f"attribute {name} {attribute.dtype.str} {attribute.shape}: expected {dtype} {shape}"
        )
    return np.asarray(file.attrs[name])


def read_columns(path: Path) -> tuple[bytes, dict[str, NDArray]]:
    """Return the archive's id and every dataset of an index, as `check_columns` accepts them.

    No dataset links elsewhere or claims more bytes than the file holds. Raises FormatError or
    CorruptError naming the file, ValueError for an invalid number, and whatever HDF5 raises for a
    damaged file.
    """
    size = path.stat().st_size
    columns: dict[str, NDArray] = {}
    with h5py.File(path, "r") as file:
        if _text_attribute(file, "format") != "solidcloud":
            raise FormatError(
                f"{path}: not a solidcloud index: give the folder that `solidcloud build` wrote"
            )
        version = int(_number_attribute(file, "format_version", "<u4", ()))
        if version not in FORMAT_VERSIONS:
            known = ", ".join(map(str, FORMAT_VERSIONS))
            raise FormatError(
                f"{path}: format version {version}, this software reads {known}: use the one that wrote it"
            )
        units = _text_attribute(file, "units")
        if units != "m":
            raise FormatError(f"{path}: units {units!r}, expected 'm': rebuild the archive")
        if len(file) > MOST_MEMBERS:
            raise FormatError(f"{path}: {len(file)} datasets, expected at most {MOST_MEMBERS}: do not use it")
        for name in file:
            link = file.get(name, getlink=True)
            dataset = file.get(name) if isinstance(link, h5py.HardLink) else None
            if (
                not isinstance(dataset, h5py.Dataset)
                or dataset.external
                or dataset.is_virtual
                or dataset.chunks
            ):
                raise FormatError(
                    f"{path}: {name} is not a plain dataset: not written by solidcloud, do not use it"
                )
            check_layout(name, dataset.dtype, dataset.shape)
            if dataset.size * dataset.dtype.itemsize > size:
                raise FormatError(
                    f"{path}: {name} claims more than the file holds: damaged, restore or rebuild it"
                )
            columns[name] = dataset[()]
        archive_id = _number_attribute(file, "archive_id", "|u1", (16,)).tobytes()
        if index_digest(archive_id, columns) != _number_attribute(file, "sha256", "|u1", (32,)).tobytes():
            raise CorruptError(
                f"{path}: checksum differs from the one stored: damaged, restore or rebuild it"
            )
    check_columns(version, columns)
    return archive_id, columns
