"""Test clashes against a grouping by brute force."""

import itertools

import numpy as np
import pytest
from clash_answers import Found, answers_of, invented
from solidcloud.server.clash.clash_list import CLUSTER_GAP, list_clashes, runs


def test_runs_are_found() -> None:
    assert runs(np.array([], bool)) == []
    assert runs(np.array([True])) == [(0, 0)]
    assert runs(np.array([False, True, True, False, True])) == [(1, 2), (4, 4)]


def apart(one: Found, other: Found) -> float:
    """Return the distance of two boxes [m]."""
    gaps = [
        max(0.0, a - d, c - b) for a, b, c, d in zip(one.low, one.high, other.low, other.high, strict=True)
    ]
    return float(np.linalg.norm(gaps))


def groups_of(clusters: list[tuple[int, Found]]) -> set[frozenset[int]]:
    """Return sets of rows that are linked, by joining sets until nothing changes."""
    groups = [{row} for row in range(len(clusters))]
    for (i, (pose, one)), (j, (next_pose, other)) in itertools.permutations(enumerate(clusters), 2):
        if next_pose == pose + 1 and apart(one, other) <= CLUSTER_GAP:
            joined = [group for group in groups if i in group or j in group]
            groups = [group for group in groups if group not in joined] + [set().union(*joined)]
    return {frozenset(group) for group in groups}


@pytest.mark.parametrize("seed", range(8))
def test_clashes_are_those_of_brute_force(seed: int) -> None:
    rng = np.random.default_rng(seed)
    total = int(rng.integers(1, 60))
    path = [
        invented(rng, room=float(rng.choice([0.3, 3.0]))) if rng.random() < 0.6 else None
        for _ in range(total)
    ]
    # As a check asks: for poses in contact alone, and a few that turn out to be clear.
    asked = [k for k, pose in enumerate(path) if pose or rng.random() < 0.2]
    found = list_clashes(np.array(asked, np.int64), answers_of([path[k] for k in asked]))
    expected = []
    for touches, poses in itertools.groupby(range(total), key=lambda k: bool(path[k])):
        if not touches:
            continue
        own = list(poses)
        clusters = [(k, each) for k in own for each in path[k] or []]
        most = max(sum(each.pairs for each in path[k] or []) for k in own)
        expected.append((own[0], own[-1], most, clusters))
    assert len(found) == len(expected)
    assert [each.depth for each in found] == sorted((each.depth for each in found), reverse=True)
    for clash, (first, last, most, clusters) in zip(
        sorted(found, key=lambda each: each.first), expected, strict=True
    ):
        assert (clash.first, clash.last, clash.contacts) == (first, last, most)
        assert clash.depth == max(each.depth for _, each in clusters)
        groups = groups_of(clusters)
        assert len(clash.clusters) == len(groups)
        made = {(each.first, each.last, each.depth): each for each in clash.clusters}
        for group in groups:
            rows = [clusters[row] for row in group]
            pose, deepest = max(rows, key=lambda each: each[1].depth)
            cluster = made[min(k for k, _ in rows), max(k for k, _ in rows), deepest.depth]
            assert cluster.deepest == pose
            assert np.array_equal(cluster.place, deepest.place)
            way = (deepest.place + deepest.way) - deepest.place
            assert np.allclose(cluster.normal, way / np.linalg.norm(way), atol=1e-12)
            assert np.array_equal(cluster.low, np.min([each.low for _, each in rows], axis=0))
            assert np.array_equal(cluster.high, np.max([each.high for _, each in rows], axis=0))
            at_poses = {k: sum(each.pairs for pose, each in rows if pose == k) for k, _ in rows}
            assert cluster.contacts == max(at_poses.values())


def test_depth_of_touching_spheres_is_zero_and_a_normal_may_be_missing() -> None:
    place = np.array([1.0, 2.0, 3.0])
    touching = Found(0.0, place, np.zeros(3), 1, place, place)
    (clash,) = list_clashes(np.array([7]), answers_of([[touching]]))
    assert (clash.depth, clash.first, clash.deepest) == (0.0, 7, 7)
    assert clash.normal.tolist() == [0, 0, 0]


def test_poses_without_contact_between_two_runs_separate_them() -> None:
    rng = np.random.default_rng(1)
    answers = answers_of([invented(rng), invented(rng), invented(rng)])
    found = list_clashes(np.array([2, 3, 5]), answers)
    assert sorted((each.first, each.last) for each in found) == [(2, 3), (5, 5)]
    assert list_clashes(np.array([], np.int64), answers_of([])) == []
