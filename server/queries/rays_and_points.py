"""Queries `raycast` and `within`: the first sphere that a ray hits, the scan point nearest to a point."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...schemas.archive.units import UNITS_PER_METRE
from ...schemas.archive.voxel_grid import MAX_COORDINATE
from ...schemas.errors import BadRequestError
from ...schemas.wire.answers import RaycastAnswers, Verdict, WithinAnswers
from ...schemas.wire.requests import make_vectors
from ..kernels.core.placed_avatar import MAX_REACH_UNITS
from ..kernels.core.reach import Items, VoxelLists, find_lists
from ..kernels.rays.hits import ClosestHits, HitBatch, search_hits
from .load_and_search import CostCounter, Steps, drop_items, resolve, run
from .query_inputs import EXACT, QueryBudget, SceneData, to_units, with_stop

# Rays or points whose lists are in memory at a time.
BATCH = 1 << 14
# Differences within this reach [m] are exact in float64: 2^53 units are 134,000 km.
MAX_RAY_REACH = 1e6


def make_directions(values: ArrayLike) -> NDArray[np.float64]:
    """Normalize vectors (k, 3) in float64.

    Each is divided by its largest component, then by the square root of (x x + y y) + z z. Raise
    BadRequestError for a vector that is zero or not finite.
    """
    array = make_vectors(values, "directions")
    largest = np.abs(array).max(axis=1, initial=0.0)
    if (largest == 0.0).any():
        raise BadRequestError(f"direction {int(np.argmin(largest))} is zero: expected a vector of any length")
    scaled = array / largest[:, None]
    x, y, z = scaled.T
    return np.ascontiguousarray(scaled / np.sqrt((x * x + y * y) + z * z)[:, None])


def raycast(
    data: SceneData, origins: ArrayLike, directions: ArrayLike, reach: float, budget: QueryBudget = EXACT
) -> RaycastAnswers:
    """Answer `raycast`; see `raycast_steps`."""
    return run(raycast_steps(data, origins, directions, reach, budget))


def raycast_steps(
    data: SceneData, origins: ArrayLike, directions: ArrayLike, reach: float, budget: QueryBudget
) -> Steps[RaycastAnswers]:
    """Find the first sphere of the scan that each ray hits; the radius model gives each radius.

    origins: (k, 3) float64, world [m].  directions: (k, 3), of any length except zero.
    reach: length of the rays [m], at most MAX_RAY_REACH.
    kernels/rays/hits.py has the definition. A ray is `outside` if either of its ends, o or
    o + reach u in exact units, leaves the box of all scan points.
    The verdict is CONTACT if a sphere is hit, CLEAR if none is, and UNKNOWN if none was found but
    something in reach was not examined. If that could hide a nearer hit, `exact` is false and `lower`
    bounds its distance. Raise BadRequestError.
    """
    spent = CostCounter(data)
    world, units = make_origins(data, origins, "origins")
    unit = make_directions(directions)
    if len(world) != len(unit):
        raise BadRequestError(f"{len(world)} origins and {len(unit)} directions: expected equal numbers")
    if not 0 <= reach <= MAX_RAY_REACH:
        raise BadRequestError(f"reach {reach!r}: expected 0 to {MAX_RAY_REACH:g} metres")
    if data.radius_units > MAX_REACH_UNITS:
        raise BadRequestError("the scan's radius is over 16 m: rays cannot be tested exactly against it")
    reach_units = to_units(reach, "reach")
    hit: NDArray[np.float64] = np.full((len(world), 3), math.nan)
    normal: NDArray[np.float64] = np.full((len(world), 3), math.nan)

    def on_hits(which: NDArray[np.int64], best: ClosestHits) -> None:
        """Write origin + distance u, and the normal along t u - d, from the sphere's centre to the hit.

        It is opposite to the ray if these coincide.
        """
        t, u = best.value[:, None], unit[which]
        hit[which] = world[which] + (t / UNITS_PER_METRE) * u
        d = np.rint(best.lattice * data.arrays.units_per_step).astype(np.int64) - units[which]
        away = t * u - d
        length = np.sqrt((away * away).sum(axis=1))[:, None]
        normal[which] = np.where(length > 0, away / np.where(length > 0, length, 1.0), -u)

    outside = leaves_scene(data, units.astype(np.float64), units + float(reach_units) * unit)
    rays = HitBatch(units, unit, reach_units, data.radius_units)
    hits = yield from find_hits(data, rays, budget, spent, on_hits)
    return RaycastAnswers(
        hits.verdict, hits.distance, hits.lower, hits.distance.copy(), hits.exact, hit, hits.cloud, normal, outside,
        *hits.counts, **spent.fields(),
    )  # fmt: skip


def within(data: SceneData, points: ArrayLike, reach: float, budget: QueryBudget = EXACT) -> WithinAnswers:
    """Answer `within`; see `within_steps`."""
    return run(within_steps(data, points, reach, budget))


def within_steps(
    data: SceneData, points: ArrayLike, reach: float, budget: QueryBudget
) -> Steps[WithinAnswers]:
    """Find the scan point nearest to each of k query points, centre to centre, ignoring radii.

    points: (k, 3) float64, world [m].  reach: inclusive [m], at most 16.
    kernels/rays/hits.py has the definition. A point is `outside` if its reach, a cube of exact
    units, leaves the box of all scan points. Verdicts and bounds are as for `raycast`.
    Raise BadRequestError.
    """
    spent = CostCounter(data)
    _, units = make_origins(data, points, "points")
    reach_units = to_units(reach, "reach")
    if reach_units > MAX_REACH_UNITS:
        raise BadRequestError(f"reach {reach!r}: expected at most 16 m: larger squares do not fit in 63 bits")
    outside = leaves_scene(data, units - reach_units, units + reach_units)
    hits = yield from find_hits(data, HitBatch(units, np.empty((0, 3)), reach_units, 0), budget, spent)
    return WithinAnswers(
        hits.verdict, hits.distance, hits.lower, hits.distance.copy(), hits.exact, hits.cloud, outside,
        *hits.counts, **spent.fields(),
    )  # fmt: skip


class Hits(NamedTuple):
    """Answers about k rays or points.

    verdict: (k,) uint8. A hit remains a hit, whatever is missing.  distance: (k,) of the hit [m]; inf
    for none.  lower: (k,) of what may be there [m].  exact: (k,) bool, whether everything missing
    is farther away.  cloud: (k, 3) the scan point hit, world [m]; NaN for none.
    counts: (3, k) uint32, voxels missing, node visits, point tests.
    """

    verdict: NDArray[np.uint8]
    distance: NDArray[np.float64]
    lower: NDArray[np.float64]
    exact: NDArray[np.bool_]
    cloud: NDArray[np.float64]
    counts: NDArray[np.uint32]


def make_origins(
    data: SceneData, values: ArrayLike, what: str
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return world positions (k, 3) [m], and the same in exact units from the dataset's origin.

    Rounding is half to even. Raise BadRequestError for a position that is too far away.
    """
    array = make_vectors(values, what)
    if len(array) and np.abs(array).max() > MAX_COORDINATE:
        raise BadRequestError(f"{what} at {np.abs(array).max():g} m: expected within {MAX_COORDINATE:g} m")
    return array, np.rint((array - data.arrays.origin) * UNITS_PER_METRE).astype(np.int64)


def leaves_scene(data: SceneData, *places: NDArray[Any]) -> NDArray[np.bool_]:
    """Return which of k items have a place (k, 3), exact units, outside of the box of all scan points."""
    low, high = np.rint(data.tree.scene * data.arrays.units_per_step).astype(places[0].dtype)
    outside = np.zeros(len(places[0]), bool)
    for place in places:
        for r in range(3):  # `any` along rows of three takes longer
            outside |= (place[:, r] < low[r]) | (place[:, r] > high[r])
    return outside


def find_hits(
    data: SceneData,
    items: HitBatch,
    budget: QueryBudget,
    spent: CostCounter,
    on_hits: Callable[[NDArray[np.int64], ClosestHits], None] = lambda which, best: None,
) -> Steps[Hits]:
    """Find the first hits of k rays or the points nearest to k points, a batch at a time.

    on_hits: called with the numbers (n,) of items that hit something, and their results.
    Add the cost to `spent`. Once the request is stopped, no further batch is begun, and nothing is
    known about its items.
    """
    k, arrays = len(items.origin), with_stop(data, budget.stop).arrays
    hits = Hits(
        np.full(k, Verdict.UNKNOWN, np.uint8), np.full(k, math.inf), np.zeros(k), np.zeros(k, bool),
        np.full((k, 3), math.nan), np.zeros((3, k), np.uint32),
    )  # fmt: skip
    for begin in range(0, k, BATCH):
        if begin and budget.stop:
            break
        rows = slice(begin, begin + BATCH)
        batch = items._replace(origin=items.origin[rows], direction=items.direction[rows])
        best = yield from _search_batch(data, batch, arrays, budget, spent)
        value, missing = best.value, np.where(best.unseen > items.reach, math.inf, best.unseen)
        hit = np.isfinite(value)
        exact = np.where(hit, value < missing, np.isinf(missing))
        hits.verdict[rows] = np.where(hit, Verdict.CONTACT, np.where(exact, Verdict.CLEAR, Verdict.UNKNOWN))
        hits.distance[rows], hits.exact[rows] = value / UNITS_PER_METRE, exact
        lower = np.where(exact & ~hit, float(items.reach), np.minimum(value, missing))
        hits.lower[rows], hits.counts[:, rows] = lower / UNITS_PER_METRE, best.counts
        which = np.flatnonzero(hit)
        found = best._replace(value=value[which], lattice=best.lattice[which])
        hits.cloud[begin + which] = found.lattice * data.arrays.step + data.arrays.origin
        on_hits(begin + which, found)
    if data.nothing_clear:  # a load may have proved the index wrong
        hits.verdict[hits.verdict == Verdict.CLEAR] = Verdict.UNKNOWN
        hits.lower[:], hits.exact[:] = 0.0, False
    return hits


def no_hits(k: int) -> ClosestHits:
    """Return the results of k rays or points before any is found."""
    return ClosestHits(
        np.full(k, math.inf), np.full(k, -1, np.int64), np.zeros((k, 3), np.int64), np.full(k, math.inf),
        np.zeros((3, k), np.uint32),
    )  # fmt: skip


def _search_batch(
    data: SceneData, batch: HitBatch, arrays: Any, budget: QueryBudget, spent: CostCounter
) -> Steps[ClosestHits]:
    """Return the results of a batch; `unseen` bounds what was not examined."""
    k, per_step, lists = len(batch.origin), data.arrays.units_per_step, _list(data, batch)
    best = no_hits(k)

    def search(lists: VoxelLists, *state: NDArray[Any]) -> None:
        search_hits(batch, lists, *state, arrays, best)

    def settle(lists: VoxelLists) -> Steps[VoxelLists]:
        """Drop the rays that hit something before their next voxel."""
        ahead = np.full(k, math.inf)
        open_ = np.flatnonzero(np.diff(lists.starts))
        ahead[open_] = lists.near[lists.starts[:-1][open_]] * per_step
        return drop_items(lists, ahead > best.value)
        yield  # it is a generator

    left = yield from resolve(data, lists, search, budget, spent, settle)
    np.minimum(best.unseen, np.minimum(lists.unseen, left) * per_step, out=best.unseen)
    return best


def _list(data: SceneData, batch: HitBatch) -> VoxelLists:
    """List the voxels that rays or points reach, by the boxes of the index.

    Boxes grow by the largest sphere, by one step, and by more than the rounding: 2^-46 of the
    largest number.
    """
    tree, per_step = data.tree, data.arrays.units_per_step
    begin, reach = batch.origin / per_step, batch.reach / per_step
    far = np.maximum(np.abs(begin).max(axis=1, initial=reach), np.abs(tree.scene).max(initial=0.0))
    slack = 1.0 + far * 2.0**-46
    if len(batch.direction):
        span = batch.radius / per_step + slack
        items = Items(begin, begin + batch.direction * (reach + slack)[:, None], span, span)
    else:
        items = Items(begin, begin, reach + 2.0 * slack, slack)
    return find_lists(tree, items, data.arrays.stop)
