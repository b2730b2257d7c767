"""Surface normals at scan points, and how high the points around lie; for the effects slide and ground.

They are estimated one point at a time from the points within reach, which may lie in several voxels:
each takes some microseconds, and a frame needs a few of them.
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...schemas.archive.archive import Archive
from ...schemas.errors import BadRequestError, CorruptError
from ..kernels.core.normal_codes import NO_NORMAL, SUMS, decode_normal, normal_code, squared_reach
from ..kernels.rays.surface import add_near, voxels_near
from ..runtime.stop_flag import NO_STOP, StopFlag, StoppedError
from .load_and_search import parts_that_fit
from .query_inputs import SceneData

_NO_DIRECTIONS = np.empty((0, 3))


class Normals:
    """Normals of one generation of an archive. Thread-safe."""

    def __init__(self, data: SceneData, archive: Archive) -> None:
        """Make the normals of an archive, which `data` holds in memory.

        Both must stay open while this object is used.
        """
        self._data, self._lattice = data, archive.header.lattice
        self._held = data.references.to(data.arrays, data.tree)
        self._points = archive.header.points, int(archive.voxels["rows"][:, 2].max(initial=0))
        self._squares: dict[float, int] = {}
        self._all_squares: dict[tuple[float, ...], NDArray[np.int64]] = {}

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

        Return None if the points form no surface (kernels/core/normal_codes.py).
        cloud: (3,) the point, world [m], within half a lattice step.
        toward: (3,) any length; if it is 0 or lies in the surface, the side is arbitrary.
        reach: points within this distance of the point form its surface [m].
        stop: ends a wait for a load.  waits: if False, load no voxel.
        Raise BadRequestError for an invalid reach, CorruptError for an unreadable voxel within reach,
        StoppedError, also for a voxel within reach that is not in memory if it may not be loaded.
        """
        sums, _ = self._add_near(cloud, _NO_DIRECTIONS, reach, stop, waits=waits)
        code = normal_code(sums)
        if code == NO_NORMAL:
            return None
        x, y, z = decode_normal(code)
        a, b, c = (float(t) for t in np.asarray(toward))
        side = -1.0 if x * a + y * b + z * c < 0.0 else 1.0
        return np.array([side * x, side * y, side * z])

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

        The points are those that form its surface.
        directions: (k, 3) unit. Other arguments and errors as for `at`.
        """
        _, heights = self._add_near(cloud, np.ascontiguousarray(directions), reach, stop, waits=waits)
        return heights * self._lattice.step

    def squares(self, reaches: tuple[float, ...]) -> NDArray[np.int64]:
        """Return the squares of reaches [steps^2], 0 for an invalid one."""
        found = self._all_squares.get(reaches)
        if found is None:
            squares = []
            for reach in reaches:
                try:
                    squares.append(self._square(reach))
                except BadRequestError:
                    squares.append(0)
            found = self._all_squares[reaches] = np.array(squares, np.int64)
        return found

    def _square(self, reach: float) -> int:
        """Return the square of a reach [steps^2]. Raise BadRequestError."""
        square = self._squares.get(reach)
        if square is None:
            step, (points, most) = self._lattice.step, self._points
            # A cube around the reach meets so many voxels along each axis.
            across = 2 + int(2.0 * reach / (step * self._lattice.voxel_steps)) if reach > 0 else 0
            square = self._squares[reach] = squared_reach(reach, step, min(points, across**3 * most))
        return square

    def _add_near(
        self, cloud: ArrayLike, directions: NDArray[np.float64], reach: float, stop: StopFlag, *, waits: bool
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return the sums of the points within reach, and their heights (k,) [steps].

        Sums and heights add up over the voxels. Voxels that do not fit in the cache together are
        therefore held one part after the other.
        """
        square, data, held = self._square(reach), self._data, self._held
        place = self._lattice.to_lattice(np.asarray(cloud, np.float64)).tolist()
        rows = np.empty(64, np.int64)
        needed = held.call(voxels_near, held.reference, *place, square, rows)
        if needed > len(rows):
            rows = np.empty(needed, np.int64)
            needed = held.call(voxels_near, held.reference, *place, square, rows)
        sums, heights = np.zeros(SUMS, np.int64), np.zeros(len(directions))
        residency, until = data.residency, math.inf if waits else -math.inf
        for part in parts_that_fit(residency, rows[:needed].tolist(), residency.buffer.total_bytes):
            with residency.hold(part, until, stop=stop) as found:
                if found.late:
                    raise StoppedError
                if found.faults:
                    raise CorruptError(found.faults[0])
                voxels = np.array(part, np.int64)
                held.call(add_near, held.reference, voxels, *place, square, sums, directions, heights)
        return sums, heights
