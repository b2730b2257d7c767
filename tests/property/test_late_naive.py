"""Queries of frames that do not wait, compared with brute force: any voxels in memory, others absent."""

import math
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import archive_cases
import naive_distance
import numpy as np
import pytest
import radius_class_archives
from hypothesis import given, settings
from hypothesis import strategies as st
from late_frames import blocked_loads
from point_clouds import KINDS, TREES, cloud
from sample_sizes import sample
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.avatars.avatar_model import make_avatar
from solidcloud.server.queries.collide import collide
from solidcloud.server.queries.contacts import contacts
from solidcloud.server.queries.distance import distance
from solidcloud.server.queries.query_inputs import LateVoxels, QueryBudget
from solidcloud.server.queries.rays_and_points import within
from solidcloud.server.queries.sweep import DEFAULT_TOLERANCE, sweep
from solidcloud.server.scene import Scene

MODELS = (*radius_class_archives.MODELS, "local", "border:0.5")


@pytest.mark.timeout(900)  # the first run may have to compile everything
@settings(max_examples=sample(5, 30), deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**32 - 1),
    kind=st.sampled_from(KINDS),
    body=st.sampled_from(KINDS),
    model=st.sampled_from(MODELS),
    policy=st.sampled_from(["lru", "lru+prefetch"]),
    level=st.sampled_from([0, 1 << 22]),
    tree=TREES,
)
def test_what_a_frame_is_told_without_waiting_is_true(
    seed: int, kind: str, body: str, model: str | None, policy: str, level: int, tree: dict[str, Any]
) -> None:
    rng = np.random.default_rng(seed)
    points, avatar = cloud(rng, kind, 200), cloud(rng, body, 30)
    avatar *= rng.uniform(0.05, 0.5)
    poses = archive_cases.near_poses(rng, points, avatar, 10, 0.6)
    with TemporaryDirectory() as folder, radius_class_archives.any_classes():
        case = archive_cases.build(
            Path(folder), points, voxel=0.5, models=radius_class_archives.STORED, **tree
        )
        stored, radii = radius_class_archives.stored_radii(case.archive, model)
        own = make_avatar(avatar, 0.02)
        with Scene.open(case.archive) as judge, judge.archives[0].take() as opened:
            info, data = judge.info(), opened.radius_model(model)
            swept = sweep(data, own, poses[:-1], poses[1:], tolerance=DEFAULT_TOLERANCE)
        scan = (stored, info.origin, info.lattice_step, radii, avatar, 0.02)
        judged = naive_distance.distance_by_radii(*scan, poses, 5.0)
        signed = np.array([math.inf if found is None else found.signed for found in judged])
        with Scene.open(case.archive, policy=policy, level_bytes=level) as scene:
            with scene.archives[0].take() as opened:
                data, where = opened.radius_model(model), opened.data.residency.where
                known = rng.random(len(where)) < rng.choice([0.0, 0.5, 1.0])
                caches = [(opened.data.residency, known)]
                if opened.level is not None:
                    there = rng.random(len(opened.level.store.sizes)) < rng.choice([0.0, 0.7, 1.0])
                    caches.append((opened.level.residency, there))
                for cache, rows in caches:
                    with cache.hold(np.flatnonzero(rows).tolist()):
                        pass
                with blocked_loads(scene):
                    _judge(data, own, poses, signed, swept)
                    if known.all():
                        budget = QueryBudget(late=LateVoxels())
                        assert (collide(data, own, poses, budget=budget).verdict != Verdict.UNKNOWN).all()
                        assert budget.late is not None and budget.late.count == 0
            scene.residency.check()


def _judge(data: Any, own: Any, poses: Any, signed: Any, swept: Any) -> None:
    """Compare all queries of a frame with the distances by brute force, and with exact motions."""
    budget = QueryBudget(late=LateVoxels())
    for margin in (0.0, 0.2):
        said = collide(data, own, poses, margin, budget).verdict
        assert (signed[said == Verdict.CLEAR] > margin - 1e-6).all()
        assert (signed[said == Verdict.CONTACT] <= margin + 1e-6).all()
    for number, pose in enumerate(poses):
        found = distance(data, own, pose[None], 0.5, budget)
        assert found.lower[0] <= max(signed[number], -1e9) + 1e-6
        if found.exact[0]:
            assert min(signed[number], 0.5 + 1e-6) == pytest.approx(
                min(found.signed_distance[0], 0.5 + 1e-6), abs=1e-6
            )
        listed = contacts(data, own, pose[None], 4, 0.1, budget=budget)
        if listed.verdict[0] == Verdict.CLEAR:
            assert signed[number] > 0.1 - 1e-6
        near = within(data, pose[None, :3, 3], 0.3, budget)
        assert near.lower[0] <= near.distance[0]
    for number in range(len(poses) - 1):
        said = sweep(
            data,
            own,
            poses[number : number + 1],
            poses[number + 1 : number + 2],
            0.0,
            DEFAULT_TOLERANCE,
            budget,
        )
        verdict = said.verdict[0]
        assert said.lower[0] <= min(swept.upper[number], 1.0)
        if verdict == Verdict.CLEAR:
            assert swept.verdict[number] == Verdict.CLEAR and said.lower[0] == 1.0
        if verdict == Verdict.CONTACT:
            assert swept.verdict[number] == Verdict.CONTACT and said.upper[0] >= swept.lower[number]
        if verdict == Verdict.UNKNOWN and swept.verdict[number] != Verdict.UNKNOWN:
            assert said.voxels_missing[0] > 0
