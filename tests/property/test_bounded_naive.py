"""With any tolerance and any budget: bounds that hold, no false clear, no contact earlier than the tolerance."""

import math
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import archive_cases
import naive_distance
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from judged_distance import judge_collide, judge_distance
from numpy.typing import NDArray
from point_clouds import KINDS, TREES, cloud
from sample_sizes import sample
from solidcloud.schemas.wire.answers import CollideAnswers, DistanceAnswers, Verdict
from solidcloud.server.queries.context import anytime_search as bounded
from solidcloud.server.queries.context.anytime_search import collide_bounded, distance_bounded
from solidcloud.server.queries.context.query_budget import NO_LIMIT, QueryBudget
from solidcloud.server.scene import Scene

BUDGETS = (0, 1, 5, 30, 200, 2000, NO_LIMIT - 1)


@settings(max_examples=sample(3, 15), deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**32 - 1),
    kind=st.sampled_from(KINDS),
    body=st.sampled_from(KINDS),
    voxel=st.sampled_from([0.3, 0.7, 5.0]),
    heap=st.sampled_from([1, 20, bounded.HEAP_PAIRS]),
    tree=TREES,
)
def test_bounds_hold_and_a_larger_budget_never_gives_worse(
    seed: int, kind: str, body: str, voxel: float, heap: int, tree: dict[str, Any]
) -> None:
    rng = np.random.default_rng(seed)
    points, avatar = cloud(rng, kind, 300), cloud(rng, body, 50) * rng.uniform(0.05, 0.5)
    poses = archive_cases.near_poses(rng, points, avatar, 20, 0.6)
    tolerance = float(rng.choice([0.0, 1e-3, 0.03, 0.3]))
    margin, reach = float(rng.choice([0.0, 0.02, 0.2])), float(rng.choice([0.05, 1.0]))
    with TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        patch.setattr(bounded, "HEAP_PAIRS", heap)
        case = archive_cases.build(Path(folder), points, voxel=voxel, **tree)
        with Scene.open(case.archive) as scene:
            info = scene.info()
            scene.add_avatar("avatar", avatar, 0.02)
            data, model = scene._data, scene.avatar("avatar", "")
            scan = (points, info.origin, info.lattice_step, info.radius)
            signed = _signed(naive_distance.distance(*scan, avatar, 0.02, poses, 5.0))
            within = np.where(signed <= reach, signed, np.inf)
            known = np.zeros(len(poses), bool)
            last: DistanceAnswers | None = None
            before: CollideAnswers | None = None
            for visits in BUDGETS:
                budget = QueryBudget(tolerance, visits)
                ended = visits == BUDGETS[-1]
                near = distance_bounded(data, model, poses, reach, budget)
                judge_distance(near, within, reach, tolerance, ended)
                touch = collide_bounded(data, model, poses, margin, budget)
                judge_collide(touch, signed, margin, tolerance, ended)
                assert (near.node_visits <= visits).all() and (touch.node_visits <= visits).all()
                if last is not None and before is not None:
                    assert (near.lower >= last.lower).all() and (near.upper <= last.upper).all()
                    assert (near.exact >= last.exact).all()
                    # What was said stays said (NUMERICS.md case 30).
                    assert (touch.verdict[known] == before.verdict[known]).all()
                    assert (touch.lower >= before.lower).all() and (touch.upper <= before.upper).all()
                last, before, known = near, touch, touch.verdict != Verdict.UNKNOWN
            if tolerance == 0.0:
                exact = scene.distance("avatar", poses, reach)
                assert exact.signed_distance.tolist() == near.signed_distance.tolist()
                assert np.array_equal(exact.witness_cloud, near.witness_cloud, equal_nan=True)
                assert np.array_equal(exact.witness_avatar, near.witness_avatar, equal_nan=True)
                assert scene.collide("avatar", poses, margin).verdict.tolist() == touch.verdict.tolist()


def _signed(judged: list[naive_distance.Expected | None]) -> NDArray[np.float64]:
    return np.array([math.inf if found is None else found.signed for found in judged])
