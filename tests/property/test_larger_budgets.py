"""A larger budget of visits takes back nothing that a smaller one said (NUMERICS.md case 30): pieces, rays, points.

Of poses whose voxels fit the cache together tests/property/test_bounded_naive.py says it.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import archive_cases
import numpy as np
import pytest
from point_clouds import KINDS, cloud
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.avatars.avatar_model import make_avatar
from solidcloud.server.queries.context.anytime_search import collide_bounded, distance_bounded
from solidcloud.server.queries.context.query_budget import QueryBudget
from solidcloud.server.queries.context.query_context import make_scene_data
from solidcloud.server.queries.raycast import raycast
from solidcloud.server.queries.within import within
from solidcloud.server.residency.voxel_cache import VoxelCache
from solidcloud.server.residency.voxel_store import VoxelStore

BUDGETS = (*range(0, 150, 7), 200, 300, 500, 1000, 5000)


def judge(ask: Callable[[QueryBudget], Any], tolerance: float, rounding: float = 0.0) -> None:
    """Assert that verdicts stay said and bounds get no worse, budget by budget."""
    before = ask(QueryBudget(tolerance, BUDGETS[0]))
    for visits in BUDGETS[1:]:
        after = ask(QueryBudget(tolerance, visits))
        said = before.verdict != Verdict.UNKNOWN
        assert (after.verdict[said] == before.verdict[said]).all(), visits
        assert (after.lower >= before.lower - rounding).all() and (after.upper <= before.upper).all(), visits
        assert (after.exact >= before.exact).all(), visits
        before = after


@pytest.mark.parametrize("seed", [11, 22, 24])
@pytest.mark.parametrize("tolerance", [0.0, 0.02])
def test_a_larger_budget_takes_nothing_back(tmp_path: Path, seed: int, tolerance: float) -> None:
    """Of poses that are looked at piece by piece, in a cache of two voxels; of rays and loose points at once."""
    rng = np.random.default_rng(seed)
    points, avatar = cloud(rng, rng.choice(KINDS[:-1]), 200), cloud(rng, "noise", 60) * 0.3
    case = archive_cases.build(tmp_path, points, voxel=0.6, leaf=1, cell_points=20)
    poses = archive_cases.near_poses(rng, points, avatar, 20, 0.4)
    store = VoxelStore(case.archive)
    data = make_scene_data(store.archive, VoxelCache(store, 2 * int(store.sizes.max()) + 128))
    model = make_avatar(avatar, 0.02)
    judge(lambda budget: distance_bounded(data, model, poses, 0.5, budget), tolerance)
    judge(lambda budget: collide_bounded(data, model, poses, 0.05, budget), tolerance)
    at, along = rng.uniform(-1.5, 1.5, (2, 40, 3))
    # Bounds are compared in units and given in metres.
    judge(lambda budget: raycast(data, at, along, 5.0, budget), tolerance, 1e-12)
    judge(lambda budget: within(data, at, 5.0, budget), tolerance, 1e-12)
    store.close()
