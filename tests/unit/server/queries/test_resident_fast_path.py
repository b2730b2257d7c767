"""One motion, one pose in a kernel call: the answers of `sweep` and `collide` to the last bit."""

from pathlib import Path

import archive_cases
import judged_sweeps
import naive_sweep
import numpy as np
import pytest
import synthetic_scans
from numpy.typing import NDArray
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.avatars.avatar_model import make_avatar
from solidcloud.server.queries import resident_fast_path as module
from solidcloud.server.queries.collide import collide
from solidcloud.server.queries.request import EXACT, make_budget
from solidcloud.server.queries.resident_fast_path import ResidentQueries, SweepResult
from solidcloud.server.queries.scene_data import SceneData
from solidcloud.server.queries.sweep import sweep

Poses = NDArray[np.float64]
COUNT = 12


def same(
    probe: ResidentQueries, data: SceneData, first: Poses, last: Poses, tolerance: float = 1e-6
) -> list[SweepResult]:
    """What a probe says of motions (k, 4, 4), asserted to be what `sweep` says."""
    answers = sweep(data, probe.avatar, first, last, tolerance=tolerance)
    found = []
    for i in range(len(first)):
        one = probe.sweep(data, first[i], last[i], tolerance, EXACT)
        assert one.verdict == answers.verdict[i] and one.visits == answers.node_visits[i]
        assert (one.lower, one.upper, one.exact) == (answers.lower[i], answers.upper[i], answers.exact[i])
        if not data.nothing_clear and not len(data.tree.unknown):
            assert one.unknown == (one.verdict == Verdict.UNKNOWN or one.missing > 0)
        if one.verdict == Verdict.CONTACT:
            np.testing.assert_array_equal(one.avatar, answers.witness_avatar[i])
            np.testing.assert_array_equal(one.cloud, answers.witness_cloud[i])
        else:
            assert one.avatar is None and one.cloud is None
        found.append(one)
    return found


@pytest.mark.interpreted
@pytest.mark.parametrize("name", ["plane", "corner", "noise", "one point"])
@pytest.mark.parametrize("far", [0.0, 2.0**18])
def test_motions_and_poses_are_answered_to_the_last_bit(
    tmp_path: Path, rng: np.random.Generator, name: str, far: float
) -> None:
    points = synthetic_scans.make_scan(name, 5, 200) + far
    case = archive_cases.build(tmp_path, points, resolution=archive_cases.BINARY_STEP)
    avatar = make_avatar(rng.uniform(-0.2, 0.2, (12, 3)), 0.02)
    first, last = judged_sweeps.motions(rng, points, avatar.points, COUNT, 0.3, 0.2, 0.5)
    last[::3, :3, :3] = first[::3, :3, :3]
    last[1] = first[1]
    probe = ResidentQueries(avatar)
    with judged_sweeps.opened(case) as fresh:  # loads
        loaded = [probe.sweep(fresh, one, other, 1e-6, EXACT) for one, other in zip(first, last, strict=True)]
    with judged_sweeps.opened(case) as data:
        for own, expected in zip(loaded, same(probe, data, first, last), strict=True):
            assert own[:3] == expected[:3]
        found = same(probe, data, first, last)
        assert {each.verdict for each in found} >= {Verdict.CONTACT}
        verdicts = collide(data, avatar, first)
        for i in range(COUNT):
            assert probe.collide(data, first[i], EXACT) == (verdicts.verdict[i], verdicts.node_visits[i])


@pytest.mark.interpreted
def test_what_is_no_quick_question_is_answered_as_well(tmp_path: Path, rng: np.random.Generator) -> None:
    points = synthetic_scans.make_scan("plane", 5, 200)
    case = archive_cases.build(tmp_path, points)
    with judged_sweeps.opened(case) as data:
        first, last = judged_sweeps.motions(rng, points, np.zeros((1, 3)), 4, 0.3, 0.2, 0.5)
        assert all(
            each.verdict == Verdict.CLEAR
            for each in same(ResidentQueries(make_avatar(np.zeros((0, 3)))), data, first, last)
        )
        long = last.copy()
        long[:, :3, 3] += [60.0, 0, 0]
        probe = ResidentQueries(make_avatar([[0.0, 0, 0], [0.1, 0, 0]], 0.05))
        same(probe, data, first, long)
        spent = make_budget(budget_ms=0)
        assert probe.sweep(data, first[0], last[0], 1e-6, spent).verdict != Verdict.CLEAR
        unseen, region = data._replace(unknown_everywhere=True), np.array([[[-(10**6)] * 3, [10**6] * 3]])
        tree = data.tree._replace(unknown=region.astype(np.float64))
        for seen in (unseen, data._replace(tree=tree)):
            assert {each.verdict for each in same(probe, seen, first, last)} <= {
                Verdict.UNKNOWN,
                Verdict.CONTACT,
            }
            assert probe.collide(seen, first[0], EXACT)[0] != Verdict.CLEAR


@pytest.mark.interpreted
def test_the_pose_between_is_the_sweeps(tmp_path: Path, rng: np.random.Generator) -> None:
    probe = ResidentQueries(make_avatar([[0.0, 0, 0], [0.1, 0, 0]], 0.05))
    first, last = judged_sweeps.motions(rng, np.zeros((1, 3)), probe.avatar.points, 8, 0.3, 2.0, 2.0)
    for one, other in zip(first, last, strict=True):
        for fraction in (0.0, 0.3, 1.0):
            pose, holds = probe.between(np.zeros(3), one, other, fraction)
            assert holds
            np.testing.assert_allclose(pose, naive_sweep.pose_at(one, other, fraction), atol=1e-12)
        pose, _ = probe.between(np.array([1e6, 0, 0]), one, other, 0.0)
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
        asked = collide(data, avatar, touching)
        assert asked.verdict[0] == Verdict.CONTACT and asked.misses == 1
        monkeypatch.setattr(module, "collide", None)
        again = module.collide_fast(data, avatar, touching)
        assert again.verdict[0] == Verdict.CONTACT and (again.hits, again.misses) == (1, 0)
        assert again.node_visits[0] == asked.node_visits[0]
        with pytest.raises(TypeError):  # not answered by the first voxel alone
            module.collide_fast(data, avatar, clear, margin=0.1)
