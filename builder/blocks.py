"""Points of voxels in blocks that memory holds, and what lies around a block, whatever voxels it is in.

For rules that ask what is near a point, see filter.py. What is near is handed out in pieces: a voxel may have any
number of points. Positions are int32 lattice steps from a corner of a box around the block.
"""

from collections import OrderedDict
from collections.abc import Iterator, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..schemas.kernels.morton import morton_decode
from ..schemas.voxel_grid import KEY_BIAS, voxel_coordinates, voxel_keys
from .kernels.filter import cell_numbers
from .spool import Spool

# Points held at a time, of a voxel and of what lies around it: memory, not results, depends on it.
BLOCK_POINTS = 1 << 19
# Voxels of more are read in cubes of at most so many where only their border is wanted; smaller ones whole, and kept
# while a unit works its way along, for they are neighbours of the next voxel too.
BORDER_POINTS = 1 << 17

Box = tuple[NDArray[np.int64], NDArray[np.int64]]


class Block(NamedTuple):
    """Points of one cube of a voxel. low: (3,) int64 lattice, the voxel's.  corner, size: the cube's, in the voxel."""

    key: int
    low: NDArray[np.int64]
    corner: NDArray[np.int64]
    size: int
    rows: NDArray

    def bounds(self) -> Box:
        """The least and greatest position (3,) in the lattice."""
        local = self.rows["local"]
        return self.low + local.min(axis=0), self.low + local.max(axis=0)


class NearPoints(NamedTuple):
    """Points near a block. positions: (n, 3) int32 from a base.  scans: (n,) int64.  intensities: (n,) float32."""

    positions: NDArray[np.int32]
    scans: NDArray[np.int64]
    intensities: NDArray[np.float32]

    @classmethod
    def of(cls, rows: NDArray, shift: NDArray[np.int64]) -> "NearPoints":
        """Rows, `shift` (3,) added to their position in the voxel."""
        names = rows.dtype.names or ()
        return cls(
            rows["local"] + shift.astype(np.int32),
            rows["scan_index"].astype(np.int64),
            rows["intensity"].copy() if "intensity" in names else np.zeros(len(rows), np.float32),
        )

    def taken(self, which: NDArray) -> "NearPoints":
        """Some of them."""
        return NearPoints(*(column[which] for column in self))

    @classmethod
    def joined(cls, parts: Sequence["NearPoints"]) -> "NearPoints":
        """All of some."""
        return cls(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


class BlockReader:
    """Reads blocks of voxels, and what lies around them; keeps small voxels that it read last."""

    def __init__(self, spool: Spool) -> None:
        self.spool = spool
        self.root = int(spool.lattice.voxel_steps - 1).bit_length()
        self._kept: OrderedDict[int, NDArray] = OrderedDict()
        self._held = 0

    def blocks(self, key: int, box: Box | None = None) -> Iterator[Block]:
        """A voxel's points in cubes of at most BLOCK_POINTS, in Morton order.

        Of a voxel of which only a box (in the lattice) is wanted, the cubes that it reaches, of at most BORDER_POINTS.
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
        """The rows of a voxel; small ones are kept, all together as many as a block."""
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
        """All points in a box (inclusive, lattice) but those of the block, in pieces, from the box's low corner.

        A position's points are in one piece, all of them.
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
    """Cells of one length over a box: `cell_numbers` with these."""

    edge: int
    across: int
    deep: int

    @classmethod
    def over(cls, box: Box, edge: int) -> "Grid":
        """Cells of `edge` over a box (inclusive)."""
        cells = (box[1] - box[0]) // edge + 3
        return cls(edge, int(cells[1]), int(cells[2]))

    def cells(self, positions: NDArray[np.int32]) -> NDArray[np.uint64]:
        """The cell of each position, from the box's low corner."""
        return np.asarray(cell_numbers(positions, *self))
