"""One motion, one pose in a kernel call: the answers of `sweep` and `collide` to the last bit."""

from pathlib import Path

import archive_cases
import judged_sweeps
import naive_sweep
import numpy as np
import pytest
import synthetic_scans
from numpy.typing import NDArray
from solidcloud.schemas.wire.answers import SweepAnswers, Verdict
from solidcloud.server.avatars.avatar_model import AvatarModel, make_avatar
from solidcloud.server.kernels.motion import sweep_resident
from solidcloud.server.queries import collide as collide_module
from solidcloud.server.queries import sweep as sweep_module
from solidcloud.server.queries.collide import collide
from solidcloud.server.queries.query_inputs import SceneData
from solidcloud.server.queries.sweep import sweep

Poses = NDArray[np.float64]
COUNT = 12


def said(a: SweepAnswers, i: int) -> tuple[object, ...]:
    """What an answer says of motion i, its cost included."""
    pair = a.witness_avatar[i].tobytes(), a.witness_cloud[i].tobytes()
    cost = a.steps[i], a.node_visits[i], a.point_tests[i], a.voxels_missing[i]
    return a.verdict[i], a.lower[i], a.upper[i], a.exact[i], *pair, a.outside[i], *cost


def same(data: SceneData, avatar: AvatarModel, first: Poses, last: Poses) -> set[int]:
    """Assert that one kernel call says of each motion (k, 4, 4) what `sweep` says; return the verdicts."""
    expected = sweep(data, avatar, first, last)
    for i in range(len(first)):
        assert said(sweep_module.sweep_fast(data, avatar, first[i], last[i]), 0) == said(expected, i)
    return set(expected.verdict.tolist())


@pytest.mark.interpreted
@pytest.mark.parametrize("name", ["plane", "corner", "noise", "one point"])
@pytest.mark.parametrize("far", [0.0, 2.0**18])
def test_motions_and_poses_are_answered_to_the_last_bit(
    tmp_path: Path, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch, name: str, far: float
) -> None:
    points = synthetic_scans.make_scan(name, 5, 200) + far
    case = archive_cases.build(tmp_path, points, resolution=archive_cases.BINARY_STEP)
    avatar = make_avatar(rng.uniform(-0.2, 0.2, (12, 3)), 0.02)
    first, last = judged_sweeps.motions(rng, points, avatar.points, COUNT, 0.3, 0.2, 0.5)
    last[::3, :3, :3] = first[::3, :3, :3]
    last[1] = first[1]
    with judged_sweeps.opened(case) as data:
        found = same(data, avatar, first, last)
        assert Verdict.CONTACT in found
        with monkeypatch.context() as patch:
            patch.setattr(sweep_module, "sweep", None)  # one call answers it
            assert sweep_module.sweep_fast(data, avatar, first[0], last[0]).verdict[0] in found
        verdicts = collide(data, avatar, first)
        for i in range(COUNT):
            one = collide_module.collide_fast(data, avatar, first[i])
            assert (one.verdict[0], one.node_visits[0]) == (verdicts.verdict[i], verdicts.node_visits[i])
        nothing, away = make_avatar(np.empty((0, 3)), 0.02), first[0].copy()
        away[:3, 3] += 1e5
        assert collide_module.collide_fast(data, avatar, away).outside.tolist() == [True]
        left = collide_module.collide_fast(data, nothing, first[0]).outside.tolist()
        assert left == collide(data, nothing, first[:1]).outside.tolist()
        region = np.array([[[-(10**6)] * 3, [10**6] * 3]])
        tree = data.tree._replace(unknown=region.astype(np.float64))
        for unseen in (data._replace(unknown_everywhere=True), data._replace(tree=tree)):
            assert Verdict.CLEAR not in same(unseen, avatar, first, last)
            assert collide_module.collide_fast(unseen, avatar, first[0]).verdict[0] != Verdict.CLEAR


@pytest.mark.interpreted
def test_the_pose_between_is_the_sweeps(rng: np.random.Generator) -> None:
    avatar = make_avatar([[0.0, 0, 0], [0.1, 0, 0]], 0.05)
    first, last = judged_sweeps.motions(rng, np.zeros((1, 3)), avatar.points, 8, 0.3, 2.0, 2.0)
    pose = np.empty((4, 4))
    for one, other in zip(first, last, strict=True):
        for fraction in (0.0, 0.3, 1.0):
            assert sweep_resident.pose_between(one, other, fraction, avatar.box, np.zeros(3), pose)
            np.testing.assert_allclose(pose, naive_sweep.pose_at(one, other, fraction), atol=1e-12)
        sweep_resident.pose_between(one, other, 0.0, avatar.box, np.array([1e6, 0, 0]), pose)
        np.testing.assert_allclose(pose, one, atol=1e-9)


@pytest.mark.interpreted
def test_a_contact_in_the_first_voxels_needs_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    points = np.column_stack([np.arange(0.05, 4, 0.1), np.zeros(40), np.zeros(40)])
    case = archive_cases.build(tmp_path, points, voxel=1.0, resolution=1e-3)
    avatar = make_avatar([[0.0, 0, 0], [0.45, 0, 0]], 0.1)
    touching, clear = (archive_cases.pose_of(np.eye(3), np.array([0.75, 0, z])) for z in (0.0, 0.3))
    with judged_sweeps.opened(case) as data:
        full = collide(data, avatar, touching)
        assert full.verdict[0] == Verdict.CONTACT and full.misses == 1
        monkeypatch.setattr(collide_module, "collide", None)
        again = collide_module.collide_fast(data, avatar, touching)
        assert again.verdict[0] == Verdict.CONTACT and (again.hits, again.misses) == (1, 0)
        assert again.node_visits[0] == full.node_visits[0]
        with pytest.raises(TypeError):  # not answered by the first voxel alone
            collide_module.collide_fast(data, avatar, clear, margin=0.1)
