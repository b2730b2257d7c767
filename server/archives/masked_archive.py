"""Archive opened without the points inside some boxes, for the effect `through`.

Answers are those of an archive whose scans never had these points. A point is in a box if its world
coordinates lie between low and high on each axis, both included. World coordinates are computed as
for every answer: `Lattice.to_world`, then the archive's pose (rigid_transform.py).

The builder's code rebuilds the few voxels that a box intersects when the archive is opened. Their
records are kept in an unnamed temporary file: a load takes the usual time, the cache's budget
counts all memory, and the size of a voxel is known before it is loaded. Voxels whose cell lies
inside a box are dropped unread, so a large box costs only what its borders intersect. Rebuilding a
voxel takes 90 bytes a point. The header keeps its bounds (`outside`), counts and radius. Regions of
scans that were left out remain unknown inside a box.
"""

import io
import logging
import os
import tempfile
import time
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...builder.voxel.masked_voxel import BuiltVoxel, build_masked_voxel, read_points
from ...schemas.archive.archive import Archive
from ...schemas.archive.zstd_frame import pwrite_all
from ...schemas.errors import BadRequestError, CorruptError, FormatError, SolidcloudError
from .rigid_transform import archive_pose, transform_boxes, transform_points

log = logging.getLogger(__name__)

# Upper bound of the rounding error of a transformed corner, relative to the largest coordinate. A
# larger value only makes more voxels be read, because their points are tested one by one.
_ROUNDING = 1e-14
# Interval between two lines of progress in the log [s].
_LOG_SECONDS = 10.0

# Place of a rebuilt record in the temporary file: (offset, bytes) of each frame.
_Place = list[tuple[int, int]]


class MaskedArchive(Archive):
    """Archive opened for reading, without the points inside some boxes."""

    def __init__(
        self,
        folder: str | os.PathLike[str],
        boxes: Sequence[ArrayLike],
        pose: ArrayLike | None = None,
    ) -> None:
        """Open the archive in `folder`, at `pose` in the world; None: at the identity.

        boxes: (2, 3) each, low and high, world [m]. The voxels that they intersect are read.
        Raise FormatError as `Archive` does, and for a voxel that cannot be read. Raise
        SolidcloudError if there is no disk space for the rebuilt records, BadRequestError if the
        boxes contain all points. A corrupt record is no error here: the request that loads the
        voxel gets it.
        """
        self._boxes = [np.asarray(box, np.float64) for box in boxes]
        self._pose = archive_pose(pose)
        self._file: io.FileIO | None = None
        self.is_as_stored = False
        self._end = 0
        self._rebuilt: dict[int, _Place] = {}
        self._corrupt: dict[int, CorruptError] = {}
        super().__init__(folder)
        try:
            self._mask()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the shards and the file of rebuilt records."""
        super().close()
        if self._file is not None:
            self._file.close()

    def _mask(self) -> None:
        """Rebuild the voxels that a box intersects, and update the index."""
        voxels = self.voxels.copy()
        rebuilt: dict[int, _Place] = {}
        corrupt: dict[int, CorruptError] = {}
        partial, gone = self._intersected()
        for row, boxes in self._log_progress(partial):
            try:
                points = read_points(self, row)
            except CorruptError as error:
                corrupt[row] = error
                continue
            except OSError as error:
                raise FormatError(
                    f"{self.where(row)}: cannot be read ({error.strerror}): check it"
                ) from error
            stays = ~self._in_boxes(row, points.local, boxes)
            if stays.all():
                continue
            if not stays.any():
                gone[row] = True
                continue
            built = build_masked_voxel(self.header, int(self.voxels["key"][row]), points, stays)
            rebuilt[row] = self._store(built)
            _update_row(voxels, row, built)
        kept = np.flatnonzero(~gone)
        if len(voxels) and not len(kept):
            raise BadRequestError(
                f"{self.folder}: the boxes of the effect `through` contain all of its points: leave the archive out "
                "of the scene, or give smaller boxes"
            )
        now = {row: at for at, row in enumerate(kept.tolist())}
        self.voxels, self.coordinates = voxels[kept], self.coordinates[kept]
        self._rebuilt = {now[row]: place for row, place in rebuilt.items()}
        self._corrupt = {now[row]: said for row, said in corrupt.items()}

    def _intersected(self) -> tuple[dict[int, list[NDArray[np.float64]]], NDArray[np.bool_]]:
        """Return the boxes that intersect voxels, by row, and the mask (v,) of voxels inside a box.

        A box intersects a voxel if it intersects the bounds of the voxel's points in the index. For
        "inside", the voxel's whole cell counts, because the voxel is never read and a forged index
        cannot shrink a cell (server/residency/index_proof.py).
        """
        steps = self.header.lattice.voxel_steps
        base = self.coordinates * steps
        low, high = self._world_boxes(base + self.voxels["low"], base + self.voxels["high"])
        cell_low, cell_high = self._world_boxes(base, base + (steps - 1))
        whole = np.zeros(len(base), bool)
        met: dict[int, list[NDArray[np.float64]]] = {}
        for box in self._boxes:
            least, greatest = box
            meets = np.flatnonzero(((low <= greatest) & (high >= least)).all(axis=1))
            whole[meets] |= ((cell_low[meets] >= least) & (cell_high[meets] <= greatest)).all(axis=1)
            for row in meets.tolist():
                met.setdefault(row, []).append(box)
        return {row: met[row] for row in sorted(met) if not whole[row]}, whole

    def _world_boxes(
        self, low: NDArray[np.int64], high: NDArray[np.int64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return world boxes [m] that enclose lattice boxes, low and high (v, 3) each."""
        world = self.header.lattice.to_world(low), self.header.lattice.to_world(high)
        if self._pose is None or not len(low):
            return world
        far = max(float(np.abs(side).max()) for side in (*world, self._pose[:3, 3]))
        least, greatest = transform_boxes(self._pose, *world)
        return least - far * _ROUNDING, greatest + far * _ROUNDING

    def _log_progress(
        self, partial: dict[int, list[NDArray[np.float64]]]
    ) -> Iterator[tuple[int, list[NDArray[np.float64]]]]:
        """Yield the voxels to rebuild, and log the progress every `_LOG_SECONDS`."""
        logged = time.monotonic()
        for number, (row, boxes) in enumerate(partial.items()):
            if time.monotonic() - logged > _LOG_SECONDS:
                logged = time.monotonic()
                log.info(
                    "%s: rebuilt %d of %d voxels that boxes intersect", self.folder, number, len(partial)
                )
            yield row, boxes

    def is_masked(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return the mask (n,) of points that are in a box. points: (n, 3), archive frame [m]."""
        return self._are_in(points, self._boxes)

    def _in_boxes(
        self, row: int, local: NDArray[np.int32], boxes: list[NDArray[np.float64]]
    ) -> NDArray[np.bool_]:
        """Return the mask (n,) of points that are in a box.

        local: (n, 3), points of the voxel [steps from its corner].
        """
        lattice = self.header.lattice
        return self._are_in(lattice.to_world(local + self.coordinates[row] * lattice.voxel_steps), boxes)

    def _are_in(self, points: NDArray[np.float64], boxes: list[NDArray[np.float64]]) -> NDArray[np.bool_]:
        """Return the mask (n,) of points that are in a box. points: (n, 3), archive frame [m]."""
        world = points
        if self._pose is not None:
            world = transform_points(self._pose, world)
        within = np.zeros(len(world), bool)
        for low, high in boxes:
            within |= ((world >= low) & (world <= high)).all(axis=1)
        return within

    def _store(self, built: BuiltVoxel) -> _Place:
        """Append a record to the temporary file. Return its place. Raise SolidcloudError."""
        frames: _Place = []
        try:
            if self._file is None:
                self._file = tempfile.TemporaryFile(  # noqa: SIM115  closed with the archive
                    prefix="solidcloud-through-", buffering=0
                )
            for frame in (built.record.cells, built.record.nodes, built.record.points):
                data = bytes(frame)
                frames.append((self._end, len(data)))
                self._end += pwrite_all(self._file.fileno(), data, self._end)
        except OSError as error:
            raise SolidcloudError(
                f"{tempfile.gettempdir()}: {error.strerror}: rebuilt voxels of the effect `through` are stored there: "
                "free disk space, or set TMPDIR"
            ) from error
        return frames

    def _read_frame(self, row: int, i: int) -> bytes:
        """Return the frame of dataset `i` of a voxel, from the temporary file if it was rebuilt."""
        if row in self._corrupt:
            # A record that was repaired meanwhile would contain its points in boxes: do not reread
            # it.
            error = self._corrupt[row]
            raise type(error)(str(error), error.paths)
        place = self._rebuilt.get(row)
        if place is None or self._file is None or self._file.closed:
            return super()._read_frame(row, i)
        offset, size = place[i]
        return os.pread(self._file.fileno(), size, offset)


def _update_row(voxels: NDArray, row: int, built: BuiltVoxel) -> None:
    """Write the sizes and bounds of a rebuilt record into a row of the index, except its place."""
    record = built.record
    voxels["rows"][row] = record.cell_rows, record.node_rows, record.point_rows
    voxels["leaves"][row] = record.leaf_rows
    voxels["low"][row], voxels["high"][row] = built.low, built.high
