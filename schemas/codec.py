"""VoxelData <-> the three compressed chunks of a record; pure, lossless, the only user of zstandard.

Each chunk is one zstd frame with checksum over the byte planes of a packed compound array: HDF5's standard
shuffle filter followed by the registered zstd filter 32015, so that any HDF5 tool reads typed rows.
FORMAT.md says the same in prose; change both together.
"""

from typing import NamedTuple

import numpy as np
import zstandard
from numpy.typing import NDArray

from .errors import CorruptError
from .kernels.rows import delta_along, undo_delta_along
from .voxel import Cells, Links, Nodes, VoxelData, check_voxel, link_nodes, top_shift

# zstd's own default; higher levels gain little here, as the entropy is in the low bytes.
ZSTD_LEVEL = 3

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


def point_dtype(*, scan_index: bool, intensity: bool) -> np.dtype:
    """The row of the points dataset: x, y, z and the optional columns."""
    fields: list[tuple] = [("xyz", "<u2", (3,))]
    if scan_index:
        fields.append(("scan_index", "<u2"))
    if intensity:
        fields.append(("intensity", "<f4"))
    return np.dtype(fields)


class Record(NamedTuple):
    """The compressed bytes of one voxel: one zstd frame a dataset, the rows each holds, and its leaf nodes."""

    cells: bytes
    nodes: bytes
    points: bytes
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
    links = link_nodes(voxel)
    cells = np.zeros(len(voxel.cells.nodes), CELL_DTYPE)
    cells["archive"] = np.frombuffer(archive_id, "<u8")
    cells["voxel"] = voxel.key
    for name, column in zip(Cells._fields, voxel.cells, strict=True):
        cells[name] = column
    nodes = np.zeros(len(voxel.nodes.count), NODE_DTYPE)
    for name, column in zip(Nodes._fields, voxel.nodes, strict=True):
        nodes[name] = column
    dtype = point_dtype(scan_index=voxel.scan_index is not None, intensity=voxel.intensity is not None)
    points = np.zeros(len(voxel.points), dtype)
    first, count, axis = _leaf_runs(voxel, links)
    points["xyz"] = delta_along(voxel.points, first, count, axis)
    if voxel.scan_index is not None:
        points["scan_index"] = voxel.scan_index
    if voxel.intensity is not None:
        points["intensity"] = voxel.intensity
    return Record(_pack(cells), _pack(nodes), _pack(points), len(cells), len(nodes), len(points), len(first))


def decode_voxel(
    cells: bytes,
    nodes: bytes,
    points: bytes,
    shape: RecordShape,
    key: int,
    archive_id: bytes,
    voxel_steps: int,
) -> tuple[VoxelData, Links]:
    """Decompress and check a record. Inverse of `encode_voxel`.

    Raises CorruptError when a frame is damaged, of another size than `shape`, of another voxel or archive, or
    holds what `check_voxel` refuses.
    """
    cell_rows = _unpack(cells, CELL_DTYPE, shape.cell_rows, f"voxel {key:#x}, cells")
    node_rows = _unpack(nodes, NODE_DTYPE, shape.node_rows, f"voxel {key:#x}, nodes")
    point_rows = _unpack(points, shape.point_dtype, shape.point_rows, f"voxel {key:#x}, points")
    if (cell_rows["voxel"] != key).any() or (cell_rows["archive"] != np.frombuffer(archive_id, "<u8")).any():
        raise CorruptError(f"voxel {key:#x}: the record found is another voxel's or another archive's")
    names = shape.point_dtype.names or ()
    voxel = VoxelData(
        key,
        top_shift(voxel_steps),
        Cells(*(np.ascontiguousarray(cell_rows[name]) for name in Cells._fields)),
        Nodes(*(np.ascontiguousarray(node_rows[name]) for name in Nodes._fields)),
        np.ascontiguousarray(point_rows["xyz"]),
        np.ascontiguousarray(point_rows["scan_index"]) if "scan_index" in names else None,
        np.ascontiguousarray(point_rows["intensity"]) if "intensity" in names else None,
    )
    links = link_nodes(voxel)
    if int(voxel.cells.points.sum(dtype=np.int64)) != len(voxel.points) or (voxel.nodes.axis > 2).any():
        raise CorruptError(f"voxel {key:#x}: counts or sort axes out of range")
    undo_delta_along(voxel.points, *_leaf_runs(voxel, links))
    return voxel, check_voxel(voxel, voxel_steps)


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
    planes = np.ascontiguousarray(rows.view(np.uint8).reshape(len(rows), -1).T)
    compressor = zstandard.ZstdCompressor(level=ZSTD_LEVEL, write_checksum=True, write_content_size=True)
    return compressor.compress(planes.data)


def _unpack(frame: bytes, dtype: np.dtype, count: int, what: str) -> NDArray:
    """Undo `_pack`, refusing a frame that declares another size before anything is allocated for it."""
    expected = count * dtype.itemsize
    try:
        declared = zstandard.get_frame_parameters(frame)
        if declared.content_size != expected:
            raise CorruptError(f"{what}: frame of {declared.content_size} bytes, expected {expected}")
        # One flipped bit turns the checksum off: the frame would be read unchecked, its checksum as extra bytes.
        if not declared.has_checksum:
            raise CorruptError(f"{what}: frame without checksum, expected one")
        plain = zstandard.ZstdDecompressor().decompress(
            frame, max_output_size=expected, allow_extra_data=False
        )
    except zstandard.ZstdError as error:
        raise CorruptError(f"{what}: damaged frame ({error})") from error
    planes = np.frombuffer(plain, np.uint8).reshape(dtype.itemsize, count)
    # A copy always: planes of a single row are contiguous both ways, and a view of `plain` would be read-only.
    return planes.T.copy().view(dtype).reshape(count)
