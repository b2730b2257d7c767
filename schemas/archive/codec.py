"""Encoding of a voxel to the three compressed datasets of a record, and decoding; pure, lossless.

Each dataset is one frame (zstd_frame.py) over packed rows, whose dtypes are defined here. FORMAT.md
documents the same; change both together.
"""

from collections.abc import Collection, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import CorruptError, MisleadingIndexError
from ..kernels.record_rows import delta_along, lanes_to_points, leaf_bytes, leaf_column
from .radius_model import RADIUS_CLASSES
from .voxel import (
    MAX_LEAF,
    LeafCells,
    Links,
    Nodes,
    VoxelData,
    check_cell_nodes,
    check_cell_points,
    check_tree,
    decode_points,
    link_nodes,
    link_tree,
    top_shift,
    transpose_columns,
)
from .zstd_frame import Expansion, Frame, column_of, pack, unpack

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

# Limits of the decompressed size of a frame of cells or nodes. The number of leaf nodes limits the
# points, at most 32 each. A scanner may return many points at one place where nothing reflects, and
# their equal nodes compress without limit: the first 16 MB of nodes are exempt from the ratio.
CELL_EXPANSION = Expansion(1 << 20, 256)
NODE_EXPANSION = Expansion(1 << 24, 256)

# Optional columns of the points, in the order of their fields in a row: type and shape.
_COLUMNS: dict[str, tuple[str, tuple[int, ...]]] = {
    "scan_index": ("<u2", ()),
    "intensity": ("<f4", ()),
    "radius_class": ("u1", ()),
    "rgb": ("u1", (3,)),
    "classification": ("u1", ()),
}
OPTIONAL_COLUMNS = tuple(_COLUMNS)


def point_dtype(**kept: bool) -> np.dtype:
    """Return the row dtype of the points dataset: x, y, z and those of OPTIONAL_COLUMNS that are true."""
    assert kept.keys() <= _COLUMNS.keys(), kept
    return np.dtype([("xyz", "<u2", (3,)), *((n, *kind) for n, kind in _COLUMNS.items() if kept.get(n))])


def voxel_point_dtype(voxel: VoxelData) -> np.dtype:
    """Return the row dtype of the points dataset of this voxel."""
    return point_dtype(**{name: getattr(voxel, name) is not None for name in OPTIONAL_COLUMNS})


class Record(NamedTuple):
    """Compressed voxel: a zstd frame and a row count per dataset, and the number of leaf nodes."""

    cells: Frame
    nodes: Frame
    points: Frame
    cell_rows: int
    node_rows: int
    point_rows: int
    leaf_rows: int


class RecordShape(NamedTuple):
    """Shape of a record as the index states it.

    cell_rows, node_rows, point_rows: rows of each dataset.
    point_dtype: with the optional columns.  leaves: number of leaf nodes.
    bounds: (2, 3) int, least and greatest coordinates of the points [voxel steps].
    classes: bit c is set if points of the archive have radius class c.
    A field that is None is not known, and not compared with the record.
    """

    cell_rows: int
    node_rows: int
    point_rows: int
    point_dtype: np.dtype
    leaves: int | None = None
    bounds: NDArray[np.int32] | None = None
    classes: int | None = None


def encode_voxel(voxel: VoxelData, archive_id: bytes) -> Record:
    """Compress a voxel. `decode_voxel` restores it bit for bit.

    archive_id: 16 bytes, repeated in every record.
    """
    leaf_runs = _leaf_runs(voxel, link_nodes(voxel))
    columns = {name: getattr(voxel, name) for name in OPTIONAL_COLUMNS}
    cells = cell_rows(voxel.key, archive_id, voxel.cells)
    nodes = node_rows(voxel.nodes)
    points = point_rows(voxel.points, leaf_runs, columns)
    leaves = len(leaf_runs[0])
    frames = pack(cells, CELL_EXPANSION), pack(nodes, NODE_EXPANSION), pack(points)
    return Record(*frames, len(cells), len(nodes), len(points), leaves)


def cell_rows(key: int, archive_id: bytes, cells: LeafCells) -> NDArray:
    """Return the rows (c,) of the cells dataset."""
    rows = np.zeros(len(cells.nodes), CELL_DTYPE)
    rows["archive"] = np.frombuffer(archive_id, "<u8")
    rows["voxel"] = key
    for name, column in zip(LeafCells._fields, cells, strict=True):
        rows[name] = column
    return rows


def node_rows(nodes: Nodes) -> NDArray:
    """Return the rows (n,) of the nodes dataset."""
    rows = np.zeros(len(nodes.count), NODE_DTYPE)
    for name, column in zip(Nodes._fields, nodes, strict=True):
        rows[name] = column
    return rows


def point_rows(
    points: NDArray[np.uint16],
    leaf_runs: tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]],
    columns: Mapping[str, NDArray | None],
) -> NDArray:
    """Return the rows (p,) of the points dataset, or of a part of it made of whole leaf nodes.

    points: (p, 3) as in VoxelData.
    leaf_runs: first point, number of points and sort axis of every leaf node.
    columns: the optional columns (OPTIONAL_COLUMNS) that exist, by name.
    """
    kept = {name: columns.get(name) for name in OPTIONAL_COLUMNS}
    rows = np.zeros(len(points), point_dtype(**{name: column is not None for name, column in kept.items()}))
    rows["xyz"] = delta_along(points, *leaf_runs)
    for name, column in kept.items():
        if column is not None:
            rows[name] = column
    return rows


class DecompressedTree(NamedTuple):
    """Decompressed and checked record without its points. Fields as in DecompressedRecord."""

    cells: LeafCells
    nodes: Nodes
    links: Links
    leaves: int


class DecompressedRecord(NamedTuple):
    """Decompressed record with a checked tree.

    Its points stay as byte planes, to be read once, in place.
    cells, nodes: columns of several components as (3, n), as in the byte planes.
    links: see Links.  leaves: number of leaf nodes, b.
    planes: (w, p) uint8, the byte planes of the points' rows, of dtype `dtype`.
    shape: the record's shape in the index.
    """

    key: int
    voxel_steps: int
    cells: LeafCells
    nodes: Nodes
    links: Links
    leaves: int
    planes: NDArray[np.uint8]
    dtype: np.dtype
    shape: RecordShape

    @property
    def tree(self) -> tuple[NDArray[np.int32], NDArray[np.bool_], NDArray[np.int32]]:
        """Return the links as kernels take them."""
        return self.links.first, self.links.is_leaf, self.links.cell

    def read_points(self, lanes: NDArray[np.uint16]) -> None:
        """Write the points into lanes (b, 3, MAX_LEAF).

        The last point of a leaf node is repeated up to the end of its lanes.
        Raises CorruptError if a point lies outside its cell, MisleadingIndexError if the bounds of
        all points differ from those in the index. The content of `lanes` is meaningless then.
        """
        name = f"voxel {self.key:#x}"
        self.check_bounds(
            decode_points(name, self.planes[:6], self.cells, self.nodes, self.links, self.voxel_steps, lanes)
        )

    def check_bounds(self, found: NDArray[np.int64]) -> None:
        """Compare the bounds (2, 3) of the points [voxel steps] with the index.

        Raises MisleadingIndexError.
        """
        expected = self.shape.bounds
        if expected is not None and (found != expected).any():
            raise MisleadingIndexError(
                f"voxel {self.key:#x}: points from {found[0].tolist()} to {found[1].tolist()}, "
                f"the index says from {expected[0].tolist()} to {expected[1].tolist()}"
            )

    def read_scans(self, lanes: NDArray[np.uint16]) -> None:
        """Write scan_index into lanes (b, MAX_LEAF), as `read_points` does.

        The record must have the column.
        """
        at = self.dtype.fields["scan_index"][1]  # type: ignore[index]  # its dtype has fields
        leaf_column(self.planes[at : at + 2], self.tree, self.nodes.count, lanes)

    def read_classes(self, lanes: NDArray[np.uint8]) -> None:
        """Write radius_class into lanes (b, MAX_LEAF), as `read_points` does.

        The record must have the column.
        Raises CorruptError for a class beyond the table of radii: a kernel would index past its
        end.
        """
        at = self.dtype.fields["radius_class"][1]  # type: ignore[index]  # its dtype has fields
        greatest, seen = leaf_bytes(self.planes[at], self.tree, self.nodes.count, lanes)
        self._check_classes(int(greatest), int(seen))

    def _check_classes(self, greatest: int, seen: int) -> None:
        """Check that all radius classes are below RADIUS_CLASSES and are counted in the index.

        seen: bit c is set if the record has class c.
        The reach of a query is limited by the largest sphere among the classes that the index
        counts.
        Raises CorruptError, or MisleadingIndexError for a class that the index does not count.
        """
        if greatest >= RADIUS_CLASSES:
            raise CorruptError(
                f"voxel {self.key:#x}: radius class {greatest}, expected at most {RADIUS_CLASSES - 1}"
            )
        expected = self.shape.classes
        if expected is not None and (other := seen & ~expected):
            raise MisleadingIndexError(
                f"voxel {self.key:#x}: points of radius class {other.bit_length() - 1}, "
                "the index counts no points of this class"
            )

    def class_counts(self) -> NDArray[np.int64]:
        """Return the number of points in each radius class, (RADIUS_CLASSES,).

        All are zero in a record without classes. Raises as `read_classes` does.
        """
        counts = np.zeros(256, np.int64)
        if "radius_class" in (self.dtype.names or ()):
            plane = self.planes[self.dtype.fields["radius_class"][1]]  # type: ignore[index]  # its dtype has fields
            for begin in range(0, len(plane), 1 << 16):  # bincount converts its input to int64
                counts += np.bincount(plane[begin : begin + (1 << 16)], minlength=256)
            found = np.flatnonzero(counts).tolist()
            self._check_classes(found[-1], sum(1 << c for c in found if c < RADIUS_CLASSES))
        return counts[:RADIUS_CLASSES]

    def decode(self) -> tuple[VoxelData, Links]:
        """Return the whole voxel, with its points in rows, and its links.

        Raises CorruptError if a point lies outside its cell, or for an invalid radius class.
        """
        lanes = np.empty((self.leaves, 3, MAX_LEAF), np.uint16)
        self.read_points(lanes)
        points = np.empty((self.planes.shape[1], 3), np.uint16)
        lanes_to_points(lanes, self.tree, self.nodes.count, points)
        kept = {
            field: np.ascontiguousarray(column_of(self.planes, self.dtype, field).T)
            for field in OPTIONAL_COLUMNS
            if field in (self.dtype.names or ())
        }
        if "radius_class" in kept:
            self.class_counts()
        cells, nodes = transpose_columns(self.cells), transpose_columns(self.nodes)
        voxel = VoxelData(self.key, top_shift(self.voxel_steps), cells, nodes, points, **kept)
        return voxel, self.links


def decompress_record(
    cells: bytes,
    nodes: bytes,
    points: bytes,
    shape: RecordShape,
    key: int,
    archive_id: bytes,
    voxel_steps: int,
    columns: Collection[str] = OPTIONAL_COLUMNS,
) -> DecompressedRecord:
    """Decompress a record and check everything but the points.

    `DecompressedRecord.read_points` checks the points as it reads them.
    columns: optional columns to decompress; the result has no others.
    Raises CorruptError if a frame is damaged, has another size than `shape`, belongs to another
    voxel or archive, or contains what `check_voxel` refuses.
    """
    names = [n for n in shape.point_dtype.names or () if n == "xyz" or n in columns]
    kept = np.dtype([(n, shape.point_dtype[n]) for n in names])
    # In this order, so that no frame is decompressed before the earlier ones confirm its row count.
    tree = decompress_tree(cells, nodes, shape, key, archive_id, voxel_steps)
    planes = unpack(points, shape.point_dtype, shape.point_rows, f"voxel {key:#x}, points", kept)
    return DecompressedRecord(key, voxel_steps, *tree, planes, kept, shape)


def decompress_tree(
    cells: bytes, nodes: bytes, shape: RecordShape, key: int, archive_id: bytes, voxel_steps: int
) -> DecompressedTree:
    """Decompress and check a record without its points, as `decompress_record` does.

    The frame of the points need not have been read.
    """
    name = f"voxel {key:#x}"
    cell_planes = unpack(cells, CELL_DTYPE, shape.cell_rows, f"{name}, cells")
    identity = np.frombuffer(archive_id + key.to_bytes(8, "little"), np.uint8)
    # Archive and voxel are the first fields of a row.
    if (cell_planes[: len(identity)] != identity[:, None]).any():
        raise MisleadingIndexError(f"{name}: the record belongs to another voxel or archive")
    cell_columns = LeafCells(*(column_of(cell_planes, CELL_DTYPE, field) for field in LeafCells._fields))
    check_cell_nodes(name, cell_columns, shape.node_rows)
    check_cell_points(name, cell_columns, shape.point_rows)
    node_planes = unpack(nodes, NODE_DTYPE, shape.node_rows, f"{name}, nodes")
    node_columns = Nodes(*(column_of(node_planes, NODE_DTYPE, field) for field in Nodes._fields))
    links = link_tree(name, cell_columns, node_columns.count)
    check_tree(name, cell_columns, node_columns, links, shape.point_rows, voxel_steps)
    leaves = int(np.count_nonzero(links.is_leaf))
    if shape.leaves is not None and leaves != shape.leaves:
        raise CorruptError(f"{name}: {leaves} leaf nodes, the index says {shape.leaves}")
    return DecompressedTree(cell_columns, node_columns, links, leaves)


def decode_voxel(
    cells: bytes,
    nodes: bytes,
    points: bytes,
    shape: RecordShape,
    key: int,
    archive_id: bytes,
    voxel_steps: int,
) -> tuple[VoxelData, Links]:
    """Decompress and check a record, points included. Inverse of `encode_voxel`.

    Raises as `decompress_record` does.
    """
    return decompress_record(cells, nodes, points, shape, key, archive_id, voxel_steps).decode()


def _leaf_runs(
    voxel: VoxelData, links: Links
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return the first point, the number of points and the sort axis of every leaf node."""
    leaf = links.is_leaf
    return (
        links.first[leaf].astype(np.int64),
        voxel.nodes.count[leaf].astype(np.int64),
        voxel.nodes.axis[leaf].astype(np.int64),
    )
