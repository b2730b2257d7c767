"""`raycast` and `within` within a tolerance, compared with brute force: bounds that hold, and no more visits."""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import archive_cases
import naive
import naive_rays
import numpy as np
import pytest
import radius_class_archives
from hypothesis import given, settings
from hypothesis import strategies as st
from levels_in_memory import level_bytes
from numpy.typing import NDArray
from point_clouds import KINDS, TREES, cloud
from ray_cases import some_rays
from sample_sizes import sample
from solidcloud.schemas.wire.answers import RaycastAnswers, Verdict, WithinAnswers
from solidcloud.server.scene import Scene

MODELS = (*radius_class_archives.MODELS, "local", "local+border")
TOLERANCES = (0.0, 2.0**-26, 1e-4, 3e-3, 0.05, 0.4, 20.0)
# Bounds are converted to metres, and differences of them rounded.
ROUNDED = 1e-9


def judge(
    answers: RaycastAnswers | WithinAnswers,
    true: NDArray[np.float64],
    reach: float,
    allowed: Any,
    ended: bool,
) -> None:
    """Assert the guarantees of `raycast` and `within` for true distances (k,), inf beyond reach.

    allowed: of all, or (k,) of each.  ended: nothing was missing.
    """
    hit, beyond = np.isfinite(true), np.isinf(true)
    assert (answers.lower <= np.where(beyond, reach, true)).all() and (answers.upper >= true).all()
    assert (answers.distance == answers.upper).all()
    assert (answers.distance[answers.exact] == true[answers.exact]).all()
    assert hit[answers.verdict == Verdict.CONTACT].all() and beyond[answers.verdict == Verdict.CLEAR].all()
    found = np.isfinite(answers.distance)
    assert (np.isfinite(answers.cloud_point).all(axis=1) == found).all()
    if ended:
        assert (found == hit).all() and (answers.verdict != Verdict.UNKNOWN).all()
        assert (answers.upper - answers.lower <= allowed + ROUNDED)[found].all()


def scene_options(tolerance: float, model: str | None) -> dict[str, Any]:
    return {"radius_model": model, **({"tolerance": tolerance} if tolerance else {})}


@pytest.mark.timeout(900)  # the first run may have to compile everything
@settings(max_examples=sample(3, 10), deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**32 - 1),
    kind=st.sampled_from(KINDS),
    model=st.sampled_from(MODELS),
    voxel=st.sampled_from([0.2, 0.5, 4.0]),
    prefetch=st.booleans(),
    tree=TREES,
)
def test_bounds_hold_and_are_close_enough(
    seed: int, kind: str, model: str | None, voxel: float, prefetch: bool, tree: dict[str, Any]
) -> None:
    """prefetch: the level is asked without a tolerance too."""
    rng = np.random.default_rng(seed)
    points, reach = cloud(rng, kind, 300), float(rng.choice([0.3, 3.0]))
    with TemporaryDirectory() as folder, radius_class_archives.any_classes():
        case = archive_cases.build(
            Path(folder), points, voxel=voxel, models=radius_class_archives.STORED, **tree
        )
        stored, units = radius_class_archives.stored_radii(case.archive, model)
        with Scene.open(case.archive) as scene:
            info = scene.info()
        space = info.origin, info.lattice_step
        lattice, radii = stored * info.lattice_step + info.origin, units / naive.UNITS
        rays = some_rays(rng, lattice, 1.0, radii, 40)
        loose = np.concatenate([points[:10], rng.uniform(-1.5, 1.5, (30, 3))])
        hits = naive_rays.raycast(lattice, *space, radii, *rays, reach).distance
        near = naive_rays.within(lattice, *space, loose, reach).distance
        room = level_bytes(case.archive)
        kept: dict[str, Any] = {"level_bytes": room} if prefetch else {}
        with Scene.open(case.archive) as warm:
            exact = [
                query.node_visits
                for _ in range(2)
                for query in (warm.raycast(*rays, reach, radius_model=model), warm.within(loose, reach))
            ][2:]
            for tolerance in TOLERANCES:
                options = scene_options(tolerance, model)
                ray, point = warm.raycast(*rays, reach, **options), warm.within(loose, reach, **options)
                judge(ray, hits, reach, tolerance, True)
                judge(point, near, reach, tolerance, True)
                assert (ray.node_visits <= exact[0]).all() and (point.node_visits <= exact[1]).all()
            for share in (1e-9, 0.3, 5.0):
                point = warm.within(loose, reach, relative_tolerance=share, radius_model=model)
                judge(point, near, reach, np.maximum(1e-3, share * near), True)
                assert (point.node_visits <= exact[1]).all()
        for tolerance in rng.choice(TOLERANCES, 2, replace=False).tolist():
            options = scene_options(tolerance, model)
            with Scene.open(case.archive, **kept) as cold:
                judge(cold.raycast(*rays, reach, **options), hits, reach, tolerance, True)
            with Scene.open(case.archive, **kept) as cold:
                judge(cold.within(loose, reach, **options), near, reach, tolerance, True)
        with Scene.open(case.archive, **kept) as cold:
            point = cold.within(loose, reach, relative_tolerance=0.3, radius_model=model)
            judge(point, near, reach, np.maximum(1e-3, 0.3 * near), True)
        with Scene.open(case.archive, budget_bytes=room, level_bytes=room) as alone:
            for tolerance in TOLERANCES:
                for late in ({}, {"budget_ms": 0.0}):
                    options = {**scene_options(tolerance, model), **late}
                    judge(alone.raycast(*rays, reach, **options), hits, reach, tolerance, False)
                    judge(alone.within(loose, reach, **options), near, reach, tolerance, False)
                    assert alone.residency.resident == 0


def test_a_dense_wall_is_hit_without_its_voxels(tmp_path: Path, rng: np.random.Generator) -> None:
    wall = rng.uniform(0, 1, (6000, 3)) * [2.0, 0.003, 2.0]
    case = archive_cases.build(tmp_path, wall, radius=0.15, voxel=1.0)
    origins = np.array([(x, -1.0, z) for x in (0.5, 1.0, 1.5) for z in (0.5, 1.0)])
    across, along = np.tile([0.0, 1.0, 0.0], (6, 1)), np.tile([1.0, 0.0, 0.0], (6, 1))
    with Scene.open(case.archive) as scene:
        loose = scene.raycast(origins, across, 5.0, tolerance=0.2)
        near = scene.within(origins, 2.0, tolerance=0.1)
        missed = scene.raycast(origins + np.array([0.0, 0.8, 0.0]), along, 5.0, tolerance=0.1)
        share = scene.within(origins, 2.0, relative_tolerance=0.1)
        assert scene.residency.resident == 0
        assert loose.misses == near.misses == missed.misses == share.misses == 0
        assert (missed.verdict == Verdict.CLEAR).all() and missed.exact.all()
        exact, true = scene.raycast(origins, across, 5.0), scene.within(origins, 2.0)
        assert exact.misses > 0
    for found, right in ((loose, exact), (near, true), (share, true)):
        assert (found.verdict == Verdict.CONTACT).all() and not found.exact.any()
        assert (found.lower <= right.distance).all() and (right.distance <= found.upper).all()
        assert (found.upper - found.lower <= 0.2 + ROUNDED).all()
