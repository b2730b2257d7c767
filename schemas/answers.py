"""What a question is answered with: a struct of arrays, one element a pose.

No zenoh, no numba and no wire encoding here: `Scene` makes these, `Client` receives them, and both hand
out the same types.
"""

from collections.abc import Iterator
from enum import IntEnum
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray


class Verdict(IntEnum):
    """What is said of one pose. `CLEAR` only when all in reach was looked at (NUMERICS.md case 21)."""

    CLEAR = 0
    CONTACT = 1
    UNKNOWN = 2


class CollideAnswer(NamedTuple):
    """The answer for one pose; see `CollideAnswers` for the fields."""

    verdict: Verdict
    outside: bool
    voxels_missing: int
    node_visits: int
    point_tests: int


class CollideAnswers(msgspec.Struct, frozen=True, eq=False):
    """The answers for k poses, in the order of the poses. Iterating yields one `CollideAnswer` a pose.

    verdict: (k,) uint8, values of `Verdict`.  outside: (k,) bool, the reach leaves the dataset's bounds.
    voxels_missing: (k,) uint32, voxels in reach that could not be looked at.
    node_visits: (k,) uint32, pairs of bounding spheres tested.  point_tests: (k,) uint32, pairs of points.
    engine_seconds: time between request and answer inside the engine, loads included [s].
    hits, misses: voxels in reach that were resident, and that had to be loaded, of this request.
    resident, resident_bytes: voxels decoded in memory after this request, and their bytes.
    faults: one sentence for each voxel that could not be read, where and why; empty when all is well.
    """

    verdict: NDArray[np.uint8]
    outside: NDArray[np.bool_]
    voxels_missing: NDArray[np.uint32]
    node_visits: NDArray[np.uint32]
    point_tests: NDArray[np.uint32]
    engine_seconds: float = 0.0
    hits: int = 0
    misses: int = 0
    resident: int = 0
    resident_bytes: int = 0
    faults: tuple[str, ...] = ()

    def __len__(self) -> int:
        """The number of poses answered."""
        return len(self.verdict)

    def __iter__(self) -> Iterator[CollideAnswer]:
        """One answer a pose, in order."""
        columns = (self.verdict, self.outside, self.voxels_missing, self.node_visits, self.point_tests)
        for verdict, outside, missing, visits, tests in zip(*columns, strict=True):
            yield CollideAnswer(Verdict(int(verdict)), bool(outside), int(missing), int(visits), int(tests))


def unknown_answers(k: int) -> CollideAnswers:
    """The answers for k poses when nobody answered: all `UNKNOWN`, nothing looked at."""
    zeros = np.zeros(k, np.uint32)
    verdict = np.full(k, Verdict.UNKNOWN, np.uint8)
    return CollideAnswers(verdict, np.zeros(k, bool), zeros, zeros.copy(), zeros.copy())
