"""Cuts voxels into work units that keep all jobs busy to the end, and runs them."""

from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from .executor import Executor, Result, Unit
from .progress import Progress

# Units a job: the last ones to end are small beside all.
_UNITS_A_JOB = 8
# Fewer points than this are no work: a unit opens the archive anew.
_LEAST_POINTS = 1 << 20


def portions(points: NDArray[np.int64], jobs: int) -> list[range]:
    """Cut rows of so many points each into runs of about as many points, those with the most first.

    A run is longer than planned by one row at most. Which rows are in one depends on `jobs`: results must not.
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
    """How many units run at a time."""
    return executor.jobs if executor else 1


def run_units(
    executor: Executor | None,
    function: Callable[[Unit], Result],
    units: Sequence[Unit],
    progress: Progress,
    size: Callable[[Unit], int],
) -> Iterator[Result]:
    """`Executor.map`; in this process where there is none."""
    if executor:
        yield from executor.map(function, units, progress, size)
        return
    for unit in units:
        yield function(unit)
        progress.advance(size(unit))
