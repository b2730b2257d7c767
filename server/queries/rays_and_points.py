"""Queries `raycast` and `within`: the first sphere that a ray hits, the scan point nearest to a point."""

import math
from typing import Any

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
from .load_and_search import Slices, answered, drop_items, next_near, resolve
from .query_inputs import EXACT, CostCounter, QueryBudget, SceneData, to_units, with_stop

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


def raycast_slices(
    data: SceneData, origins: ArrayLike, directions: ArrayLike, reach: float, budget: QueryBudget = EXACT
) -> Slices[RaycastAnswers]:
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
    outside = leaves_scene(data, units.astype(np.float64), units + float(reach_units) * unit)
    best = yield from find_hits(data, HitBatch(units, unit, reach_units, data.radius_units), budget, spent)
    hit, normal = np.full((2, len(world), 3), math.nan)
    which = np.flatnonzero(np.isfinite(best.value))
    t, u = best.value[which, None], unit[which]
    hit[which] = world[which] + (t / UNITS_PER_METRE) * u
    # The normal is along t u - d, from the sphere's centre to the hit; if these coincide, opposite to the ray.
    d = np.rint(best.lattice[which] * data.arrays.units_per_step).astype(np.int64) - units[which]
    away = t * u - d
    length = np.sqrt((away * away).sum(axis=1))[:, None]
    normal[which] = np.where(length > 0, away / np.where(length > 0, length, 1.0), -u)
    columns = _columns(data, best, reach_units)
    return RaycastAnswers(hit=hit, normal=normal, outside=outside, **columns, **spent.fields())


raycast = answered(raycast_slices)


def within_slices(
    data: SceneData, points: ArrayLike, reach: float, budget: QueryBudget = EXACT
) -> Slices[WithinAnswers]:
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
    best = yield from find_hits(data, HitBatch(units, np.empty((0, 3)), reach_units, 0), budget, spent)
    return WithinAnswers(outside=outside, **_columns(data, best, reach_units), **spent.fields())


within = answered(within_slices)


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
    data: SceneData, items: HitBatch, budget: QueryBudget, spent: CostCounter
) -> Slices[ClosestHits]:
    """Find the first hits of k rays or the points nearest to k points, a batch at a time.

    Add the cost to `spent`. Once the request is stopped, no further batch is begun: nothing is known
    about its items, whose `unseen` is 0.
    """
    k, found = len(items.origin), []
    for begin in range(0, max(k, 1), BATCH):
        rows = slice(begin, begin + BATCH)
        batch = items._replace(origin=items.origin[rows], direction=items.direction[rows])
        best = no_hits(len(batch.origin))
        if begin and budget.stop:
            best.unseen[:] = 0.0
        else:
            yield from _search_batch(data, batch, budget, spent, best)
        found.append(best)
    values, squares, lattice, unseen, counts = zip(*found, strict=True)
    return ClosestHits(
        np.concatenate(values), np.concatenate(squares), np.concatenate(lattice), np.concatenate(unseen),
        np.concatenate(counts, axis=1),
    )  # fmt: skip


def _columns(data: SceneData, best: ClosestHits, reach_units: int) -> dict[str, Any]:
    """Return the columns that the answers about rays and about points have in common.

    A hit remains a hit, whatever is missing; it is exact if everything missing is farther away.
    """
    value, reach = best.value, float(reach_units)
    hit, missing = np.isfinite(value), np.where(best.unseen > reach, math.inf, best.unseen)
    if data.nothing_clear:  # a load may have proved the index wrong
        missing[:] = 0.0
    exact = np.where(hit, value < missing, np.isinf(missing))
    clear = np.where(exact, Verdict.CLEAR, Verdict.UNKNOWN)
    cloud = np.where(hit[:, None], best.lattice * data.arrays.step + data.arrays.origin, math.nan)
    lower = np.where(exact & ~hit, reach, np.minimum(value, missing))
    return {
        "verdict": np.where(hit, Verdict.CONTACT, clear).astype(np.uint8), "distance": value / UNITS_PER_METRE,
        "lower": lower / UNITS_PER_METRE, "upper": value / UNITS_PER_METRE, "exact": exact, "cloud_point": cloud,
        "voxels_missing": best.counts[0], "node_visits": best.counts[1], "point_tests": best.counts[2],
    }  # fmt: skip


def no_hits(k: int) -> ClosestHits:
    """Return the results of k rays or points before any is found."""
    return ClosestHits(
        np.full(k, math.inf), np.full(k, -1, np.int64), np.zeros((k, 3), np.int64), np.full(k, math.inf),
        np.zeros((3, k), np.uint32),
    )  # fmt: skip


def _search_batch(
    data: SceneData, batch: HitBatch, budget: QueryBudget, spent: CostCounter, best: ClosestHits
) -> Slices[None]:
    """Write the results of a batch into `best`; `unseen` bounds what was not examined."""
    per_step, lists = data.arrays.units_per_step, _list(data, batch)
    arrays = with_stop(data, budget.stop).arrays

    def search(lists: VoxelLists, *state: NDArray[Any]) -> None:
        search_hits(batch, lists, *state, arrays, best)

    def settle(lists: VoxelLists) -> VoxelLists:
        """Drop the rays that hit something before their next voxel."""
        return drop_items(lists, next_near(lists, lists.starts[:-1]) * per_step > best.value)

    left = yield from resolve(data, lists, search, budget, spent, settle)
    np.minimum(best.unseen, np.minimum(lists.unseen, left) * per_step, out=best.unseen)


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
