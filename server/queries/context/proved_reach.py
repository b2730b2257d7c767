"""Proof of the index before an answer relies on it, by loading voxels in reach by their cells only.

By its box in the index such a voxel is out of reach. If its record agrees with the index
(index_proof.py), the voxel is not examined, and every answer and work count is that of the index.
If the record cannot be read, the voxel stays in reach and is missing. Each voxel therefore costs at
most one additional load, even if nothing comes near its points.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from ...avatars.avatar_model import AvatarModel
from ...kernels.core.voxels_in_reach import Reach
from .query_budget import Effort
from .query_context import SceneData, check_request, distinct_rows
from .query_cost import Spent


def prove(data: SceneData, rows: Sequence[int], effort: Effort, spent: Spent) -> None:
    """Load voxels of distinct rows in order, as many at a time as fit, within the effort's time.

    The voxels are not held afterwards. Add the cost to `spent`, without late voxels: the request
    finds those itself.
    """
    residency = data.residency
    for part in residency.parts_that_fit(rows, int(residency.buffer.total_bytes * effort.share)):
        if effort.spent:
            return
        with residency.hold(part, effort.loads_until(), scan=True, stop=effort.stop) as held:
            pass
        spent.add(held._replace(late=()))


def find_proved_reach(
    data: SceneData,
    avatar: AvatarModel,
    poses: NDArray[np.float64],
    other_units: int,
    effort: Effort,
    spent: Spent,
    settled: Callable[[Reach], Reach] = lambda reach: reach,
) -> Reach:
    """Return the reach of poses (k, 4, 4) with only voxels that are proved or unreadable.

    Otherwise the same as `check_request`, errors included.
    settled: removes pairs that need not be examined from a reach.
    """
    bounds, stop = data.bounds, effort.stop
    unproved = bounds.unproved
    reach = settled(check_request(data, avatar, poses, other_units))
    doubted = bounds.rows_to_prove(reach, unproved, stop)
    if not doubted:
        return reach
    likely = _likely(data, reach, doubted, effort)
    prove(data, [*likely, *(row for row in doubted if not bounds.proved[row])], effort, spent)
    reach = settled(check_request(data, avatar, poses, other_units))
    left = distinct_rows(reach.rows[: reach.starts[-1]], len(bounds.proved), stop)
    loaded = [*doubted, *(row for row in likely if data.residency.is_resident(row))]
    spent.loaded += len(np.intersect1d(loaded, left))
    return reach


def _likely(data: SceneData, reach: Reach, doubted: list[int], effort: Effort) -> list[int]:
    """Return the rows to load before doubted ones: with a deadline, those in reach by the index.

    Proofs may take half of the time, and voxels that are likely to be touched matter more. If the
    likely voxels do not fit together, return none: they are loaded later, piece by piece.
    """
    if effort.deadline == np.inf:
        return []
    residency = data.residency
    rows = distinct_rows(reach.rows[: reach.starts[-1]], len(data.bounds.proved), effort.stop)
    if residency.bytes_of(rows.tolist()) > residency.buffer.total_bytes * effort.share:
        return []
    likely: list[int] = np.setdiff1d(rows, doubted, assume_unique=True).tolist()
    return [row for row in likely if not residency.is_resident(row)]
