"""Engine of `count_within`: tests every stored point of the voxels in reach, in exact units."""

import time

import numpy as np
from count_within_question import CountWithinAnswers
from numpy.typing import ArrayLike, NDArray
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.kernels.core.scene_arrays import LANES, SceneArrays
from solidcloud.server.queries.context.front_to_back import make_origins
from solidcloud.server.queries.context.query_budget import EXACT, CostCounter, QueryBudget
from solidcloud.server.queries.context.query_context import SceneData, to_units


def count_within(
    data: SceneData, points: ArrayLike, reach: float, budget: QueryBudget = EXACT
) -> CountWithinAnswers:
    """Count the scan points of one archive within `reach` [m] of each of k points (k, 3)."""
    spent = CostCounter(time.perf_counter(), data.residency, data.broad.keys)
    _, units = make_origins(data, points, "points")
    reach_units, k = to_units(reach, "reach"), len(units)
    scene = data.arrays
    counts, (missing, visits, tests) = np.zeros(k, np.uint32), np.zeros((3, k), np.uint32)
    exact = np.full(k, not data.nothing_clear)
    size = scene.voxel_steps * scene.units_per_step
    for row, cell in enumerate(scene.coordinates):
        low = cell * size
        away = np.maximum(np.maximum(low - units, units - (low + size)), 0.0)
        near = (away * away).sum(axis=1) <= float(reach_units + 1) ** 2
        if budget.stop:
            exact &= ~near
        if budget.stop or not near.any():
            continue
        with data.residency.hold([row], budget.loads_until(), scan=budget.scan, stop=budget.stop) as held:
            if scene.where[row, 0] < 0 or held.late:
                missing[near] += 1
            else:
                stored = _stored_points(scene, row)
                for i in np.flatnonzero(near):
                    apart = stored - units[i]
                    apart = apart[(np.abs(apart) <= reach_units).all(axis=1)]  # their squares fit 63 bits
                    counts[i] += ((apart * apart).sum(axis=1) <= reach_units * reach_units).sum()
                    tests[i] += len(stored)
                    visits[i] += 1
        spent.add(held)
    exact &= missing == 0
    for low, high in data.unknown * scene.units_per_step:
        exact &= ((units + reach_units < low) | (units - reach_units > high)).any(axis=1)
    verdict = np.where(counts > 0, Verdict.CONTACT, np.where(exact, Verdict.CLEAR, Verdict.UNKNOWN))
    low, high = (np.rint(b * scene.units_per_step) for b in (data.broad.scene_low, data.broad.scene_high))
    outside = ((units - reach_units < low) | (units + reach_units > high)).any(axis=1)
    return CountWithinAnswers(
        verdict.astype(np.uint8), counts, exact, outside, missing, visits, tests, **spent.fields()
    )


def _stored_points(scene: SceneArrays, row: int) -> NDArray[np.int64]:
    """Return the points (n, 3) of a resident voxel, exact units."""
    _, block_at, lane_at = scene.where[row].tolist()
    leaves = (lane_at // 2 - block_at) // scene.block_words
    blocks = scene.ints[block_at : block_at + leaves * scene.block_words].reshape(leaves, -1)
    lanes = scene.halves[lane_at : lane_at + leaves * 3 * LANES].reshape(leaves, 3, LANES)
    places = blocks[:, :3, None].astype(np.int64) + lanes
    there = np.arange(LANES) < blocks[:, 3:4]
    lattice = np.moveaxis(places, 1, 2)[there] + scene.coordinates[row] * scene.voxel_steps
    return np.rint(lattice * scene.units_per_step).astype(np.int64)
