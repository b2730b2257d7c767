"""Query `contacts`: pairs of spheres in contact, the deepest listed, all gathered into clusters.

It serves clash detection: it returns where and how deep two bodies touch, and at how many places.
`collide` only returns whether they touch.
"""

import operator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...schemas.archive.units import UNITS_PER_METRE
from ...schemas.errors import TooLargeError
from ...schemas.wire.answers import ContactsAnswers, Verdict
from ...schemas.wire.request_limits import MAX_CONTACTS
from ...schemas.wire.requests import check_integer
from ..avatars.avatar_model import AvatarModel
from ..kernels.contacts import contact_cells as cells
from ..kernels.contacts.contact_cells import POSE, ContactOptions, ContactState, list_pose, make_cells
from ..kernels.contacts.contact_pairs import ContactResults, gather_contacts
from ..kernels.core.node_bounds import STACK
from ..kernels.core.reach import VoxelLists, VoxelsInReach
from ..kernels.core.scene_arrays import LANES
from ..runtime.stop_flag import NO_STOP
from .collide import drop_clear_of
from .distance import signed_from_square
from .level_of_detail import find_level
from .load_and_search import Slices, answered, resolve, run
from .query_inputs import EXACT, PoseQuery, QueryBudget, SceneData, make_query, to_units, to_world

# Limit on the pairs and clusters listed by one request, over all poses [bytes]. Converting them to
# columns temporarily takes some three times as much. The wire's largest message holds an eighth.
MAX_BYTES = 256 << 20
# Initial capacity in cells, a power of two and at least LANES. A kernel doubles it as needed, up to
# MAX_CELLS, which take 200 MB.
FIRST_CELLS, MAX_CELLS = 256, 1 << 20
# Key of points whose scan is not stored, or whose number belongs to no scan.
ANY_SCAN = -1


def contacts_slices(
    data: SceneData,
    avatar: AvatarModel,
    poses: ArrayLike,
    limit: int = 100,
    margin: float = 0.0,
    cluster_distance: float | None = None,
    budget: QueryBudget = EXACT,
) -> Slices[ContactsAnswers]:
    """Find all pairs in contact under each pose: count them, list the deepest, and cluster them.

    poses, margin: as for `collide`.
    limit: number of deepest pairs listed a pose, 0 to MAX_CONTACTS; all pairs are counted.
    cluster_distance: edge of the grid cells that touched scan points fall in [m], rounded up to
    whole lattice steps, at least one. Cells lie on multiples of it from the dataset's origin. None:
    twice r_a + r_b + margin, with r_b of the largest sphere of the radius model. Touched cells that
    share a face, an edge or a corner form one cluster: points at most this far apart are always in
    one cluster, and points of two clusters are farther apart than it along an axis.

    The deepest pair has the least |a - b| - r_a - r_b, with r_b of the scan point's own sphere,
    compared exactly and not by the rounded figure. Each of several coincident points forms a pair.
    Ties are ordered by scan point, avatar centre, avatar row, scan number.
    budget: a deadline may leave pairs out; `exact` is then false, the pairs counted are the least
    number, and the listed ones are in contact but may not be the deepest. The level of detail may prove
    a pose clear of voxels that are absent (`find_level`). Pairs are counted exactly whatever the
    tolerance, because a count cannot end early (DESIGN.md, "Tolerance").
    The verdict is CONTACT if a pair was found; otherwise CLEAR, or UNKNOWN if not everything in
    reach was examined. Raise BadRequestError, BadTransformError, TooLargeError.
    """
    check_integer("limit", limit, MAX_CONTACTS)
    limit, margin_units = operator.index(limit), to_units(margin, "margin")
    edge_units = None if cluster_distance is None else to_units(cluster_distance, "cluster_distance")
    query = make_query(data, avatar, poses, margin_units, budget)
    edges = _edges(query.around, edge_units, data.arrays.units_per_step)
    memory, tally, left = yield from _gather(query, edges, limit, keeps_scan=data.keeps_scan)
    # A stop may leave a pose without its lists.
    finished = (left == np.inf) & ((tally.pairs == 0) | (tally.runs[:, 3] > 0))
    if memory.sizes[POSE] >= 0:  # what was found of the pose in hand
        memory = list_pose(memory, tally.runs[memory.sizes[POSE]], NO_STOP.flag)
    exact = finished & (tally.counts[0] == 0) & (query.unseen == np.inf)
    verdict = np.where(exact, Verdict.CLEAR, Verdict.UNKNOWN)
    verdict[tally.pairs > 0] = Verdict.CONTACT
    pair_starts, pairs = _by_pose(memory.pairs, tally.runs[:, :2])
    cluster_starts, clusters = _by_pose(memory.clusters, tally.runs[:, 2:])
    avatar_point, cloud_point, signed = _places(data, pairs, np.repeat(query.radii, np.diff(pair_starts)))
    cluster_avatar, cluster_cloud, deepest = _places(
        data, clusters, np.repeat(query.radii, np.diff(cluster_starts))
    )
    missing, visits, tests = np.minimum(tally.counts, np.iinfo(np.uint32).max).astype(np.uint32)
    return ContactsAnswers(
        verdict=verdict.astype(np.uint8), exact=exact, pairs_found=tally.pairs,
        pair_starts=pair_starts, avatar_point=avatar_point, cloud_point=cloud_point, signed_distance=signed,
        avatar_index=pairs[:, cells.ROW].astype(np.int32), scan_index=pairs[:, cells.SCAN].astype(np.int32),
        cluster=pairs[:, cells.TAG].astype(np.int32),
        cluster_starts=cluster_starts, cluster_count=clusters[:, cells.PAIRS].copy(), cluster_deepest=deepest,
        cluster_avatar=cluster_avatar, cluster_cloud=cluster_cloud,
        cluster_scan=clusters[:, cells.SCAN].astype(np.int32),
        cluster_low=to_world(data, clusters[:, cells.LOW : cells.LOW + 3]),
        cluster_high=to_world(data, clusters[:, cells.HIGH : cells.HIGH + 3]),
        outside=query.around.outside, voxels_missing=missing, node_visits=visits, point_tests=tests,
        **query.spent.fields(),
    )  # fmt: skip


contacts = answered(contacts_slices)


def _gather(
    query: PoseQuery, edges: NDArray[np.int64], limit: int, *, keeps_scan: bool
) -> Slices[tuple[ContactState, ContactResults, NDArray[np.float64]]]:
    """Find the pairs in contact, gathered by cell or by scan.

    edges: (k,) of a cell [steps], or BY_SCAN.  limit: of the pairs listed a pose.
    Return the memory of the search, its results, and what `resolve` returns.
    """
    k = len(query.poses)
    tally = ContactResults(np.zeros((3, k), np.int64), np.zeros(k, np.int64), np.zeros((k, 4), np.int64))
    memory = ContactState(
        make_cells(FIRST_CELLS), np.empty((limit, cells.RECORD), np.int64),
        np.array([0, 0, 0, 0, -1, 0, -1]), np.empty((STACK, 2), np.int64), np.empty((0, cells.RECORD), np.int64),
        np.empty((0, cells.CLUSTER), np.int64),
    )  # fmt: skip
    options = ContactOptions(query.avatar.rows, edges, keeps_scan, limit, MAX_CELLS, MAX_BYTES)

    def search(lists: VoxelLists, *state: NDArray[Any]) -> None:
        nonlocal memory
        own, arrays = query.around._replace(lists=lists), query.data.arrays
        memory = gather_contacts(
            query.poses, query.avatar.arrays, arrays, own, *state, options, memory, tally
        )
        _check_room(memory)

    settle = drop_clear_of(find_level(query.data, query.budget), query)
    left = yield from resolve(
        query.data, query.around.lists, search, query.budget, query.spent, settle, together=True
    )
    return memory, tally, left


def _edges(reach: VoxelsInReach, edge_units: int | None, units_per_step: float) -> NDArray[np.int64]:
    """Return the edge (k,) of a cell under each pose [steps].

    reach: its units are those of the largest sphere.
    """
    units = 2 * reach.units if edge_units is None else np.full(len(reach.units), edge_units)
    steps = units / units_per_step
    whole = np.rint(steps)
    # A distance that differs from a whole number of steps only by rounding is that number.
    steps = np.where(np.abs(steps - whole) <= 1e-9 * whole + 1.0 / units_per_step, whole, np.ceil(steps))
    return np.asarray(np.maximum(steps, 1.0).astype(np.int64))


def _check_room(memory: ContactState) -> None:
    """Raise TooLargeError if the lists or the cells touched by a pose exceed their limits."""
    if memory.sizes[cells.CELLS] + LANES > MAX_CELLS:
        raise TooLargeError(
            f"a pose touches {memory.sizes[cells.CELLS]} cells or more: at most {MAX_CELLS - LANES}: ask for "
            "a larger cluster_distance"
        )
    pairs, clusters = int(memory.sizes[cells.LISTED]), int(memory.sizes[cells.CLUSTERS])
    if 8 * (pairs * cells.RECORD + clusters * cells.CLUSTER) > MAX_BYTES:
        raise TooLargeError(
            f"{pairs} pairs and {clusters} clusters listed, more than the {MAX_BYTES >> 20} MiB of a request: ask for "
            "fewer poses, a smaller limit or a larger cluster_distance"
        )


def _by_pose(rows: NDArray[np.int64], runs: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Join the rows of each pose's run (k, 2), first and count; return starts (k + 1,) and rows."""
    starts = np.concatenate([[0], np.cumsum(runs[:, 1])])
    taken = np.arange(starts[-1]) + np.repeat(runs[:, 0] - starts[:-1], runs[:, 1])
    return starts, rows[taken]


def _places(
    data: SceneData, records: NDArray[np.int64], radii: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return avatar centres and scan points (n, 3), world [m], and signed distances (n,) [m].

    records: of pairs.  radii: (n,) int64, r_a + r_b with r_b of the largest sphere, exact units.
    """
    avatar = records[:, cells.CENTER : cells.CENTER + 3] / UNITS_PER_METRE + data.arrays.origin
    return (
        avatar,
        to_world(data, records[:, cells.POINT : cells.POINT + 3]),
        signed_from_square(records[:, cells.SQUARE], radii - records[:, cells.DEFICIT]),
    )


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
    margin_units = to_units(margin, "margin")
    query = make_query(data, avatar, np.asarray(pose)[None], margin_units, budget)
    memory, tally, left = run(_gather(query, np.full(1, cells.BY_SCAN), 0, keeps_scan=True))
    missing, visits, tests = tally.counts[:, 0].tolist()
    exact = missing == 0 and min(left[0], query.unseen[0]) == np.inf
    table = memory.cells.table[: memory.sizes[cells.CELLS]]
    numbers = np.where(table[:, cells.PLACE] < scans, table[:, cells.PLACE], ANY_SCAN)
    gaps = signed_from_square(table[:, cells.SQUARE], query.radii[0] - table[:, cells.DEFICIT])
    separations = {n: float(gaps[numbers == n].min()) for n in np.unique(numbers).tolist()}
    return ScanSeparations(separations, bool(exact), visits, tests)
