"""Belady's optimum: the fewest loads any order of eviction can do with, for who knows the future.

L. A. Belady, "A study of replacement algorithms for a virtual-storage computer", IBM Systems Journal 5 (1966): what is
used again last goes first. That is the optimum where all voxels are one size, so it is counted in voxels.
"""

import heapq

import numpy as np
from numpy.typing import NDArray


def next_uses(rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """For each of n references the number of the next one of the same row; n and more, all different, where none is."""
    n = len(rows)
    order = np.argsort(rows, kind="stable")
    following = n + np.arange(n)
    same = rows[order[1:]] == rows[order[:-1]]
    following[order[:-1][same]] = order[1:][same]
    return following


def optimum(rows: NDArray[np.int64], capacity: int) -> NDArray[np.bool_]:
    """Which of the references (n,) are misses when `capacity` voxels may be resident, as few as possible in all.

    References are taken one after another, also those of one request, and each row is loaded when it is missed. To a
    cache that must hold all rows of a request at once this is a bound from below. capacity: at least 1.
    """
    missed = np.zeros(len(rows), bool)
    resident: dict[int, int] = {}  # row -> its next use
    latest: list[tuple[int, int]] = []  # (-next use, row); out of date where `resident` says otherwise
    for number, (row, following) in enumerate(zip(rows.tolist(), next_uses(rows).tolist(), strict=True)):
        if row not in resident:
            missed[number] = True
            if len(resident) == capacity:
                while True:
                    use, victim = heapq.heappop(latest)
                    if resident.get(victim) == -use:
                        break
                del resident[victim]
        resident[row] = following
        heapq.heappush(latest, (-following, row))
    return missed
