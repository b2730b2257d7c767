"""Surface normals at scan points, estimated where somebody asks and remembered; for the effects that slide and stand.

Point by point, not voxel by voxel: all normals of a voxel of half a million points would take seconds, and those of
the few that are touched in a frame take some microseconds each.
"""

from collections import OrderedDict

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...schemas.archive.normal_reach import normal_reach
from ...schemas.errors import CorruptError
from ...schemas.kernels.normal_codes import NONE, decode_normal
from ..kernels.core.voxel_layout import LANES
from ..kernels.rays.stored_normals import UNASKED, code_at, find_voxel, stored_code_at
from ..residency.voxel_store import Store
from ..runtime.stop_flag import NEVER, Stop, StoppedError
from .context.query_context import SceneData, with_stop

# Of the budget for voxels, what normals may take besides.
SHARE = 1 / 32


def warm(data: SceneData) -> None:
    """Have the kernels compiled before anybody waits for them: a frame asks for normals only where it touches."""
    nowhere = data.arrays._replace(where=np.full_like(data.arrays.where, -1))
    find_voxel(data.broad.keys, nowhere.voxel_steps, 0, 0, 0)
    code_at(nowhere, 0, 0, 0, 0, 1, np.empty(0, np.uint16))
    stored_code_at(nowhere, 0, 0, 0, 0, data.keeps_scan)
    decode_normal(int(UNASKED) << 8 | 1)


class Normals:
    """The normals of one generation of an archive. Thread-safe.

    Those that the store has loaded (`Store.with_normals`) are looked up where somebody asks for their reach. What is
    estimated is kept, two bytes for each point of a voxel, from the first question about it until the voxel is
    evicted or others need the room: those asked first go first.
    used_bytes: of these.  most_bytes: their bound.  estimated: normals that were computed.  visits: tree nodes, of all.
    """

    def __init__(self, store: Store, data: SceneData, most_bytes: int | None = None) -> None:
        """Of the voxels of `store`, which `data` has in memory; both must stay open while this is asked.

        most_bytes: None: a 32nd of the budget for voxels. A voxel that takes more is asked, and nothing of it kept.
        """
        rows = store.archive.voxels
        self.most_bytes = int(data.residency.budget_bytes * SHARE) if most_bytes is None else most_bytes
        self.used_bytes = self.estimated = self.visits = 0
        # Kept for all requests: the stop of the one that asks first is not theirs.
        self._data, self._leaves = with_stop(data, NEVER), rows["leaves"]
        self._most_points = int(rows["rows"][:, 2].max(initial=0))
        self._origin = tuple(data.arrays.origin.tolist())
        self._codes: OrderedDict[tuple[int, int], NDArray[np.uint16]] = OrderedDict()
        self._evictions = 0
        self._squares: dict[float, int] = {}
        self._stored = -1
        if store.with_normals:
            self._stored = normal_reach(
                store.archive.header.normal_reach, data.arrays.step, self._most_points
            )

    def at(
        self, cloud: ArrayLike, toward: ArrayLike, reach: float, stop: Stop = NEVER
    ) -> NDArray[np.float64] | None:
        """Return the unit normal (3,) of the surface at a scan point, on the side that `toward` points to.

        cloud: (3,) the point, world [m], within half a lattice step.  toward: (3,) any length; where it lies in the
        surface or is 0 the side is as it comes.  reach: points so near the point make its surface [m].
        None: no point is there, or the points make no surface (schemas/kernels/normal_codes.py).
        stop: ends a wait for a
        load. Raises BadRequestError for a reach that is none, CorruptError for a voxel that cannot be read,
        StoppedError.
        """
        code = self.code(cloud, reach, stop)
        if code == NONE:
            return None
        x, y, z = decode_normal(code)
        a, b, c = (float(t) for t in np.asarray(toward))
        side = -1.0 if x * a + y * b + z * c < 0.0 else 1.0
        return np.array([side * x, side * y, side * z])

    def code(self, cloud: ArrayLike, reach: float, stop: Stop = NEVER) -> int:
        """Return the code of the normal, as schemas/kernels/normal_codes.py has it; NONE for none.

        stop: ends a wait for a load. Raises CorruptError, and StoppedError.
        """
        square = self._squares.get(reach)
        if square is None:
            square = normal_reach(reach, self._data.arrays.step, self._most_points)
            self._squares[reach] = square
        step = self._data.arrays.step
        place = np.asarray(cloud, np.float64).tolist()
        # Lattice.to_lattice without arrays: both round half to even.
        x, y, z = (round((c - o) / step) for c, o in zip(place, self._origin, strict=True))
        row = find_voxel(self._data.broad.keys, self._data.arrays.voxel_steps, x, y, z)
        if row < 0:
            return int(NONE)
        residency = self._data.residency
        with residency.still():
            if self._data.arrays.where[row, 0] >= 0:
                residency.use([row])
                return self._look(row, x, y, z, square)
        with residency.hold([row], stop=stop) as held:
            if held.late:
                raise StoppedError
            if held.faults:
                raise CorruptError(held.faults[0])
            with residency.still():
                return self._look(row, x, y, z, square)

    def _look(self, row: int, x: int, y: int, z: int, square: int) -> int:
        """`code` of a lattice point in a resident voxel, which stays."""
        if square == self._stored:
            found, visits = stored_code_at(self._data.arrays, row, x, y, z, self._data.keeps_scan)
            self.visits += int(visits)
            return int(found)
        self._drop_evicted()
        codes = self._codes.get((row, square))
        if codes is None:
            codes = self._make(row, square)
        code, visits, fresh = code_at(self._data.arrays, row, x, y, z, square, codes)
        self.visits += int(visits)
        self.estimated += int(fresh)
        return int(code)

    def _drop_evicted(self) -> None:
        """Forget what is known of voxels that are not resident any more."""
        residency = self._data.residency
        if residency.evictions == self._evictions:
            return
        self._evictions = residency.evictions
        for key in [key for key in self._codes if not residency.is_resident(key[0])]:
            self._drop(key)

    def _drop(self, key: tuple[int, int]) -> None:
        self.used_bytes -= self._codes.pop(key).nbytes

    def _make(self, row: int, square: int) -> NDArray[np.uint16]:
        """Room for the codes of a voxel, of which none is known; others go for it. None where it takes too much."""
        points = int(self._leaves[row]) * LANES
        if points * UNASKED.itemsize > self.most_bytes:
            return np.empty(0, np.uint16)
        codes = np.full(points, UNASKED)
        while self.used_bytes + codes.nbytes > self.most_bytes:
            self._drop(next(iter(self._codes)))
        self._codes[row, square] = codes
        self.used_bytes += codes.nbytes
        return codes
