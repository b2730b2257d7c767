"""Voxels in reach by their cells alone: their records are read before anything is said to be clear.

By the index such a voxel is out of reach. If its record proves the index (proof.py) it is not looked at, and every
answer and every count of work is what the index alone would have given. If the record cannot be read, the voxel stays
in reach, and is missing there. So a voxel costs one load more in all, where nothing ever comes near its points.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from .avatar import AvatarModel
from .effort import Effort
from .kernels.reach import Reach
from .request import SceneData, check_request
from .spent import Spent


def prove(data: SceneData, rows: Sequence[int], effort: Effort, spent: Spent) -> None:
    """Load the voxels of distinct rows, as many at a time as fit, until the effort's time is up.

    They are not kept for the request. What it takes is added to `spent`; what is late the request will find out.
    """
    residency = data.residency
    budget = int(residency.buffer.total_bytes * effort.share)
    part: list[int] = []
    for row in [*rows, -1]:
        if part and (row < 0 or residency.bytes_of([*part, row]) > budget):
            if effort.spent:
                return
            with residency.hold(part, effort.loads_until(), scan=True, stop=effort.stop) as held:
                pass
            spent.add(held._replace(late=()))
            part = []
        part.append(row)


def find_proved_reach(
    data: SceneData,
    avatar: AvatarModel,
    poses: NDArray[np.float64],
    other_units: int,
    effort: Effort,
    spent: Spent,
    settled: Callable[[Reach], Reach] = lambda reach: reach,
) -> Reach:
    """`check_request`, where voxels are in reach by their points' boxes, or cannot be read.

    settled: leaves out of a reach what need not be looked at. Raises as `check_request`.
    """
    left = data.bounds.left
    reach = settled(check_request(data, avatar, poses, other_units))
    doubted = data.bounds.doubted(reach, left)
    if not doubted:
        return reach
    prove(data, [row for row in doubted if not data.bounds.proved[row]], effort, spent)
    reach = settled(check_request(data, avatar, poses, other_units))
    spent.loaded += len(np.intersect1d(doubted, reach.rows[: reach.starts[-1]]))
    return reach
