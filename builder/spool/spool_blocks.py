"""Blocks of points that fit in memory, and the points around a block in all voxels.

The filter rules that examine the neighbourhood of a point use them (filter_pass.py). A voxel may have
any number of points, so neighbours are delivered in pieces. Positions are int32 lattice steps from
a corner of a box around the block.
"""

from collections import OrderedDict
from collections.abc import Iterator, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.voxel_grid import KEY_BIAS, voxel_coordinates, voxel_keys
from ...schemas.kernels.morton import morton_decode
from ..kernels.neighbours.filter_counts import cell_numbers
from .point_order import packed_look
from .spool import Spool

# Most points in memory at a time, of a voxel and of its surroundings. Memory depends on it; results
# do not.
BLOCK_POINTS = 1 << 19
# If only the border of a voxel is needed, a voxel with more points is read in cubes of at most this
# many. A smaller voxel is read whole and cached, because it is a neighbour of the next voxel too.
BORDER_POINTS = 1 << 17

Box = tuple[NDArray[np.int64], NDArray[np.int64]]


class Block(NamedTuple):
    """Points of one cube of a voxel.

    low: (3,) int64 low corner of the voxel [lattice].  corner, size: of the cube, in the voxel.
    """

    key: int
    low: NDArray[np.int64]
    corner: NDArray[np.int64]
    size: int
    rows: NDArray

    def bounds(self) -> Box:
        """Return the least and greatest position (3,) in the lattice."""
        local = self.rows["local"]
        return self.low + local.min(axis=0), self.low + local.max(axis=0)


class NearPoints(NamedTuple):
    """Points near a block.

    positions: (n, 3) int32 from a base.  scans: (n,) int64.  intensities: (n,) float32.
    looks: (n,) uint32, see `packed_look`.
    """

    positions: NDArray[np.int32]
    scans: NDArray[np.int64]
    intensities: NDArray[np.float32]
    looks: NDArray[np.uint32]

    @classmethod
    def of(cls, rows: NDArray, shift: NDArray[np.int64]) -> "NearPoints":
        """Make points of rows, with `shift` (3,) added to their positions in the voxel."""
        names = rows.dtype.names or ()
        looks = [rows[name] if name in names else None for name in ("rgb", "classification")]
        return cls(
            rows["local"] + shift.astype(np.int32),
            rows["scan_index"].astype(np.int64),
            rows["intensity"].copy() if "intensity" in names else np.zeros(len(rows), np.float32),
            packed_look(*looks)
            if any(look is not None for look in looks)
            else np.zeros(len(rows), np.uint32),
        )

    def taken(self, which: NDArray) -> "NearPoints":
        """Return the selected points."""
        return NearPoints(*(column[which] for column in self))

    @classmethod
    def joined(cls, parts: Sequence["NearPoints"]) -> "NearPoints":
        """Concatenate several sets of points."""
        return cls(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


class BlockReader:
    """Reader of blocks of voxels and of their surroundings; caches the small voxels read last."""

    def __init__(self, spool: Spool) -> None:
        self.spool = spool
        self.root = int(spool.lattice.voxel_steps - 1).bit_length()
        self._kept: OrderedDict[int, NDArray] = OrderedDict()
        self._held = 0

    def blocks(self, key: int, box: Box | None = None) -> Iterator[Block]:
        """Read a voxel's points in cubes of at most BLOCK_POINTS, in Morton order.

        box: if given (lattice), read only the cubes that the box overlaps, of at most BORDER_POINTS
        each.
        """
        most = BLOCK_POINTS if box is None else BORDER_POINTS
        low = voxel_coordinates(np.array([key], np.uint64))[0] * self.spool.lattice.voxel_steps
        stack = [(0, self.root)]
        while stack:
            code, log2 = stack.pop()
            corner = morton_decode(np.array([code], np.uint64))[0].astype(np.int64)
            size, end = 1 << log2, code + (1 << 3 * log2)
            if box is not None and ((low + corner > box[1]).any() or (low + corner + size <= box[0]).any()):
                continue
            whole = log2 == self.root
            count = self.spool.count(key) if whole else self.spool.block_count(key, code, end)
            if count > most and log2 > 0:
                part = 1 << 3 * (log2 - 1)
                stack += [(code + child * part, log2 - 1) for child in reversed(range(8))]
            elif count:
                rows = self._whole(key) if whole else np.concatenate(self.spool.block_rows(key, code, end))
                yield Block(key, low, corner, size, rows)

    def _whole(self, key: int) -> NDArray:
        """Read all rows of a voxel; cache small voxels, together at most BLOCK_POINTS rows."""
        if key in self._kept:
            self._kept.move_to_end(key)
            return self._kept[key]
        rows = np.concatenate(self.spool.rows(key))
        if len(rows) <= BORDER_POINTS:
            self._kept[key] = rows
            self._held += len(rows)
            while self._held > BLOCK_POINTS:
                self._held -= len(self._kept.popitem(last=False)[1])
        return rows

    def around(self, block: Block, box: Box) -> Iterator[NearPoints]:
        """Read all points in a box (inclusive, lattice) except those of the block, in pieces.

        Positions are from the box's low corner. All points at one position are in the same piece.
        """
        voxel_steps = self.spool.lattice.voxel_steps
        held: list[NearPoints] = []
        first, last = box[0] // voxel_steps, box[1] // voxel_steps
        for place in product(*(range(int(a), int(b) + 1) for a, b in zip(first, last, strict=True))):
            if min(place) < -KEY_BIAS or max(place) >= KEY_BIAS:
                continue
            key = int(voxel_keys(np.array([place], np.int64))[0])
            for near in self.blocks(key, box):
                positions = near.rows["local"] + near.low
                inside = ((positions >= box[0]) & (positions <= box[1])).all(axis=1)
                if key == block.key:
                    cube = near.rows["local"] - block.corner
                    inside &= ~((cube >= 0) & (cube < block.size)).all(axis=1)
                if inside.any():
                    held.append(NearPoints.of(near.rows[inside], near.low - box[0]))
                if sum(len(points.scans) for points in held) >= BORDER_POINTS:
                    yield NearPoints.joined(held)
                    held = []
        if held:
            yield NearPoints.joined(held)


class Grid(NamedTuple):
    """Uniform grid over a box; holds the arguments of `cell_numbers`."""

    edge: int
    across: int
    deep: int

    @classmethod
    def over(cls, box: Box, edge: int) -> "Grid":
        """Lay a grid of cells of length `edge` over a box (inclusive)."""
        cells = (box[1] - box[0]) // edge + 3
        return cls(edge, int(cells[1]), int(cells[2]))

    def cells(self, positions: NDArray[np.int32]) -> NDArray[np.uint64]:
        """Return the cell number of each position; positions are from the box's low corner."""
        return np.asarray(cell_numbers(positions, *self))
