"""Division of voxels into work units that keep all jobs busy to the end, and their execution."""

from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from .executor import Executor, Result, Unit
from .progress import Progress

# Units per job: the last units to finish are small compared with the whole.
_UNITS_A_JOB = 8
# Least points of a unit: fewer are not worth opening the archive again.
_LEAST_POINTS = 1 << 20


def portions(points: NDArray[np.int64], jobs: int) -> list[range]:
    """Cut rows, of `points` points each, into ranges of similar numbers of points, largest first.

    A range exceeds the planned size by at most one row. Which rows are in which range depends on
    `jobs`; results must not.
    """
    if not len(points):
        return []
    ends = np.cumsum(points)
    planned = max(_LEAST_POINTS, int(ends[-1]) // (_UNITS_A_JOB * jobs))
    starts = np.flatnonzero(np.diff((ends - points) // planned, prepend=-1))
    cuts = [*starts.tolist(), len(points)]
    runs = [range(a, b) for a, b in pairwise(cuts)]
    return sorted(runs, key=lambda run: -int(points[run.start : run.stop].sum()))


def jobs_of(executor: Executor | None) -> int:
    """Return the number of units that run at a time."""
    return executor.jobs if executor else 1


def run_units(
    executor: Executor | None,
    function: Callable[[Unit], Result],
    units: Sequence[Unit],
    progress: Progress,
    size: Callable[[Unit], int],
) -> Iterator[Result]:
    """Yield the results of `Executor.map`; without an executor run the units in this process."""
    if executor:
        yield from executor.map(function, units, progress, size)
        return
    for unit in units:
        yield function(unit)
        progress.advance(size(unit))
