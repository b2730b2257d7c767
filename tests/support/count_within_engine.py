"""Engine of `count_within`: tests every stored point of the voxels in reach, in exact units."""

import numpy as np
from count_within_question import CountWithinAnswers
from numpy.typing import ArrayLike, NDArray
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.kernels.core.reach import MISSING, NOT_HELD, Items, VoxelLists, find_lists
from solidcloud.server.kernels.core.scene_arrays import LANES, SceneArrays
from solidcloud.server.queries.load_and_search import resolve, run
from solidcloud.server.queries.query_inputs import EXACT, CostCounter, QueryBudget, SceneData, to_units
from solidcloud.server.queries.rays_and_points import make_origins


def count_within(
    data: SceneData, points: ArrayLike, reach: float, budget: QueryBudget = EXACT
) -> CountWithinAnswers:
    """Count the scan points of one archive within `reach` [m] of each of k points (k, 3)."""
    spent = CostCounter(data)
    _, units = make_origins(data, points, "points")
    reach_units, k = to_units(reach, "reach"), len(units)
    scene = data.arrays
    counts, (missing, visits, tests) = np.zeros(k, np.uint32), np.zeros((3, k), np.uint32)

    def search(
        lists: VoxelLists, which: NDArray[np.int64], cursor: NDArray[np.int64], state: NDArray[np.uint8]
    ) -> None:
        for i in which:
            while cursor[i] < lists.starts[i + 1] and not budget.stop:
                row = lists.rows[cursor[i]]
                if state[row] == NOT_HELD:
                    break
                cursor[i] += 1
                if state[row] == MISSING:
                    missing[i] += 1
                    continue
                stored = _stored_points(scene, row)
                apart = stored - units[i]
                apart = apart[(np.abs(apart) <= reach_units).all(axis=1)]  # their squares fit 63 bits
                counts[i] += ((apart * apart).sum(axis=1) <= reach_units * reach_units).sum()
                tests[i] += len(stored)
                visits[i] += 1

    at = units / scene.units_per_step
    span = np.full(k, reach_units / scene.units_per_step + 1.0)  # a step more exceeds what rounding loses
    lists = find_lists(data.tree, Items(at, at, span, np.zeros(k)), budget.request.flag)
    left = run(resolve(data, lists, search, budget, spent))
    exact = (missing == 0) & (np.minimum(lists.unseen, left) == np.inf) & (not data.nothing_clear)
    verdict = np.where(counts > 0, Verdict.CONTACT, np.where(exact, Verdict.CLEAR, Verdict.UNKNOWN))
    low, high = np.rint(data.tree.scene * scene.units_per_step)
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
    lattice = np.moveaxis(places, 1, 2)[there] + scene.corners[row]
    return np.rint(lattice * scene.units_per_step).astype(np.int64)
