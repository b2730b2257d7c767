"""An archive without its points in some boxes, as if they had never been scanned. What `through` opens.

The rule: a point is in a box if its world coordinates, as every answer gives them (`Lattice.to_world`, then the
archive's pose, server/posed.py), are within low to high on each axis, both included.

The few voxels with such points are built anew by the builder's code when the archive is opened, and their records kept
in a temporary file without a name: a load costs what it always does, no memory is taken that nobody counts, and the
bytes a voxel takes are known before it is loaded. Voxels that are left empty are gone. All else stays: the
header stays the archive's, its bounds (`outside`), counts and radius with it, and so do regions of scans left out,
which are unknown inside a box too.
"""

import os
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..builder.without import BuiltVoxel, build_rest, read_points
from ..schemas.archive import Archive
from ..schemas.errors import BadRequestError, CorruptError
from .posed import archive_pose, moved, moved_boxes

# What a corner carried by a pose may be off, of the largest coordinate: boxes of voxels are only to choose those that
# are read.
_ROUNDING = 1e-14


# Where a record built anew lies in the temporary file: (offset, bytes) of each frame.
_Place = list[tuple[int, int]]


class LeftOut(Archive):
    """An archive opened for reading, points in some boxes left out."""

    def __init__(
        self, folder: str | os.PathLike[str], boxes: Sequence[ArrayLike], pose: ArrayLike | None = None
    ) -> None:
        """Open the archive in `folder`, which lies at `pose` in the world; None: at the identity.

        boxes: (2, 3) each, low and high, world [m]. The voxels that meet one are read. Raises FormatError as `Archive`
        does, OSError where one cannot be read now; BadRequestError where the boxes hold all points. A corrupt record
        stays one: whoever asks for the voxel is told why.
        """
        self._boxes = [np.asarray(box, np.float64) for box in boxes]
        self._pose = archive_pose(pose)
        self._file: BinaryIO | None = None
        self._anew: dict[int, _Place] = {}
        self._corrupt: dict[int, tuple[str, tuple[Path, ...]]] = {}
        super().__init__(folder)
        try:
            self._leave_out()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the shards and forget what was built anew."""
        super().close()
        if self._file is not None:
            self._file.close()

    def _leave_out(self) -> None:
        """Build anew what meets a box, and make the index say so."""
        voxels, empty = self.voxels.copy(), set[int]()
        anew: dict[int, _Place] = {}
        corrupt: dict[int, tuple[str, tuple[Path, ...]]] = {}
        for row, boxes in self._met():
            try:
                points = read_points(self, row)
            except CorruptError as error:
                corrupt[row] = (str(error), error.paths)
                continue
            stays = ~self._in_boxes(row, points.local, boxes)
            if stays.all():
                continue
            if not stays.any():
                empty.add(row)
                continue
            built = build_rest(self.header, int(self.voxels["key"][row]), points, stays)
            anew[row] = self._keep(built)
            _say(voxels, row, built)
        kept = np.array([row for row in range(len(voxels)) if row not in empty], np.int64)
        if len(voxels) and not len(kept):
            raise BadRequestError(
                f"{self.folder}: the boxes that are passed through hold all of its points: leave the archive out of "
                "the scene, or give smaller boxes"
            )
        now = {row: at for at, row in enumerate(kept.tolist())}
        self.voxels, self.coordinates = voxels[kept], self.coordinates[kept]
        self._anew = {now[row]: place for row, place in anew.items()}
        self._corrupt = {now[row]: said for row, said in corrupt.items()}

    def _met(self) -> list[tuple[int, list[NDArray[np.float64]]]]:
        """The rows of voxels whose points' bounds meet boxes, and these."""
        base = self.coordinates * self.header.lattice.voxel_steps
        low, high = (self.header.lattice.to_world(base + self.voxels[side]) for side in ("low", "high"))
        if self._pose is not None and len(base):
            far = max(float(np.abs(side).max()) for side in (low, high, self._pose[:3, 3]))
            low, high = moved_boxes(self._pose, low, high)
            low, high = low - far * _ROUNDING, high + far * _ROUNDING
        meets = np.zeros((len(self._boxes), len(base)), bool)
        for i, (least, greatest) in enumerate(self._boxes):
            meets[i] = ((low <= greatest) & (high >= least)).all(axis=1)
        rows = np.flatnonzero(meets.any(axis=0))
        return [(int(row), [self._boxes[i] for i in np.flatnonzero(meets[:, row])]) for row in rows]

    def _in_boxes(
        self, row: int, local: NDArray[np.int32], boxes: list[NDArray[np.float64]]
    ) -> NDArray[np.bool_]:
        """Which points (n, 3) of a voxel [steps from its corner] are in one of the boxes; the rule."""
        lattice = self.header.lattice
        world = lattice.to_world(local + self.coordinates[row] * lattice.voxel_steps)
        if self._pose is not None:
            world = moved(self._pose, world)
        within = np.zeros(len(world), bool)
        for low, high in boxes:
            within |= ((world >= low) & (world <= high)).all(axis=1)
        return within

    def _keep(self, built: BuiltVoxel) -> _Place:
        """Write a record into the temporary file."""
        if self._file is None:
            self._file = tempfile.TemporaryFile(prefix="solidcloud-through-")  # noqa: SIM115  closed with the archive
        frames: _Place = []
        for frame in (built.record.cells, built.record.nodes, built.record.points):
            data = bytes(frame)
            frames.append((self._file.tell(), len(data)))
            self._file.write(data)
        self._file.flush()
        return frames

    def _read_frame(self, row: int, i: int) -> bytes:
        """The frame of dataset `i` of a voxel; of one built anew that of its new record."""
        if row in self._corrupt:
            # Not read again: mended meanwhile, it would be served with the points in the boxes.
            text, paths = self._corrupt[row]
            raise CorruptError(text, paths)
        place = self._anew.get(row)
        if place is None or self._file is None or self._file.closed:
            return super()._read_frame(row, i)
        offset, size = place[i]
        return os.pread(self._file.fileno(), size, offset)


def _say(voxels: NDArray, row: int, built: BuiltVoxel) -> None:
    """Make the index's row say what a record built anew holds; where it lay in its shard, it says on."""
    record = built.record
    voxels["rows"][row] = record.cell_rows, record.node_rows, record.point_rows
    voxels["leaves"][row] = record.leaf_rows
    voxels["low"][row], voxels["high"][row] = built.low, built.high
