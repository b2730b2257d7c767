"""`sweep` and `contacts` with a level of detail, from an empty cache on, compared with exact answers."""

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
from levels_in_memory import level_bytes
from point_clouds import KINDS, TREES, cloud
from solidcloud.schemas.wire.answers import Cost, Verdict
from solidcloud.server.scene import Scene

MODELS = (*radius_class_archives.MODELS, "local", "local+border", "border:0.5")
TOLERANCES = (1e-5, 3e-3, 0.05, 0.4, 20.0)
COSTS = {*Cost.__struct_fields__, "node_visits", "point_tests", "steps"}


def said(answers: Any) -> dict[str, Any]:
    """Return everything that answers say beside their cost."""
    columns = {name: getattr(answers, name) for name in answers.__struct_fields__ if name not in COSTS}
    return {name: str(value.tolist()) for name, value in columns.items()}  # NaN differs from itself


@pytest.mark.timeout(900)  # the first run may have to compile everything
@settings(max_examples=5, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**32 - 1),
    kind=st.sampled_from(KINDS),
    body=st.sampled_from(KINDS),
    model=st.sampled_from(MODELS),
    voxel=st.sampled_from([0.3, 4.0]),
    tree=TREES,
)
def test_what_a_level_settles_is_true(
    seed: int, kind: str, body: str, model: str | None, voxel: float, tree: dict[str, Any]
) -> None:
    rng = np.random.default_rng(seed)
    points, avatar = cloud(rng, kind, 300), cloud(rng, body, 50) * rng.uniform(0.05, 0.5)
    poses = archive_cases.near_poses(rng, points, avatar, 20, 0.6)
    margin = float(rng.choice([0.0, 0.02, 0.2]))
    with TemporaryDirectory() as folder, radius_class_archives.any_classes():
        case = archive_cases.build(
            Path(folder), points, voxel=voxel, models=radius_class_archives.STORED, **tree
        )
        stored, radii = radius_class_archives.stored_radii(case.archive, model)
        motions = "avatar", poses[:-1], poses[1:], margin
        with Scene.open(case.archive, level_bytes=0) as scene:
            scene.add_avatar("avatar", avatar, 0.02)
            info = scene.info()
            true = scene.sweep(*motions, radius_model=model)
            counted = scene.contacts("avatar", poses, 5, margin, radius_model=model)
        scan = (stored, info.origin, info.lattice_step, radii, avatar, 0.02)
        judged = naive_distance.distance_by_radii(*scan, poses, 5.0)
        signed = np.array([math.inf if found is None else found.signed for found in judged])
        assert ((counted.pairs_found > 0) == (signed <= margin)).all()
        room = level_bytes(case.archive)
        for tolerance in TOLERANCES:
            options: dict[str, Any] = {"tolerance": tolerance, "radius_model": model}
            with Scene.open(case.archive) as cold:
                cold.add_avatar("avatar", avatar, 0.02)
                assert said(cold.contacts("avatar", poses, 5, margin, **options)) == said(counted)
            with Scene.open(case.archive) as cold:
                cold.add_avatar("avatar", avatar, 0.02)
                swept = cold.sweep(*motions, **options)
                assert (swept.verdict == true.verdict).all() and swept.exact[true.exact].all()
                touched = true.verdict == Verdict.CONTACT
                assert (swept.lower <= true.upper)[touched].all()
                assert (swept.upper >= true.lower)[touched].all()
                assert np.isfinite(swept.witness_cloud[touched]).all()
                at = [k for k in np.flatnonzero(touched) if swept.upper[k] == 1.0]
                assert (signed[1:][at] <= margin + 1e-7).all()
            with Scene.open(case.archive, budget_bytes=room, level_bytes=room) as alone:
                alone.add_avatar("avatar", avatar, 0.02)
                for late in ({}, {"budget_ms": 0.0}):
                    swept = alone.sweep(*motions, **options, **late)
                    clear = swept.verdict == Verdict.CLEAR
                    assert (true.verdict[clear] == Verdict.CLEAR).all() and (swept.lower[clear] == 1.0).all()
                    assert (swept.lower <= np.minimum(true.upper, 1.0)).all()
                    assert (swept.upper >= true.lower)[swept.verdict == Verdict.CONTACT].all()
                    found = alone.contacts("avatar", poses, 5, margin, **options, **late)
                    assert (found.pairs_found <= counted.pairs_found).all()
                    assert (found.pairs_found == counted.pairs_found)[found.exact].all()
                    assert (signed[found.verdict == Verdict.CLEAR] > margin).all()
                    assert alone.residency.resident == 0
        with Scene.open(case.archive, level_bytes=room) as kept:
            kept.add_avatar("avatar", avatar, 0.02)
            assert said(kept.sweep(*motions, radius_model=model)) == said(true)
        with Scene.open(case.archive, level_bytes=room) as kept:
            kept.add_avatar("avatar", avatar, 0.02)
            assert said(kept.contacts("avatar", poses, 5, margin, radius_model=model)) == said(counted)


def test_motions_beside_a_dense_wall_need_no_voxel(tmp_path: Path, rng: np.random.Generator) -> None:
    wall = rng.uniform(0, 1, (6000, 3)) * [2.0, 0.003, 2.0]
    body = rng.uniform(-0.1, 0.1, (200, 3))
    case = archive_cases.build(tmp_path, wall, radius=0.15, voxel=1.0)
    begin = np.stack([archive_cases.pose_of(np.eye(3), np.array([x, -1.0, 1.0])) for x in (0.5, 1.0, 1.5)])
    end, beside = begin.copy(), begin.copy()
    end[:, 1, 3], beside[:, 1, 3] = 1.0, -0.6
    with Scene.open(case.archive) as scene:
        scene.add_avatar("body", body, 0.002)
        far = scene.sweep("body", begin, beside, tolerance=0.1)
        clear = scene.contacts("body", beside, tolerance=0.1)
        assert far.misses == clear.misses == scene.residency.resident == 0
        into = scene.sweep("body", begin, end, tolerance=0.2)
        assert into.misses > 0, "a level proves motions clear alone"
        exact = scene.sweep("body", begin, end)
    assert (far.verdict == Verdict.CLEAR).all() and (clear.verdict == Verdict.CLEAR).all()
    assert clear.exact.all() and far.exact.all()
    assert (into.verdict == Verdict.CONTACT).all() and into.exact.all()
    assert (into.lower <= exact.lower + 1e-6).all() and (into.upper >= exact.upper - 1e-6).all()
    assert ((into.upper - into.lower) * 2.0 <= 0.2 + 1e-9).all()
