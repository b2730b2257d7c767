"""Separation of each scan of an archive from an avatar under one pose, to estimate scan noise."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..avatars.avatar_model import AvatarModel
from ..kernels.contacts.contact_cells import BY_SCAN, CELLS, DEFICIT, PLACE, SQUARE, ContactOptions
from ..kernels.contacts.contact_pairs import ContactResults, gather_contacts
from ..kernels.core.reach import VoxelLists
from .collide import drop_clear_of
from .contacts import MAX_BYTES, MAX_CELLS, empty_memory
from .distance import signed_from_square
from .level_of_detail import find_level
from .request import EXACT, CostCounter, QueryBudget, check_request, kernel_poses, unseen_from
from .resolve import resolve, run
from .scene_data import SceneData, to_units, with_stop

# Key of points whose scan is not stored, or whose number belongs to no scan.
ANY_SCAN = -1


class ScanSeparations(NamedTuple):
    """Separation of each scan from an avatar.

    separations: least signed one [m] of each scan within the margin, by its row in
    `SceneInfo.sources`.
    exact: whether everything in reach was examined.  node_visits, point_tests: cost.
    """

    separations: dict[int, float]
    exact: bool
    node_visits: int = 0
    point_tests: int = 0


def separation_per_scan(
    data: SceneData,
    avatar: AvatarModel,
    pose: ArrayLike,
    margin: float,
    scans: int,
    budget: QueryBudget = EXACT,
) -> ScanSeparations:
    """Compute the least signed separation of every scan from the avatar under a pose (4, 4).

    Scans farther than `margin` [m] are omitted.
    data: of an archive that keeps the scan of each point.  scans: their number.
    The pairs are those that `contacts` finds with this margin, and the separation of a scan is that
    of its deepest pair. A point whose number belongs to no scan counts as ANY_SCAN.
    budget: a deadline may leave pairs out; `exact` is then false.
    Raise BadRequestError, BadTransformError, TooLargeError.
    """
    spent, margin_units = CostCounter(data), to_units(margin, "margin")
    poses = kernel_poses(np.asarray(pose)[None])
    reach = check_request(data, avatar, poses, data.radius_units + margin_units)
    if not len(avatar.points):
        return ScanSeparations({}, True)
    tally = ContactResults(np.zeros((3, 1), np.int64), np.zeros(1, np.int64), np.zeros((1, 4), np.int64))
    options = ContactOptions(avatar.rows, np.full(1, BY_SCAN), True, 0, MAX_CELLS, MAX_BYTES)
    memory, arrays = empty_memory(0), with_stop(data, budget.stop).arrays

    def search(lists: VoxelLists, *state: NDArray[Any]) -> None:
        nonlocal memory
        own = reach._replace(lists=lists)
        memory = gather_contacts(poses, avatar.arrays, arrays, own, *state, options, memory, tally)

    settle = drop_clear_of(find_level(data, budget), avatar, poses, margin_units, budget, spent)
    left = run(resolve(data, reach.lists, search, budget, spent, settle))
    missing, visits, tests = tally.counts[:, 0].tolist()
    exact = missing == 0 and min(left[0], unseen_from(data, reach)[0]) == np.inf
    cells = memory.cells.table[: memory.sizes[CELLS]]
    numbers = np.where(cells[:, PLACE] < scans, cells[:, PLACE], ANY_SCAN)
    gaps = signed_from_square(cells[:, SQUARE], reach.units[0] - margin_units - cells[:, DEFICIT])
    separations = {n: float(gaps[numbers == n].min()) for n in np.unique(numbers).tolist()}
    return ScanSeparations(separations, bool(exact), visits, tests)
