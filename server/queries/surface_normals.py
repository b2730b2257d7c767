"""Surface normals at scan points, estimated on demand and cached; for the effects slide and stand.

Normals are estimated one point at a time: all normals of a voxel of half a million points would
take seconds, and those of the few points touched in a frame take some microseconds each.
"""

import math
from collections import OrderedDict
from collections.abc import Callable
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...schemas.archive.normal_reach import squared_reach
from ...schemas.errors import BadRequestError, CorruptError
from ...schemas.kernels.normal_codes import NO_NORMAL, decode_normal
from ..kernels.core.array_references import refer_to_scene
from ..kernels.core.scene_arrays import LANES
from ..kernels.rays.stored_normals import NOT_ESTIMATED, code_at, find_voxel, highest_near, stored_code_at
from ..residency.voxel_store import VoxelStore
from ..runtime.stop_flag import NO_STOP, StopFlag, StoppedError
from .context.query_context import SceneData, with_stop

# Memory for normals, as a share of the budget for voxels, in addition to it.
SHARE = 1 / 32

_Found = TypeVar("_Found")


def warm(data: SceneData) -> None:
    """Compile the kernels in advance: a frame needs normals only once something is touched."""
    arrays = data.arrays._replace(where=np.full_like(data.arrays.where, -1))
    nowhere = refer_to_scene(arrays, data.broad)
    find_voxel(data.broad.keys, arrays.voxel_steps, 0, 0, 0)
    code_at(nowhere, 0, 0, 0, 0, 1, np.empty(0, np.uint16))
    stored_code_at(nowhere, 0, 0, 0, 0, data.keeps_scan)
    highest_near(nowhere, 0, 0, 0, 0, 1, np.empty((0, 3)), np.empty(0))
    decode_normal(int(NOT_ESTIMATED) << 8 | 1)


class Normals:
    """Normals of one generation of an archive. Thread-safe.

    Normals that the store has loaded (`VoxelStore.with_normals`) are looked up for requests of their
    reach. Other normals are estimated and cached: a voxel takes two bytes a point from the first
    request until the voxel is evicted or others need the memory, first in, first out.
    used_bytes: memory of the cached normals.  most_bytes: its limit.
    estimated: number of estimated normals.  visits: tree nodes visited for all normals.
    """

    def __init__(self, store: VoxelStore, data: SceneData, most_bytes: int | None = None) -> None:
        """Make an empty cache for the voxels of `store`, which `data` holds in memory.

        Both must stay open while this object is used.
        most_bytes: None for a 32nd of the budget for voxels. The normals of a voxel that needs more
        are not cached.
        """
        rows = store.archive.voxels
        self.most_bytes = int(data.residency.budget_bytes * SHARE) if most_bytes is None else most_bytes
        self.used_bytes = self.estimated = self.visits = 0
        # Shared by all requests, so the stop flag of the first one must not apply.
        self._data, self._leaves = with_stop(data, NO_STOP), rows["leaves"]
        self._held = data.references.to(data.arrays, data.broad)
        self._most_points = int(rows["rows"][:, 2].max(initial=0))
        self._origin = tuple(data.arrays.origin.tolist())
        self._codes: OrderedDict[tuple[int, int], NDArray[np.uint16]] = OrderedDict()
        self._evictions = 0
        self._squares: dict[float, int] = {}
        self._all_squares: dict[tuple[float, ...], NDArray[np.int64]] = {}
        self._stored = -1
        if store.with_normals:
            self._stored = squared_reach(
                store.archive.header.normal_reach, data.arrays.step, self._most_points
            )

    def at(
        self,
        cloud: ArrayLike,
        toward: ArrayLike,
        reach: float,
        stop: StopFlag = NO_STOP,
        *,
        waits: bool = True,
    ) -> NDArray[np.float64] | None:
        """Return the unit normal (3,) of the surface at a scan point, on the side of `toward`.

        Return None if there is no point, or the points form no surface
        (schemas/kernels/normal_codes.py).
        cloud: (3,) the point, world [m], within half a lattice step.
        toward: (3,) any length; if it is 0 or lies in the surface, the side is arbitrary.
        reach: points within this distance of the point form its surface [m].
        stop: ends a wait for a load.  waits: if False, do not load the point's voxel.
        Raise BadRequestError for an invalid reach, CorruptError for an unreadable voxel,
        StoppedError, also for a voxel that is not in memory if it may not be loaded.
        """
        code = self.code(cloud, reach, stop, waits=waits)
        if code == NO_NORMAL:
            return None
        x, y, z = decode_normal(code)
        a, b, c = (float(t) for t in np.asarray(toward))
        side = -1.0 if x * a + y * b + z * c < 0.0 else 1.0
        return np.array([side * x, side * y, side * z])

    def code(self, cloud: ArrayLike, reach: float, stop: StopFlag = NO_STOP, *, waits: bool = True) -> int:
        """Return the code of the normal (schemas/kernels/normal_codes.py); NO_NORMAL if there is none.

        stop, waits: as for `at`. Raise CorruptError, StoppedError.
        """
        square = self._square(reach)

        def look(row: int, x: int, y: int, z: int) -> int:
            return self._look(row, x, y, z, square)

        return self._at_point(cloud, look, int(NO_NORMAL), stop, waits=waits)

    def highest(
        self,
        cloud: ArrayLike,
        directions: NDArray[np.float64],
        reach: float,
        stop: StopFlag = NO_STOP,
        *,
        waits: bool = True,
    ) -> NDArray[np.float64]:
        """Return how high the points near a scan point lie along directions (k,) [m].

        The points are those that form its surface: of its voxel, within reach.
        directions: (k, 3) unit. Other arguments and errors as for `at`.
        """
        square = self._square(reach)
        directions, heights = np.ascontiguousarray(directions), np.zeros(len(directions))

        def look(row: int, x: int, y: int, z: int) -> int:
            held = self._held
            return int(held.call(highest_near, held.reference, row, x, y, z, square, directions, heights))

        self.visits += self._at_point(cloud, look, 0, stop, waits=waits)
        return heights * self._data.arrays.step

    def squares(self, reaches: tuple[float, ...]) -> NDArray[np.int64]:
        """Return the squares of reaches [steps^2], 0 for an invalid one, that of the stored normals, or -1.

        The last element says whether scan numbers are in memory.
        """
        found = self._all_squares.get(reaches)
        if found is None:
            squares = []
            for reach in reaches:
                try:
                    squares.append(self._square(reach))
                except BadRequestError:
                    squares.append(0)
            found = np.array([*squares, self._stored, self._data.keeps_scan], np.int64)
            self._all_squares[reaches] = found
        return found

    def _square(self, reach: float) -> int:
        """Return the square of a reach [steps^2]. Raise BadRequestError."""
        square = self._squares.get(reach)
        if square is None:
            square = squared_reach(reach, self._data.arrays.step, self._most_points)
            self._squares[reach] = square
        return square

    def _at_point(
        self,
        cloud: ArrayLike,
        look: Callable[[int, int, int, int], _Found],
        nothing: _Found,
        stop: StopFlag,
        *,
        waits: bool,
    ) -> _Found:
        """Return `look` of the row of a point's voxel, resident during the call, and the lattice point.

        nothing: returned where there is no voxel. Raise CorruptError, StoppedError.
        """
        step = self._data.arrays.step
        place = np.asarray(cloud, np.float64).tolist()
        # Lattice.to_lattice without arrays: both round half to even.
        x, y, z = (round((c - o) / step) for c, o in zip(place, self._origin, strict=True))
        row = self._held.call(find_voxel, self._data.broad.keys, self._data.arrays.voxel_steps, x, y, z)
        if row < 0:
            return nothing
        residency = self._data.residency
        with residency.frozen():
            if self._data.arrays.where[row, 0] >= 0:
                residency.use([row])
                return look(row, x, y, z)
        with residency.hold([row], math.inf if waits else -math.inf, stop=stop) as held:
            if held.late:
                raise StoppedError
            if held.faults:
                raise CorruptError(held.faults[0])
            with residency.frozen():
                return look(row, x, y, z)

    def _look(self, row: int, x: int, y: int, z: int, square: int) -> int:
        """Return `code` of a lattice point in a voxel that stays resident during the call."""
        if square == self._stored:
            found, visits = self._held.call(
                stored_code_at, self._held.reference, row, x, y, z, self._data.keeps_scan
            )
            self.visits += int(visits)
            return int(found)
        self._drop_evicted()
        codes = self._codes.get((row, square))
        if codes is None:
            codes = self._make(row, square)
        code, visits, fresh = self._held.call(code_at, self._held.reference, row, x, y, z, square, codes)
        self.visits += int(visits)
        self.estimated += int(fresh)
        return int(code)

    def _drop_evicted(self) -> None:
        """Drop the normals of voxels that are no longer resident."""
        residency = self._data.residency
        if residency.evictions == self._evictions:
            return
        self._evictions = residency.evictions
        for key in [key for key in self._codes if not residency.is_resident(key[0])]:
            self._drop(key)

    def _drop(self, key: tuple[int, int]) -> None:
        self.used_bytes -= self._codes.pop(key).nbytes

    def _make(self, row: int, square: int) -> NDArray[np.uint16]:
        """Make an array for the codes of a voxel, dropping others; empty if it is too large."""
        points = int(self._leaves[row]) * LANES
        if points * NOT_ESTIMATED.itemsize > self.most_bytes:
            return np.empty(0, np.uint16)
        codes = np.full(points, NOT_ESTIMATED)
        while self.used_bytes + codes.nbytes > self.most_bytes:
            self._drop(next(iter(self._codes)))
        self._codes[row, square] = codes
        self.used_bytes += codes.nbytes
        return codes
