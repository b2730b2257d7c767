"""VoxelData <-> the three compressed chunks of a record; pure, lossless, the only user of zstandard.

Each chunk is one zstd frame with checksum over the byte planes of a packed compound array: HDF5's standard
shuffle filter followed by the registered zstd filter 32015, so that any HDF5 tool reads typed rows.
FORMAT.md says the same in prose; change both together.
"""

import mmap
import os
import tempfile
import threading
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import zstandard
from numpy.typing import NDArray

from .errors import BadRequestError, CorruptError
from .kernels.rows import delta_along, join_planes, lanes_to_points, leaf_bytes, leaf_column
from .radius_model import RADIUS_CLASSES
from .voxel import (
    MAX_LEAF,
    Cells,
    Links,
    Nodes,
    VoxelData,
    check_tree,
    link_nodes,
    link_tree,
    read_lanes,
    top_shift,
    transposed,
)

# The entropy is in the low bytes, which nothing compresses; what repeats in the high ones repeats at length. Longer and
# fewer matches than level 3 looks for decode the paper's voxel in 0.6 ms less, from 2 % fewer bytes.
_PARAMETERS = zstandard.ZstdCompressionParameters(
    compression_level=3,
    strategy=zstandard.STRATEGY_LAZY2,
    min_match=7,
    window_log=21,
    hash_log=10,
    chain_log=12,
    search_log=3,
    target_length=64,
    write_checksum=True,
    write_content_size=True,
)

_OF_THREAD = threading.local()

# What is compressed at a time of a frame that is not held. The frame's bytes may depend on it.
STREAM_BYTES = 1 << 20
# The index says a frame's length in 32 bits (FORMAT.md).
MAX_FRAME_BYTES = (1 << 32) - 1

CELL_DTYPE = np.dtype(
    [
        ("archive", "<u8", (2,)),
        ("voxel", "<u8"),
        ("low", "<i4", (3,)),
        ("log2_size", "u1"),
        ("nodes", "<u4"),
        ("points", "<u4"),
    ]
)
NODE_DTYPE = np.dtype(
    [
        ("center", "<u2", (3,)),
        ("radius", "<u2"),
        ("normal", "i1", (3,)),
        ("slab", "<i4", (2,)),
        ("count", "u1"),
        ("axis", "u1"),
        ("block_low", "<u2", (3,)),
    ]
)


# The optional columns of the points, in the order of their fields in a row.
OPTIONAL_COLUMNS = ("scan_index", "intensity", "radius_class")


def point_dtype(*, scan_index: bool, intensity: bool, radius_class: bool) -> np.dtype:
    """The row of the points dataset: x, y, z and the optional columns."""
    fields: list[tuple] = [("xyz", "<u2", (3,))]
    if scan_index:
        fields.append(("scan_index", "<u2"))
    if intensity:
        fields.append(("intensity", "<f4"))
    if radius_class:
        fields.append(("radius_class", "u1"))
    return np.dtype(fields)


def voxel_point_dtype(voxel: VoxelData) -> np.dtype:
    """The row of the points dataset of this voxel."""
    return point_dtype(**{name: getattr(voxel, name) is not None for name in OPTIONAL_COLUMNS})


# A zstd frame: held, or in a file that goes with the mapping.
Frame = bytes | mmap.mmap


class Record(NamedTuple):
    """The compressed bytes of one voxel: one zstd frame a dataset, the rows each holds, and its leaf nodes."""

    cells: Frame
    nodes: Frame
    points: Frame
    cell_rows: int
    node_rows: int
    point_rows: int
    leaf_rows: int


class RecordShape(NamedTuple):
    """What the index says of a record: rows of each dataset, and the optional columns."""

    cell_rows: int
    node_rows: int
    point_rows: int
    point_dtype: np.dtype


def encode_voxel(voxel: VoxelData, archive_id: bytes) -> Record:
    """Compress a voxel. archive_id: 16 bytes, repeated in every record. `decode_voxel` gives it back bit for bit."""
    leaf_runs = _leaf_runs(voxel, link_nodes(voxel))
    columns = {name: getattr(voxel, name) for name in OPTIONAL_COLUMNS}
    cells = cell_rows(voxel.key, archive_id, voxel.cells)
    nodes = node_rows(voxel.nodes)
    points = point_rows(voxel.points, leaf_runs, columns)
    leaves = len(leaf_runs[0])
    return Record(_pack(cells), _pack(nodes), _pack(points), len(cells), len(nodes), len(points), leaves)


def cell_rows(key: int, archive_id: bytes, cells: Cells) -> NDArray:
    """The rows (c,) of the cells dataset."""
    rows = np.zeros(len(cells.nodes), CELL_DTYPE)
    rows["archive"] = np.frombuffer(archive_id, "<u8")
    rows["voxel"] = key
    for name, column in zip(Cells._fields, cells, strict=True):
        rows[name] = column
    return rows


def node_rows(nodes: Nodes) -> NDArray:
    """The rows (n,) of the nodes dataset."""
    rows = np.zeros(len(nodes.count), NODE_DTYPE)
    for name, column in zip(Nodes._fields, nodes, strict=True):
        rows[name] = column
    return rows


def point_rows(
    points: NDArray[np.uint16],
    leaf_runs: tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]],
    columns: Mapping[str, NDArray | None],
) -> NDArray:
    """The rows (p,) of the points dataset, or of a part of it that is whole leaf nodes.

    points: (p, 3) as in VoxelData.  leaf_runs: first point, number of points and sort axis of every leaf node.
    columns: by name, those of OPTIONAL_COLUMNS that there are.
    """
    kept = {name: columns.get(name) for name in OPTIONAL_COLUMNS}
    rows = np.zeros(len(points), point_dtype(**{name: column is not None for name, column in kept.items()}))
    rows["xyz"] = delta_along(points, *leaf_runs)
    for name, column in kept.items():
        if column is not None:
            rows[name] = column
    return rows


class RowStream:
    """A dataset of a record whose rows come in parts, in any order: their byte planes in a file, then one frame.

    For voxels that are not to be held. The frame's bytes are a function of the rows, not of the parts; they are not
    those that `encode_voxel` finds, which has all of them at once. Its files have no name and go with the process.
    """

    def __init__(self, scratch: Path, dtype: np.dtype, rows: int) -> None:
        """Make room in the folder `scratch` for so many rows."""
        self._scratch, self._dtype, self._rows = scratch, dtype, rows
        self._planes = tempfile.TemporaryFile(dir=scratch, buffering=0)  # noqa: SIM115  `frame` closes it

    def put(self, first: int, rows: NDArray) -> None:
        """Take the rows from row `first` on."""
        for number, plane in enumerate(_planes_of(rows.astype(self._dtype, copy=False))):
            pwrite_all(self._planes.fileno(), plane, number * self._rows + first)

    def frame(self) -> mmap.mmap:
        """The frame, once all rows are there.

        Raises BadRequestError for one that the index could not name, CorruptError where rows are missing at the end.
        """
        with self._planes as planes, tempfile.TemporaryFile(dir=self._scratch, buffering=0) as file:
            size = self._rows * self._dtype.itemsize
            stream = zstandard.ZstdCompressor(compression_params=_PARAMETERS).compressobj(size=size)
            written = 0
            for at in range(0, size, STREAM_BYTES):
                wanted = min(STREAM_BYTES, size - at)
                part = os.pread(planes.fileno(), wanted, at)
                if len(part) != wanted:
                    raise CorruptError(
                        f"the planes of {self._rows} rows end at byte {at + len(part)}, expected {size}: check the disk"
                    )
                written += pwrite_all(file.fileno(), stream.compress(part), written)
            written += pwrite_all(file.fileno(), stream.flush(), written)
            if written > MAX_FRAME_BYTES:
                raise BadRequestError(
                    f"a voxel of {self._rows} rows takes {written} bytes, a record holds {MAX_FRAME_BYTES}: "
                    "give a smaller --voxel"
                )
            return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)


def pwrite_all(descriptor: int, data: bytes | NDArray, at: int) -> int:
    """Write all of the data at an offset of a file; returns how many bytes."""
    left = memoryview(data if isinstance(data, bytes) else data.data).cast("B")
    size = len(left)
    while left:
        written = os.pwrite(descriptor, left, at)
        at, left = at + written, left[written:]
    return size


class OpenRecord(NamedTuple):
    """A record decompressed, its tree checked; its points still as the frame has them, to be read once, in place.

    cells, nodes: columns of several components as (3, n), as the byte planes give them.  links: see there.
    leaves: leaf nodes, b.  planes: (w, p) uint8, the byte planes of the points' rows, of dtype `dtype`.
    """

    key: int
    voxel_steps: int
    cells: Cells
    nodes: Nodes
    links: Links
    leaves: int
    planes: NDArray[np.uint8]
    dtype: np.dtype

    @property
    def tree(self) -> tuple[NDArray[np.int32], NDArray[np.bool_], NDArray[np.int32]]:
        """The links as kernels take them."""
        return self.links.first, self.links.is_leaf, self.links.cell

    def read_points(self, lanes: NDArray[np.uint16]) -> None:
        """Write the points into lanes (b, 3, MAX_LEAF), the last of a leaf node repeated to its end.

        Raises CorruptError when one lies outside its cell; what is in `lanes` then means nothing.
        """
        name = f"voxel {self.key:#x}"
        read_lanes(name, self.planes[:6], self.cells, self.nodes, self.links, self.voxel_steps, lanes)

    def read_scans(self, lanes: NDArray[np.uint16]) -> None:
        """Write scan_index, in a record that has it, into lanes (b, MAX_LEAF), as `read_points` does."""
        at = self.dtype.fields["scan_index"][1]  # type: ignore[index]  # its dtype has fields
        leaf_column(self.planes[at : at + 2], self.tree, self.nodes.count, lanes)

    def read_classes(self, lanes: NDArray[np.uint8]) -> None:
        """Write radius_class, in a record that has it, into lanes (b, MAX_LEAF), as `read_points` does.

        Raises CorruptError for a class that no table of radii has: a kernel would look it up beyond the table's end.
        """
        at = self.dtype.fields["radius_class"][1]  # type: ignore[index]  # its dtype has fields
        self._check_classes(leaf_bytes(self.planes[at], self.tree, self.nodes.count, lanes))

    def _check_classes(self, greatest: int) -> None:
        """Refuse a record whose greatest radius class is not below RADIUS_CLASSES."""
        if greatest >= RADIUS_CLASSES:
            raise CorruptError(
                f"voxel {self.key:#x}: radius class {greatest}, expected at most {RADIUS_CLASSES - 1}"
            )

    def class_counts(self) -> NDArray[np.int64]:
        """The points of each radius class, (RADIUS_CLASSES,); zeros in a record without. Raises as `read_classes`."""
        counts = np.zeros(256, np.int64)
        if "radius_class" in (self.dtype.names or ()):
            plane = self.planes[self.dtype.fields["radius_class"][1]]  # type: ignore[index]  # its dtype has fields
            for begin in range(0, len(plane), 1 << 16):  # bincount makes int64 of what it is given
                counts += np.bincount(plane[begin : begin + (1 << 16)], minlength=256)
            self._check_classes(int(np.flatnonzero(counts)[-1]))
        return counts[:RADIUS_CLASSES]

    def decode(self) -> tuple[VoxelData, Links]:
        """The whole voxel, its points in rows. Raises CorruptError when a point lies outside its cell, and for a
        radius class that there is none of."""
        lanes = np.empty((self.leaves, 3, MAX_LEAF), np.uint16)
        self.read_points(lanes)
        points = np.empty((self.planes.shape[1], 3), np.uint16)
        lanes_to_points(lanes, self.tree, self.nodes.count, points)
        kept = {
            field: _column(self.planes, self.dtype, field)
            for field in OPTIONAL_COLUMNS
            if field in (self.dtype.names or ())
        }
        if "radius_class" in kept:
            self._check_classes(int(kept["radius_class"].max()))
        cells, nodes = transposed(self.cells), transposed(self.nodes)
        voxel = VoxelData(self.key, top_shift(self.voxel_steps), cells, nodes, points, **kept)
        return voxel, self.links


def open_record(
    cells: bytes,
    nodes: bytes,
    points: bytes,
    shape: RecordShape,
    key: int,
    archive_id: bytes,
    voxel_steps: int,
    columns: Collection[str] = OPTIONAL_COLUMNS,
) -> OpenRecord:
    """Decompress a record and check all of it but the points, which `OpenRecord.read_points` checks as it reads them.

    columns: of the optional columns those wanted; the record is then one that has no others, and holds no others.
    Raises CorruptError when a frame is damaged, of another size than `shape`, of another voxel or archive, or
    holds what `check_voxel` refuses.
    """
    name = f"voxel {key:#x}"
    cell_planes = _unpack(cells, CELL_DTYPE, shape.cell_rows, f"{name}, cells")
    node_planes = _unpack(nodes, NODE_DTYPE, shape.node_rows, f"{name}, nodes")
    names = [n for n in shape.point_dtype.names or () if n == "xyz" or n in columns]
    kept = np.dtype([(n, shape.point_dtype[n]) for n in names])
    point_planes = _unpack(points, shape.point_dtype, shape.point_rows, f"{name}, points", kept)
    identity = np.frombuffer(archive_id + key.to_bytes(8, "little"), np.uint8)
    if (cell_planes[: len(identity)] != identity[:, None]).any():  # archive and voxel come first in a row
        raise CorruptError(f"{name}: the record found is another voxel's or another archive's")
    cell_columns = Cells(*(_column(cell_planes, CELL_DTYPE, field) for field in Cells._fields))
    node_columns = Nodes(*(_column(node_planes, NODE_DTYPE, field) for field in Nodes._fields))
    links = link_tree(name, cell_columns, node_columns.count)
    check_tree(name, cell_columns, node_columns, links, shape.point_rows, voxel_steps)
    leaves = int(np.count_nonzero(links.is_leaf))
    return OpenRecord(key, voxel_steps, cell_columns, node_columns, links, leaves, point_planes, kept)


def decode_voxel(
    cells: bytes,
    nodes: bytes,
    points: bytes,
    shape: RecordShape,
    key: int,
    archive_id: bytes,
    voxel_steps: int,
) -> tuple[VoxelData, Links]:
    """Decompress and check a record, points and all. Inverse of `encode_voxel`. Raises as `open_record` does."""
    return open_record(cells, nodes, points, shape, key, archive_id, voxel_steps).decode()


def _leaf_runs(
    voxel: VoxelData, links: Links
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """First point, number of points and sort axis of every leaf node."""
    leaf = links.is_leaf
    return (
        links.first[leaf].astype(np.int64),
        voxel.nodes.count[leaf].astype(np.int64),
        voxel.nodes.axis[leaf].astype(np.int64),
    )


def _pack(rows: NDArray) -> bytes:
    """Byte planes (HDF5's shuffle) of a packed array, as one zstd frame with checksum and declared size."""
    return zstandard.ZstdCompressor(compression_params=_PARAMETERS).compress(_planes_of(rows).data)


def _planes_of(rows: NDArray) -> NDArray[np.uint8]:
    """The byte planes (itemsize, n) of packed rows (n,)."""
    return np.ascontiguousarray(rows.view(np.uint8).reshape(len(rows), rows.dtype.itemsize).T)


def _unpack(
    frame: bytes, dtype: np.dtype, count: int, what: str, kept: np.dtype | None = None
) -> NDArray[np.uint8]:
    """The byte planes (itemsize, count) that `_pack` compressed, read-only; of the fields of `kept` alone.

    Refuses a frame that declares another size before anything is allocated for it.
    """
    expected = count * dtype.itemsize
    try:
        declared = zstandard.get_frame_parameters(frame)
        if declared.content_size != expected:
            raise CorruptError(f"{what}: frame of {declared.content_size} bytes, expected {expected}")
        # One flipped bit turns the checksum off: the frame would be read unchecked, its checksum as extra bytes.
        if not declared.has_checksum:
            raise CorruptError(f"{what}: frame without checksum, expected one")
        if kept is not None and kept != dtype:
            return _unpack_fields(frame, dtype, count, kept)
        plain = _decompressor().decompress(frame, max_output_size=expected, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise CorruptError(f"{what}: damaged frame ({error})") from error
    return np.frombuffer(plain, np.uint8).reshape(dtype.itemsize, count)


def _unpack_fields(frame: bytes, dtype: np.dtype, count: int, kept: np.dtype) -> NDArray[np.uint8]:
    """The byte planes of the fields of `kept`, the others read past in pieces: a checksum is of all of a frame.

    Raises ZstdError. Its declared size has been checked, and its last bytes, which a stream could do without.
    """
    planes = np.empty((kept.itemsize, count), np.uint8)
    past = np.empty(min(count, 1 << 16), np.uint8)
    stream = _decompressor().stream_reader(frame, read_across_frames=False)
    at = 0
    for name in dtype.names or ():
        width = dtype[name].itemsize
        wanted = name in (kept.names or ())
        parts = [planes[at + i] for i in range(width)] if wanted else _pieces(past, width * count)
        for part in parts:
            _fill(stream, part)
        at += width * wanted
    if stream.readinto(bytearray(1)):
        raise zstandard.ZstdError("more than was declared")
    planes.flags.writeable = False
    return planes


def _pieces(scratch: NDArray[np.uint8], size: int) -> Iterator[NDArray[np.uint8]]:
    """`scratch`, or its beginning, as often as it takes for `size` bytes."""
    for begin in range(0, size, len(scratch)):
        yield scratch[: size - begin]


def _fill(stream: zstandard.ZstdDecompressionReader, out: NDArray[np.uint8]) -> None:
    """Read so many bytes; ZstdError where there are not as many."""
    begin = 0
    while begin < len(out):
        read = stream.readinto(out[begin:].data)
        if not read:
            raise zstandard.ZstdError("it ends early")
        begin += read


def _decompressor() -> zstandard.ZstdDecompressor:
    """This thread's own: making one costs 0.1 ms, and none may be used by two threads at once."""
    found: zstandard.ZstdDecompressor | None = getattr(_OF_THREAD, "decompressor", None)
    if found is None:
        found = _OF_THREAD.decompressor = zstandard.ZstdDecompressor()
    return found


def _column(planes: NDArray[np.uint8], dtype: np.dtype, field: str) -> NDArray:
    """One field of packed rows from their byte planes (itemsize, n): (n,), or (3, n) where it has three components."""
    kind, at = dtype.fields[field][:2]  # type: ignore[index]  # compound, all of them
    n, size = planes.shape[1], kind.base.itemsize
    words = np.empty((kind.itemsize // size, n), f"u{size}")
    join_planes(planes[at : at + kind.itemsize], words)
    return words.view(kind.base).reshape(*kind.shape, n)
