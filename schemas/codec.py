"""VoxelData <-> the three compressed datasets of a record; pure, lossless.

Each dataset is one frame (frames.py) over packed rows, whose types are here. FORMAT.md says the same in prose; change
both together.
"""

from collections.abc import Collection, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .errors import CorruptError, MisleadingIndexError
from .frames import Expansion, Frame, column_of, pack, unpack
from .kernels.rows import delta_along, lanes_to_points, leaf_bytes, leaf_column
from .radius_model import RADIUS_CLASSES
from .voxel import (
    MAX_LEAF,
    Cells,
    Links,
    Nodes,
    VoxelData,
    check_cell_nodes,
    check_cell_points,
    check_tree,
    link_nodes,
    link_tree,
    read_lanes,
    top_shift,
    transposed,
)

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

# The most bytes that a frame of cells or nodes stands for. Points follow from the nodes: at most 32 a leaf node.
# Scanners give many points in one place where nothing reflects. Their nodes are all alike: 16 MB are free.
CELL_EXPANSION = Expansion(1 << 20, 256)
NODE_EXPANSION = Expansion(1 << 24, 256)

# The optional columns of the points, in the order of their fields in a row.
OPTIONAL_COLUMNS = ("scan_index", "intensity", "radius_class", "normal")


def point_dtype(*, scan_index: bool, intensity: bool, radius_class: bool, normal: bool = False) -> np.dtype:
    """The row of the points dataset: x, y, z and the optional columns."""
    fields: list[tuple] = [("xyz", "<u2", (3,))]
    if scan_index:
        fields.append(("scan_index", "<u2"))
    if intensity:
        fields.append(("intensity", "<f4"))
    if radius_class:
        fields.append(("radius_class", "u1"))
    if normal:
        fields.append(("normal", "<u2"))
    return np.dtype(fields)


def voxel_point_dtype(voxel: VoxelData) -> np.dtype:
    """The row of the points dataset of this voxel."""
    return point_dtype(**{name: getattr(voxel, name) is not None for name in OPTIONAL_COLUMNS})


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
    """What the index says of a record.

    cell_rows, node_rows, point_rows: rows of each dataset.  point_dtype: with the optional columns.  leaves: leaf
    nodes.  bounds: (2, 3) int, least and greatest coordinates of the points [voxel steps].  classes: bit c is set where
    points of the archive have radius class c. None: not known, and not compared with the record.
    """

    cell_rows: int
    node_rows: int
    point_rows: int
    point_dtype: np.dtype
    leaves: int | None = None
    bounds: NDArray[np.int32] | None = None
    classes: int | None = None


def encode_voxel(voxel: VoxelData, archive_id: bytes) -> Record:
    """Compress a voxel. archive_id: 16 bytes, repeated in every record. `decode_voxel` gives it back bit for bit."""
    leaf_runs = _leaf_runs(voxel, link_nodes(voxel))
    columns = {name: getattr(voxel, name) for name in OPTIONAL_COLUMNS}
    cells = cell_rows(voxel.key, archive_id, voxel.cells)
    nodes = node_rows(voxel.nodes)
    points = point_rows(voxel.points, leaf_runs, columns)
    leaves = len(leaf_runs[0])
    frames = pack(cells, CELL_EXPANSION), pack(nodes, NODE_EXPANSION), pack(points)
    return Record(*frames, len(cells), len(nodes), len(points), leaves)


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


class OpenTree(NamedTuple):
    """What a record holds beside its points, decompressed and checked. Fields as of OpenRecord."""

    cells: Cells
    nodes: Nodes
    links: Links
    leaves: int


class OpenRecord(NamedTuple):
    """A record decompressed, its tree checked; its points still as the frame has them, to be read once, in place.

    cells, nodes: columns of several components as (3, n), as the byte planes give them.  links: see there.
    leaves: leaf nodes, b.  planes: (w, p) uint8, the byte planes of the points' rows, of dtype `dtype`.
    shape: what the index says of the record.
    """

    key: int
    voxel_steps: int
    cells: Cells
    nodes: Nodes
    links: Links
    leaves: int
    planes: NDArray[np.uint8]
    dtype: np.dtype
    shape: RecordShape

    @property
    def tree(self) -> tuple[NDArray[np.int32], NDArray[np.bool_], NDArray[np.int32]]:
        """The links as kernels take them."""
        return self.links.first, self.links.is_leaf, self.links.cell

    def read_points(self, lanes: NDArray[np.uint16]) -> None:
        """Write the points into lanes (b, 3, MAX_LEAF), the last of a leaf node repeated to its end.

        Raises CorruptError when one lies outside its cell, MisleadingIndexError when the bounds of all are not those in
        the index; what is in `lanes` then means nothing.
        """
        name = f"voxel {self.key:#x}"
        self.check_bounds(
            read_lanes(name, self.planes[:6], self.cells, self.nodes, self.links, self.voxel_steps, lanes)
        )

    def check_bounds(self, found: NDArray[np.int64]) -> None:
        """Compare the bounds (2, 3) of the points [voxel steps] with the index. Raises MisleadingIndexError."""
        expected = self.shape.bounds
        if expected is not None and (found != expected).any():
            raise MisleadingIndexError(
                f"voxel {self.key:#x}: points from {found[0].tolist()} to {found[1].tolist()}, "
                f"the index says from {expected[0].tolist()} to {expected[1].tolist()}"
            )

    def read_scans(self, lanes: NDArray[np.uint16]) -> None:
        """Write scan_index, in a record that has it, into lanes (b, MAX_LEAF), as `read_points` does."""
        at = self.dtype.fields["scan_index"][1]  # type: ignore[index]  # its dtype has fields
        leaf_column(self.planes[at : at + 2], self.tree, self.nodes.count, lanes)

    def read_classes(self, lanes: NDArray[np.uint8]) -> None:
        """Write radius_class, in a record that has it, into lanes (b, MAX_LEAF), as `read_points` does.

        Raises CorruptError for a class that no table of radii has: a kernel would look it up beyond the table's end.
        """
        at = self.dtype.fields["radius_class"][1]  # type: ignore[index]  # its dtype has fields
        greatest, seen = leaf_bytes(self.planes[at], self.tree, self.nodes.count, lanes)
        self._check_classes(int(greatest), int(seen))

    def _check_classes(self, greatest: int, seen: int) -> None:
        """Refuse a record whose greatest radius class is not below RADIUS_CLASSES, or that has one the index has not.

        seen: bit c is set where the record has class c. Questions reach no farther than the largest sphere of the
        classes that the index counts.
        """
        if greatest >= RADIUS_CLASSES:
            raise CorruptError(
                f"voxel {self.key:#x}: radius class {greatest}, expected at most {RADIUS_CLASSES - 1}"
            )
        expected = self.shape.classes
        if expected is not None and (other := seen & ~expected):
            raise MisleadingIndexError(
                f"voxel {self.key:#x}: points of radius class {other.bit_length() - 1}, the index counts none of it"
            )

    def read_normals(self, lanes: NDArray[np.uint16]) -> None:
        """Write normal, in a record that has it, into lanes (b, MAX_LEAF), as `read_points` does.

        Raises CorruptError for what is no code (kernels/normals.py).
        """
        self.check_normals()
        at = self.dtype.fields["normal"][1]  # type: ignore[index]  # its dtype has fields
        leaf_column(self.planes[at : at + 2], self.tree, self.nodes.count, lanes)

    def check_normals(self) -> None:
        """Refuse a record with what is no code of a normal: both bytes are 0, or neither is."""
        at = self.dtype.fields["normal"][1]  # type: ignore[index]  # its dtype has fields
        low, high = self.planes[at : at + 2]
        if wrong := int(np.count_nonzero((low == 0) != (high == 0))):
            raise CorruptError(f"voxel {self.key:#x}: {wrong} normals that are no codes, expected none")

    def class_counts(self) -> NDArray[np.int64]:
        """The points of each radius class, (RADIUS_CLASSES,); zeros in a record without. Raises as `read_classes`."""
        counts = np.zeros(256, np.int64)
        if "radius_class" in (self.dtype.names or ()):
            plane = self.planes[self.dtype.fields["radius_class"][1]]  # type: ignore[index]  # its dtype has fields
            for begin in range(0, len(plane), 1 << 16):  # bincount makes int64 of what it is given
                counts += np.bincount(plane[begin : begin + (1 << 16)], minlength=256)
            found = np.flatnonzero(counts).tolist()
            self._check_classes(found[-1], sum(1 << c for c in found if c < RADIUS_CLASSES))
        return counts[:RADIUS_CLASSES]

    def decode(self) -> tuple[VoxelData, Links]:
        """The whole voxel, its points in rows. Raises CorruptError when a point lies outside its cell, and for a
        radius class or a normal that there is none of."""
        lanes = np.empty((self.leaves, 3, MAX_LEAF), np.uint16)
        self.read_points(lanes)
        points = np.empty((self.planes.shape[1], 3), np.uint16)
        lanes_to_points(lanes, self.tree, self.nodes.count, points)
        kept = {
            field: column_of(self.planes, self.dtype, field)
            for field in OPTIONAL_COLUMNS
            if field in (self.dtype.names or ())
        }
        if "radius_class" in kept:
            self.class_counts()
        if "normal" in kept:
            self.check_normals()
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
    names = [n for n in shape.point_dtype.names or () if n == "xyz" or n in columns]
    kept = np.dtype([(n, shape.point_dtype[n]) for n in names])
    # In this order, so that each frame is decompressed only when those before it say how many rows it must have.
    tree = open_tree(cells, nodes, shape, key, archive_id, voxel_steps)
    planes = unpack(points, shape.point_dtype, shape.point_rows, f"voxel {key:#x}, points", kept)
    return OpenRecord(key, voxel_steps, *tree, planes, kept, shape)


def open_tree(
    cells: bytes, nodes: bytes, shape: RecordShape, key: int, archive_id: bytes, voxel_steps: int
) -> OpenTree:
    """`open_record` without the points: they need not have been read."""
    name = f"voxel {key:#x}"
    cell_planes = unpack(cells, CELL_DTYPE, shape.cell_rows, f"{name}, cells")
    identity = np.frombuffer(archive_id + key.to_bytes(8, "little"), np.uint8)
    if (cell_planes[: len(identity)] != identity[:, None]).any():  # archive and voxel come first in a row
        raise MisleadingIndexError(f"{name}: the record found is another voxel's or another archive's")
    cell_columns = Cells(*(column_of(cell_planes, CELL_DTYPE, field) for field in Cells._fields))
    check_cell_nodes(name, cell_columns, shape.node_rows)
    check_cell_points(name, cell_columns, shape.point_rows)
    node_planes = unpack(nodes, NODE_DTYPE, shape.node_rows, f"{name}, nodes")
    node_columns = Nodes(*(column_of(node_planes, NODE_DTYPE, field) for field in Nodes._fields))
    links = link_tree(name, cell_columns, node_columns.count)
    check_tree(name, cell_columns, node_columns, links, shape.point_rows, voxel_steps)
    leaves = int(np.count_nonzero(links.is_leaf))
    if shape.leaves is not None and leaves != shape.leaves:
        raise CorruptError(f"{name}: {leaves} leaf nodes, the index says {shape.leaves}")
    return OpenTree(cell_columns, node_columns, links, leaves)


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
