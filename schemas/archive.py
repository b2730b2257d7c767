"""The archive on disk, writer and reader side by side: a folder with `index.h5` and `shards/`.

The only user of h5py. FORMAT.md says the same in prose; change both together. Written by the recipe that
survived kills at every system call: everything under a temporary name, closed, reopened and verified,
synced, renamed, the folder synced, the index last. Read by offsets, so that no HDF5 lock and no HDF5 parser
stands between a server and a record.
"""

import base64
import contextlib
import functools
import os
import re
import stat
import threading
import zlib
from collections.abc import Callable, Collection, Iterable, Iterator
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from .codec import (
    CELL_DTYPE,
    NODE_DTYPE,
    OPTIONAL_COLUMNS,
    Frame,
    OpenRecord,
    Record,
    RecordShape,
    open_record,
    point_dtype,
    voxel_point_dtype,
)
from .errors import CorruptError, FormatError
from .index import VOXEL_DTYPE, Header, index_columns, index_digest, read_header
from .interrupts import kept_back
from .voxel import Links, VoxelData
from .voxel_grid import voxel_coordinates

# What this software reads, and writes: the first version that holds what is to be said (schemas/index.py Header).
FORMAT_VERSIONS = (1, 2, 3)
INDEX_NAME = "index.h5"
SHARD_FOLDER = "shards"
ZSTD_FILTER = 32015  # registered with the HDF Group
DATASETS = ("cells", "nodes", "points")
# What is read back at a time of a shard just written.
READ_BYTES = 1 << 20

# An HDF5 file of 463 bytes with one dataset, x, of one int8 in one chunk; made with a filter class registered as
# "zstd" through ctypes. h5py leaves no other way to name a filter, and one without a name is written with what its
# plugin calls itself, or with none, as the process happens to have a plugin loaded: two builds would differ.
_PROPERTIES = (
    rb"c-rgqaB<`1lHy|K;9!7(|4?wA5yCfsinmX3)${jo31U*1u$&<q8CNg~A!~#IE+z(`5o|mRK#H;AFwA@p2C4zY86rtwCjl*B6"
    rb"k%XsVgv%H9E@h>VPF*CfblsPSb?r$=H`}VU}RzfIgk-7!(Yn^W>poJq%bgp6v{9#umDvcnTQfP480743lx@TKLG&yO*Ul"
)

# Of this process, or of the one it was forked from: process ids are given on many hosts.
_PROCESS = os.urandom(6).hex()

_SHARD_NAME = re.compile(r"[0-9]{1,9}-[0-9]{1,9}\.h5")


def shard_name(number: int, generation: int = 0) -> str:
    """The file name of a shard inside SHARD_FOLDER."""
    return f"{generation}-{number:06d}.h5"


# --- writing -------------------------------------------------------------------------------------------


def _temporary(path: Path) -> Path:
    """The name that `path` is written under: this thread's own, as a cluster may run one unit in two places at once."""
    return path.with_name(f"{path.name}.{_PROCESS}-{os.getpid()}-{threading.get_ident()}.tmp")


# No piece of HDF5's own structures is longer [bytes]; the longest is a group's list of its links.
_MOST_METADATA = 1 << 20


class _Disk:
    """A file that HDF5 writes, and whose errors it does not hear of: the first is kept in `error`.

    With a full disk HDF5 2.0 crashed as it closed the file (SIGSEGV), or h5py printed what it ignored and went on. So
    a write always succeeds; what comes after one that did not is kept in memory, for HDF5 to read back: its own
    structures, and no record, which it does not read.
    """

    def __init__(self, path: Path) -> None:
        self.error: OSError | None = None
        self._path, self._position, self._end = path, 0, 0
        self._kept: list[tuple[int, bytes]] = []
        self._descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o666)

    def close(self) -> None:
        os.close(self._descriptor)

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        if whence == os.SEEK_END:
            offset += self._end
        elif whence == os.SEEK_CUR:
            offset += self._position
        self._position = offset
        return offset

    def tell(self) -> int:
        return self._position

    def write(self, data: memoryview) -> int:
        data = memoryview(data).cast("B")
        if self.error is None:
            done = 0
            try:
                while done < len(data):
                    done += os.pwrite(self._descriptor, data[done:], self._position + done)
            except OSError as error:
                self.error = OSError(error.errno, error.strerror, str(self._path))
        if self.error is not None and len(data) <= _MOST_METADATA:
            self._kept.append((self._position, bytes(data)))
        self._position += len(data)
        self._end = max(self._end, self._position)
        return len(data)

    def read(self, size: int = -1) -> bytes:
        raise NotImplementedError  # h5py asks whether it is there, and uses `readinto`

    def readinto(self, buffer: memoryview) -> int:
        view = memoryview(buffer).cast("B")
        found = os.pread(self._descriptor, len(view), self._position)
        view[:] = found + bytes(len(view) - len(found))
        for at, data in self._kept:
            low, high = max(at, self._position), min(at + len(data), self._position + len(view))
            if low < high:
                view[low - self._position : high - self._position] = data[low - at : high - at]
        self._position += len(view)
        return len(view)

    def truncate(self, size: int) -> int:
        try:
            os.ftruncate(self._descriptor, size)
        except OSError as error:
            self.error = self.error or OSError(error.errno, error.strerror, str(self._path))
        self._end = size
        return size

    def flush(self) -> None:
        pass


class NewFile(h5py.File):  # type: ignore[misc]
    """An HDF5 file being written."""

    def __init__(self, disk: _Disk, deliver: Callable[[], None]) -> None:
        """Write to `disk`. deliver: hands on an interrupt that was kept back."""
        self._disk, self._deliver = disk, deliver
        # Metadata of format 1.10 and later is checksummed; in older ones 5 of 1,600 flips were silently wrong.
        super().__init__(disk, "w", libver=("v110", "v110"))

    def check(self) -> None:
        """Raise the OSError of a write that failed, or an interrupt: to be asked now and then in long writing."""
        self._deliver()
        if self._disk.error is not None:
            raise self._disk.error


@contextlib.contextmanager
def new_file(path: Path) -> Iterator[NewFile]:
    """An HDF5 file under a temporary name. Given its own only once it is closed and synced.

    A write that fails is an OSError that names the file; nothing is left then. Interrupts wait until the file is
    closed, or for `check`.
    """
    temporary = _temporary(path)
    with kept_back() as deliver, contextlib.ExitStack() as stack:
        disk = _Disk(temporary)
        stack.callback(disk.close)
        try:
            with NewFile(disk, deliver) as file:
                yield file
            deliver()
            if disk.error is not None:
                raise disk.error
        except BaseException as error:
            temporary.unlink(missing_ok=True)
            if disk.error is not None and isinstance(error, Exception):
                raise disk.error from None
            raise


def publish(path: Path) -> None:
    """Sync the temporary file of `path`, rename it, sync its folder."""
    temporary = _temporary(path)
    with open(temporary, "rb") as file:
        os.fsync(file.fileno())
    os.replace(temporary, path)
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Make a rename inside this folder survive a power cut."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@functools.cache
def _creation_properties() -> h5py.h5p.PropDCID:
    """How a record's dataset is made: shuffle, then zstd named "zstd" and optional, no times kept. To be copied."""
    image = zlib.decompress(base64.b85decode(_PROPERTIES))
    return h5py.h5d.open(h5py.h5f.open_file_image(image), b"x").get_create_plist()


def _write_frame(group: h5py.Group, name: str, frame: Frame, rows: int, dtype: np.dtype) -> tuple[int, int]:
    """Write one dataset of one chunk from its frame; returns the chunk's offset and size in the file."""
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
    """Write one shard; returns its rows of the index, VOXEL_DTYPE, and the `file_checksum` of the whole file.

    voxels: per voxel its data, record, and the bounds low, high (3,) of its points [voxel steps, inclusive].
    version: of the format, as the index will say it. The file is verified by offsets before it is given its name.
    """
    rows = []
    with new_file(path) as file:
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
    temporary = _temporary(path)
    try:
        checksum = _verify_frames(temporary, table)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    publish(path)
    return table, checksum


def file_checksum(path: Path) -> int:
    """The CRC-32 of a file's bytes, HDF5's structures among them, of which a record's checksum says nothing."""
    checksum, buffer = 0, memoryview(bytearray(READ_BYTES))
    with open(path, "rb", buffering=0) as file:
        while got := file.readinto(buffer):
            checksum = zlib.crc32(buffer[:got], checksum)
    return checksum


def _verify_frames(path: Path, table: NDArray) -> int:
    """Check the end of every frame of a shard by its offset, a full disk can lie until here; its `file_checksum`."""
    with open(path, "rb") as file:
        for row in table:
            for i, name in enumerate(DATASETS):
                end = int(row["frame_offset"][i]) + int(row["frame_bytes"][i])
                checksum = os.pread(file.fileno(), 4, end - 4)
                if checksum != int(row["frame_checksum"][i]).to_bytes(4, "little"):
                    raise CorruptError(
                        f"{path}: voxel {int(row['key']):#x}, {name}: not what was written: disk full?"
                    )
    return file_checksum(path)


def write_index(folder: Path, header: Header, voxels: NDArray, shards: list[tuple[str, int]]) -> None:
    """Write index.h5, the last file of an archive: with it the archive is whole.

    voxels: VOXEL_DTYPE rows sorted by key.  shards: name and bytes of each, in the order of their numbers.
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


# --- reading -------------------------------------------------------------------------------------------


def _text_attribute(file: h5py.File, name: str) -> str:
    """A text attribute of fixed length, "" where there is none.

    Text of variable length lies in HDF5's global heap, which has no checksum: with one byte flipped there, HDF5
    2.0 never came back. So it is neither written nor read.
    """
    if name not in file.attrs or file.attrs.get_id(name).dtype.kind != "S":
        return ""
    return bytes(file.attrs[name]).decode("ascii", "replace")


def _read_columns(path: Path) -> tuple[bytes, dict[str, NDArray]]:
    """Every dataset of an index, after checking that none leads elsewhere or claims more than the file holds."""
    size = path.stat().st_size
    with h5py.File(path, "r") as file:
        if _text_attribute(file, "format") != "solidcloud":
            raise FormatError(
                f"{path}: not a solidcloud index: give the folder that `solidcloud build` wrote"
            )
        version = int(file.attrs["format_version"])
        if version not in FORMAT_VERSIONS:
            known = ", ".join(map(str, FORMAT_VERSIONS))
            raise FormatError(
                f"{path}: format version {version}, this software reads {known}: use the one that wrote it"
            )
        units = _text_attribute(file, "units")
        if units != "m":
            raise FormatError(f"{path}: units {units!r}, expected 'm': rebuild the archive")
        columns = {}
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
                    f"{path}: {name} is no plain dataset: not written by solidcloud, do not use it"
                )
            if dataset.dtype.hasobject or dataset.size * dataset.dtype.itemsize > size:
                raise FormatError(
                    f"{path}: {name} claims more than the file holds: damaged, restore or rebuild it"
                )
            columns[name] = dataset[()]
        archive_id = file.attrs["archive_id"].tobytes()
        if index_digest(archive_id, columns) != file.attrs["sha256"].tobytes():
            raise CorruptError(
                f"{path}: checksum differs from the one stored: damaged, restore or rebuild it"
            )
    return archive_id, columns


class Archive:
    """An archive opened for reading. Safe to use from several threads; a context manager.

    header: see Header.  voxels: the index's rows, sorted by key.  coordinates: (v, 3) int64, voxel coordinates.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        """Open the archive in `folder`. Raises FormatError or CorruptError naming the file and the fault."""
        self.folder = Path(folder)
        self._descriptors: list[int] = []
        while True:
            index = self._index_file()
            try:
                self._open()
                return
            except FormatError:
                # Whoever adds scans replaces the index and then deletes the shards that it no longer names.
                if self._index_file() == index:
                    raise

    def _index_file(self) -> tuple[int, int] | None:
        """Which file the index is, and when it was written; None where there is none."""
        with contextlib.suppress(OSError):
            found = (self.folder / INDEX_NAME).stat()
            return found.st_ino, found.st_mtime_ns
        return None

    def _open(self) -> None:
        """Read the index and open the shards it names."""
        path = self.folder / INDEX_NAME
        if not path.is_file():
            raise FormatError(
                f"{self.folder}: no archive here ({INDEX_NAME} not found): build one with `solidcloud build`"
            )
        try:
            archive_id, columns = _read_columns(path)
            self.header = read_header(archive_id, columns)
            self.voxels = columns["voxels"].astype(VOXEL_DTYPE)
            self._shards = [
                (bytes(name).decode("ascii", "replace"), int(size)) for name, size in columns["shards"]
            ]
        except (OSError, KeyError, ValueError, TypeError, AttributeError, RuntimeError) as error:
            raise FormatError(
                f"{path}: not a readable archive index ({error}): restore or rebuild it"
            ) from error
        self.coordinates = voxel_coordinates(self.voxels["key"])
        self._shape_dtype = point_dtype(
            scan_index=self.header.scan_index,
            intensity=self.header.intensity,
            radius_class=self.header.radius_class,
        )
        self._check_shards()
        # All of them now: an archive that is replaced while it is read stays the one that was opened.
        try:
            for number in range(len(self._shards)):
                self._descriptors.append(os.open(self.shard_path(number), os.O_RDONLY | os.O_CLOEXEC))
        except OSError as error:
            self.close()
            raise FormatError(f"{error.filename}: cannot be opened ({error.strerror}): check it") from error

    def _check_shards(self) -> None:
        """Every shard exists, is as long as the index says, and holds every frame the index places in it."""
        for name, size in self._shards:
            path = self.folder / SHARD_FOLDER / name
            if not _SHARD_NAME.fullmatch(name):
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
        sizes = np.array([size for _, size in self._shards], np.uint64)
        if len(self.voxels) and (
            self.voxels["shard"].max() >= len(sizes)
            or (self.voxels["key"][1:] <= self.voxels["key"][:-1]).any()
        ):
            raise FormatError(f"{self.folder}: the index does not add up: restore or rebuild it")
        # The broad phase searches ascending keys and prunes by these bounds: it would call clear what they hide.
        base = self.coordinates * self.header.lattice.voxel_steps
        low, high = base + self.voxels["low"], base + self.voxels["high"]
        if (
            len(base)
            and ((low.min(axis=0) != self.header.low) | (high.max(axis=0) != self.header.high)).any()
        ):
            raise FormatError(f"{self.folder}: the voxels' bounds are not the scene's: restore or rebuild it")
        ends = self.voxels["frame_offset"] + self.voxels["frame_bytes"]
        if (ends > sizes[self.voxels["shard"]][:, None]).any():
            raise FormatError(f"{self.folder}: the index points beyond a shard's end: restore or rebuild it")

    def __enter__(self) -> "Archive":
        """The archive itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the shards."""
        self.close()

    def close(self) -> None:
        """Close the shards; nothing can be read afterwards."""
        while self._descriptors:
            os.close(self._descriptors.pop())

    def shard_path(self, number: int) -> Path:
        """The file of shard `number`."""
        return self.folder / SHARD_FOLDER / self._shards[number][0]

    def shards(self) -> list[tuple[str, int]]:
        """The name and bytes of each shard file, in the order of their numbers."""
        return list(self._shards)

    def shard_count(self) -> int:
        """The number of shard files."""
        return len(self._shards)

    def read_frames(self, row: int) -> tuple[bytes, bytes, bytes]:
        """The three frames (cells, nodes, points) of the voxel in index row `row`.

        Raises CorruptError, naming file, voxel and dataset, when a frame is not the one the index means.
        """
        if not self._descriptors:
            raise ValueError(f"{self.folder}: the archive is closed")
        entry = self.voxels[row]
        frames = []
        for i, name in enumerate(DATASETS):
            size, offset = int(entry["frame_bytes"][i]), int(entry["frame_offset"][i])
            frame = os.pread(self._descriptors[int(entry["shard"])], size, offset)
            if len(frame) != size or frame[-4:] != int(entry["frame_checksum"][i]).to_bytes(4, "little"):
                raise CorruptError(
                    f"{self.where(row)}, {name}: {len(frame)} bytes that are not the record's, expected {size}",
                    (self.shard_path(int(entry["shard"])),),
                )
            frames.append(frame)
        return frames[0], frames[1], frames[2]

    def where(self, row: int) -> str:
        """Where the record of index row `row` lies, for messages."""
        entry = self.voxels[row]
        x, y, z = self.coordinates[row]
        return f"{self.shard_path(int(entry['shard']))}: voxel ({x}, {y}, {z})"

    @contextlib.contextmanager
    def locating(self, row: int) -> Iterator[None]:
        """Say of a CorruptError raised inside where the record of index row `row` lies, and what to do."""
        try:
            yield
        except CorruptError as error:
            raise CorruptError(
                f"{self.where(row)}: {error}: restore the shard or rebuild the archive",
                (self.shard_path(int(self.voxels["shard"][row])),),
            ) from error

    def open_voxel(
        self,
        row: int,
        frames: tuple[bytes, bytes, bytes] | None = None,
        columns: Collection[str] = OPTIONAL_COLUMNS,
    ) -> OpenRecord:
        """The voxel in index row `row`, decompressed, its points still unread; frames: where they are read already.

        columns: of the optional columns those wanted; others are not held.
        Raises CorruptError saying where.
        """
        frames = frames or self.read_frames(row)
        entry = self.voxels[row]
        cells, nodes, points = (int(n) for n in entry["rows"])
        shape = RecordShape(cells, nodes, points, self._shape_dtype)
        with self.locating(row):
            return open_record(
                *frames,
                shape,
                int(entry["key"]),
                self.header.archive_id,
                self.header.lattice.voxel_steps,
                columns,
            )

    def read_voxel(self, row: int) -> tuple[VoxelData, Links]:
        """Read, decompress and check the voxel in index row `row`. Raises CorruptError saying where."""
        record = self.open_voxel(row)
        with self.locating(row):
            return record.decode()
