"""Reader of archives: folders with `index.h5` and `shards/`. archive_writer.py writes them.

FORMAT.md documents the same; change both together. HDF5 reads the index. Records are read by
offsets, so that neither HDF5's lock nor its parser stands between a server and a record.
"""

import contextlib
import math
import os
import stat
from collections.abc import Collection, Iterator
from pathlib import Path

import h5py
import numpy as np
from h5py import h5a, h5d, h5l, h5o, h5s
from numpy.typing import NDArray

from ..errors import CorruptError, FormatError
from ..runtime.interrupts import check_interrupt
from .codec import (
    OPTIONAL_COLUMNS,
    DecompressedRecord,
    DecompressedTree,
    RecordShape,
    decompress_record,
    decompress_tree,
)
from .index import (
    DATASETS,
    FORMAT_VERSIONS,
    INDEX_NAME,
    SHARD_FOLDER,
    SHARD_NAME,
    index_digest,
    read_header,
)
from .index_limits import check_columns, check_layout, check_voxels
from .voxel import Links, VoxelData
from .voxel_grid import voxel_coordinates

# Limits of the members of the index's root and of a text attribute's bytes: more than any version
# has.
_MAX_MEMBERS, _MAX_NAME = 64, 64


class Archive:
    """Archive opened for reading. Several threads may share it; it is a context manager.

    header: see Header.  voxels: the index's rows, sorted by key.
    coordinates: (v, 3) int64, voxel coordinates.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        """Open the archive in `folder`.

        Raises FormatError or CorruptError naming the file and the fault.
        """
        self.folder = Path(folder)
        self._descriptors: list[int] = []
        while True:
            index = self._index_identity()
            try:
                self._open()
                return
            except FormatError:
                # `add` and `remove` replace the index and then delete the shards that it no longer
                # names. If the index was replaced meanwhile, try again.
                if self._index_identity() == index:
                    raise

    def _index_identity(self) -> tuple[int, int] | None:
        """Return the identity and write time of the index file; None if there is none."""
        with contextlib.suppress(OSError):
            found = (self.folder / INDEX_NAME).stat()
            return found.st_ino, found.st_mtime_ns
        return None

    def _open(self) -> None:
        """Read the index and open the shards that it names."""
        path = self.folder / INDEX_NAME
        if not path.is_file():
            raise FormatError(
                f"{self.folder}: no archive here ({INDEX_NAME} not found): build one with `solidcloud build`"
            )
        try:
            archive_id, columns = read_index(path)
            self.header = read_header(archive_id, columns)
            self.voxels = columns["voxels"]
            self._shape_dtype = self.header.point_dtype
            self._shards = [
                (bytes(name).decode("ascii", "replace"), int(size)) for name, size in columns["shards"]
            ]
            self._check_shards()
            check_voxels(columns, self._shape_dtype.itemsize)
        except (OSError, KeyError, ValueError, TypeError, AttributeError, RuntimeError) as error:
            raise FormatError(
                f"{path}: not a readable archive index ({error}): restore or rebuild it"
            ) from error
        self.coordinates = voxel_coordinates(self.voxels["key"])
        counts = self.header.radius_counts
        self._classes = (
            sum(1 << c for c in np.flatnonzero(counts).tolist()) if self.header.radius_class else None
        )
        # Open all shards now: if the archive is replaced later, this reader keeps the generation it
        # opened.
        try:
            for number in range(len(self._shards)):
                self._descriptors.append(os.open(self.shard_path(number), os.O_RDONLY | os.O_CLOEXEC))
        except OSError as error:
            self.close()
            raise FormatError(f"{error.filename}: cannot be opened ({error.strerror}): check it") from error

    def _check_shards(self) -> None:
        """Check that every shard exists under a valid name with the length that the index states.

        Raises FormatError.
        """
        if len({name for name, _ in self._shards}) < len(self._shards):
            raise FormatError(f"{self.folder}: the index names a shard twice: restore or rebuild it")
        for name, size in self._shards:
            path = self.folder / SHARD_FOLDER / name
            if not SHARD_NAME.fullmatch(name):
                raise FormatError(
                    f"{self.folder}: shard name {name!r} in the index: not written by solidcloud"
                )
            try:
                held = path.stat()
            except OSError:
                held = None
            if held is None or not stat.S_ISREG(held.st_mode):
                raise FormatError(f"{path}: missing: restore it or rebuild the archive")
            if held.st_size != size:
                raise FormatError(
                    f"{path}: {held.st_size} bytes, expected {size}: truncated? restore or rebuild it"
                )

    def __enter__(self) -> "Archive":
        """Return the archive."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the shards."""
        self.close()

    def close(self) -> None:
        """Close the shards. Nothing can be read afterwards."""
        while self._descriptors:
            os.close(self._descriptors.pop())

    def shard_path(self, number: int) -> Path:
        """Return the path of shard `number`."""
        return self.folder / SHARD_FOLDER / self._shards[number][0]

    def shards(self) -> list[tuple[str, int]]:
        """Return the name and bytes of each shard file, in the order of their numbers."""
        return list(self._shards)

    def shard_count(self) -> int:
        """Return the number of shard files."""
        return len(self._shards)

    def read_frames(self, row: int) -> tuple[bytes, bytes, bytes]:
        """Read the three frames (cells, nodes, points) of the voxel in index row `row`.

        Raises CorruptError, naming file, voxel and dataset, if a frame is not the one in the index.
        """
        return self._read_frame(row, 0), self._read_frame(row, 1), self._read_frame(row, 2)

    def _read_frame(self, row: int, i: int) -> bytes:
        """Read the frame of dataset `i` of a voxel, as `read_frames` does."""
        if not self._descriptors:
            raise ValueError(f"{self.folder}: the archive is closed")
        check_interrupt()
        entry = self.voxels[row]
        size, offset = int(entry["frame_bytes"][i]), int(entry["frame_offset"][i])
        frame = os.pread(self._descriptors[int(entry["shard"])], size, offset)
        if len(frame) != size or frame[-4:] != int(entry["frame_checksum"][i]).to_bytes(4, "little"):
            raise CorruptError(
                f"{self.where(row)}, {DATASETS[i]}: {len(frame)} bytes that do not match the index, expected {size}",
                (self.shard_path(int(entry["shard"])),),
            )
        return frame

    def where(self, row: int) -> str:
        """Return the location of the record of index row `row`, for messages."""
        entry = self.voxels[row]
        x, y, z = self.coordinates[row]
        return f"{self.shard_path(int(entry['shard']))}: voxel ({x}, {y}, {z})"

    @contextlib.contextmanager
    def locating(self, row: int) -> Iterator[None]:
        """Add the location of row `row`'s record, and what to do, to a CorruptError of the block."""
        try:
            yield
        except CorruptError as error:
            raise type(error)(
                f"{self.where(row)}: {error}: restore the shard or rebuild the archive",
                (self.shard_path(int(self.voxels["shard"][row])),),
            ) from error

    def open_voxel(self, row: int, columns: Collection[str] = OPTIONAL_COLUMNS) -> DecompressedRecord:
        """Decompress the voxel in index row `row`; its points stay unread.

        columns: optional columns to decompress.
        Raises CorruptError naming the location.
        """
        frames = self.read_frames(row)
        with self.locating(row):
            return decompress_record(
                *frames,
                self._shape(row),
                int(self.voxels["key"][row]),
                self.header.archive_id,
                self.header.lattice.voxel_steps,
                columns,
            )

    def open_tree(self, row: int) -> DecompressedTree:
        """Read the hierarchy of the voxel in index row `row`, without its points.

        Raises CorruptError naming the location.
        """
        with self.locating(row):
            return decompress_tree(
                self._read_frame(row, 0),
                self._read_frame(row, 1),
                self._shape(row),
                int(self.voxels["key"][row]),
                self.header.archive_id,
                self.header.lattice.voxel_steps,
            )

    def _shape(self, row: int) -> RecordShape:
        """Return the shape that the index states for the record of index row `row`."""
        entry = self.voxels[row]
        cells, nodes, points = entry["rows"].tolist()
        bounds = np.stack([entry["low"], entry["high"]])
        return RecordShape(
            cells, nodes, points, self._shape_dtype, int(entry["leaves"]), bounds, self._classes
        )

    def read_voxel(self, row: int) -> tuple[VoxelData, Links]:
        """Read, decompress and check the voxel in index row `row`.

        Raises CorruptError naming the location.
        """
        record = self.open_voxel(row)
        with self.locating(row):
            return record.decode()


# The low-level interface of h5py is used below: it takes a third of the time, and a build of a few points
# opens its archive a dozen times.


def _text_attribute(file: h5py.File, name: str) -> str:
    """Return a text attribute of fixed length, "" if there is none.

    Text of variable length is stored in HDF5's global heap, which has no checksum: with one byte
    flipped there, HDF5 2.0 hung. This software therefore neither writes nor reads it.
    """
    if not h5a.exists(file.id, name.encode()):
        return ""
    attribute = h5a.open(file.id, name.encode())
    dtype = attribute.dtype
    if dtype.kind != "S" or attribute.shape != () or dtype.itemsize > _MAX_NAME:
        return ""
    text = np.empty((), dtype)
    attribute.read(text)
    return bytes(text[()]).decode("ascii", "replace")


def _number_attribute(file: h5py.File, name: str, dtype: str, shape: tuple[int, ...]) -> NDArray:
    """Return a numeric attribute, after checking its type and shape. Raises ValueError."""
    if not h5a.exists(file.id, name.encode()):
        raise ValueError(f"attribute {name} not found")
    attribute = h5a.open(file.id, name.encode())
    if attribute.dtype != np.dtype(dtype) or attribute.shape != shape:
        raise ValueError(
            f"attribute {name} {attribute.dtype.str} {attribute.shape}: expected {dtype} {shape}"
        )
    found = np.empty(shape, dtype)
    attribute.read(found)
    return found


def _open_dataset(file: h5py.File, name: bytes) -> h5d.DatasetID | None:
    """Open a dataset whose bytes are in the file, in one piece; return None for anything else."""
    if file.id.links.get_info(name).type != h5l.TYPE_HARD:
        return None
    found = h5o.open(file.id, name)
    if not isinstance(found, h5d.DatasetID):
        return None
    how = found.get_create_plist()
    plain = how.get_layout() in (h5d.CONTIGUOUS, h5d.COMPACT) and not how.get_external_count()
    return found if plain else None


def read_index(path: Path) -> tuple[bytes, dict[str, NDArray]]:
    """Return the archive id and every dataset of an index, checked with `check_columns`.

    Datasets that link elsewhere, or that claim more bytes than the file has, are refused. Raises
    FormatError or CorruptError naming the file, ValueError for an invalid number, and any error of
    HDF5 for a damaged file.
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
        if len(file) > _MAX_MEMBERS:
            raise FormatError(f"{path}: {len(file)} datasets, expected at most {_MAX_MEMBERS}: do not use it")
        for link in file.id:
            name, dataset = link.decode("utf-8", "replace"), _open_dataset(file, link)
            if dataset is None:
                raise FormatError(
                    f"{path}: {name} is not a plain dataset: not written by solidcloud, do not use it"
                )
            dtype, shape = dataset.dtype, dataset.shape
            check_layout(name, dtype, shape)
            if math.prod(shape) * dtype.itemsize > size:
                raise FormatError(
                    f"{path}: {name} claims more than the file holds: damaged, restore or rebuild it"
                )
            columns[name] = np.empty(shape, dtype)
            if columns[name].size:
                dataset.read(h5s.ALL, h5s.ALL, columns[name])
        archive_id = _number_attribute(file, "archive_id", "|u1", (16,)).tobytes()
        if index_digest(archive_id, columns) != _number_attribute(file, "sha256", "|u1", (32,)).tobytes():
            raise CorruptError(
                f"{path}: checksum differs from the one stored: damaged, restore or rebuild it"
            )
    check_columns(version, columns)
    return archive_id, columns
