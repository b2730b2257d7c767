"""An archive without its points in some boxes, as if they had never been scanned. What `through` opens.

The rule: a point is in a box if its world coordinates, as every answer gives them (`Lattice.to_world`, then the
archive's pose, server/archives/rigid_transform.py), are within low to high on each axis, both included.

The few voxels that a box cuts are built anew by the builder's code when the archive is opened, and their records kept
in a temporary file without a name: a load costs what it always does, no memory is taken that nobody counts, and the
bytes a voxel takes are known before it is loaded. Voxels whose cell lies in a box whole are gone unread, so
however large a box, what it costs is what its borders cut; while it is built, a voxel takes 90 bytes a point. All else
stays: the header stays the archive's, its bounds (`outside`), counts and radius with it, and so do regions of scans
left out, which are unknown inside a box too.
"""

import io
import logging
import os
import tempfile
import time
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...builder.voxel.masked_voxel import BuiltVoxel, build_rest, read_points
from ...schemas.archive.archive import Archive
from ...schemas.archive.zstd_frame import pwrite_all
from ...schemas.errors import BadRequestError, CorruptError, FormatError, SolidcloudError
from .rigid_transform import archive_pose, moved, moved_boxes

log = logging.getLogger(__name__)

# What a corner carried by a pose may be off, of the largest coordinate: boxes of voxels are only to choose those that
# are read.
_ROUNDING = 1e-14
# How often whoever waits is told how far it is [s].
_SAID_EVERY = 10.0

# Where a record built anew lies in the temporary file: (offset, bytes) of each frame.
_Place = list[tuple[int, int]]


class LeftOut(Archive):
    """An archive opened for reading, points in some boxes left out."""

    def __init__(
        self, folder: str | os.PathLike[str], boxes: Sequence[ArrayLike], pose: ArrayLike | None = None
    ) -> None:
        """Open the archive in `folder`, which lies at `pose` in the world; None: at the identity.

        boxes: (2, 3) each, low and high, world [m]. The voxels that they cut are read. Raises FormatError as `Archive`
        does, and where one cannot be read now; SolidcloudError where there is no room for what is built anew,
        BadRequestError where the boxes hold all points. A corrupt record stays one: whoever asks for the voxel is told
        why.
        """
        self._boxes = [np.asarray(box, np.float64) for box in boxes]
        self._pose = archive_pose(pose)
        self._file: io.FileIO | None = None
        self._end = 0
        self._anew: dict[int, _Place] = {}
        self._corrupt: dict[int, CorruptError] = {}
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
        """Build anew what a box cuts, and make the index say so."""
        voxels = self.voxels.copy()
        anew: dict[int, _Place] = {}
        corrupt: dict[int, CorruptError] = {}
        cut, gone = self._met()
        for row, boxes in self._telling(cut):
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
            built = build_rest(self.header, int(self.voxels["key"][row]), points, stays)
            anew[row] = self._keep(built)
            _say(voxels, row, built)
        kept = np.flatnonzero(~gone)
        if len(voxels) and not len(kept):
            raise BadRequestError(
                f"{self.folder}: the boxes that are passed through hold all of its points: leave the archive out of "
                "the scene, or give smaller boxes"
            )
        now = {row: at for at, row in enumerate(kept.tolist())}
        self.voxels, self.coordinates = voxels[kept], self.coordinates[kept]
        self._anew = {now[row]: place for row, place in anew.items()}
        self._corrupt = {now[row]: said for row, said in corrupt.items()}

    def _met(self) -> tuple[dict[int, list[NDArray[np.float64]]], NDArray[np.bool_]]:
        """The rows of voxels that boxes cut, and these; and which voxels (v,) lie in one whole.

        A box cuts a voxel by the bounds of its points in the index. What lies in a box whole is never read, so that
        goes by the voxel's cell, which no index can make smaller (server/residency/index_proof.py).
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
        """Boxes (v, 3) each [steps] as boxes that hold them in the world [m]."""
        world = self.header.lattice.to_world(low), self.header.lattice.to_world(high)
        if self._pose is None or not len(low):
            return world
        far = max(float(np.abs(side).max()) for side in (*world, self._pose[:3, 3]))
        least, greatest = moved_boxes(self._pose, *world)
        return least - far * _ROUNDING, greatest + far * _ROUNDING

    def _telling(
        self, cut: dict[int, list[NDArray[np.float64]]]
    ) -> Iterator[tuple[int, list[NDArray[np.float64]]]]:
        """The voxels that are cut, one after the other; where they take long, the log says how far it is."""
        said = time.monotonic()
        for number, (row, boxes) in enumerate(cut.items()):
            if time.monotonic() - said > _SAID_EVERY:
                said = time.monotonic()
                log.info("%s: %d of %d voxels that boxes cut are built anew", self.folder, number, len(cut))
            yield row, boxes

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
                f"{tempfile.gettempdir()}: {error.strerror}: the voxels that boxes cut are kept there: make room, or "
                "set TMPDIR"
            ) from error
        return frames

    def _read_frame(self, row: int, i: int) -> bytes:
        """The frame of dataset `i` of a voxel; of one built anew that of its new record."""
        if row in self._corrupt:
            # Not read again: mended meanwhile, it would be served with the points in the boxes.
            error = self._corrupt[row]
            raise type(error)(str(error), error.paths)
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
