"""Belady's optimum: the least number of loads of any eviction order, with knowledge of the future.

L. A. Belady, "A study of replacement algorithms for a virtual-storage computer", IBM Systems
Journal 5 (1966): evict what is used again last. This is optimal where all voxels have one size; the
optimum is therefore counted in voxels.
"""

import heapq

import numpy as np
from numpy.typing import NDArray


def next_uses(rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return for each of n references the number of the next one of the same row.

    A reference without a next one gets a distinct number of at least n.
    """
    n = len(rows)
    order = np.argsort(rows, kind="stable")
    following = n + np.arange(n)
    same = rows[order[1:]] == rows[order[:-1]]
    following[order[:-1][same]] = order[1:][same]
    return following


def optimum(rows: NDArray[np.int64], capacity: int) -> NDArray[np.bool_]:
    """Return which references (n,) are misses, as few as possible in total.

    capacity: number of voxels that may be resident, at least 1.
    References are processed one after another, also those of one request, and each row is loaded
    when it is missed. For a cache that must hold all rows of a request at once this is a lower
    bound.
    """
    missed = np.zeros(len(rows), bool)
    resident: dict[int, int] = {}  # row -> its next use
    latest: list[tuple[int, int]] = []  # (-next use, row); outdated where `resident` differs
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
