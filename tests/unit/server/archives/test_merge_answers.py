"""Answers of several archives as one: what is contact, what is unknown, and what is surely the nearest."""

from typing import Any

import numpy as np
import pytest
from solidcloud.schemas.wire.answers import (
    CollideAnswers,
    ContactsAnswers,
    DistanceAnswers,
    SweepAnswers,
    Verdict,
)
from solidcloud.schemas.wire.arrays import array_fields
from solidcloud.schemas.wire.question_table import make_unknown
from solidcloud.server.archives.merge_answers import answers_in_world, limit_pairs, merge_answers

CLEAR, CONTACT, UNKNOWN = (int(v) for v in Verdict)
INF = np.inf


def answers(kind: Any, k: int, **columns: Any) -> Any:
    """Answers of k poses, unknown but for what is given."""
    blank = make_unknown(kind, k)
    types = array_fields(kind)
    given = {
        name: np.array(values, types[name].dtype) if name in types else values
        for name, values in columns.items()
    }
    return type(blank)(**{name: getattr(blank, name) for name in blank.__struct_fields__} | given)


def test_contact_wins_then_unknown_then_clear() -> None:
    first = answers(CollideAnswers, 9, verdict=[0, 0, 0, 1, 1, 1, 2, 2, 2], exact=[True] * 6 + [False] * 3)
    second = answers(
        CollideAnswers, 9, verdict=[0, 1, 2] * 3, exact=[True, False, False] * 3, outside=[True] * 9
    )
    found = merge_answers([first, second])
    assert found.verdict.tolist() == [0, 1, 2, 1, 1, 1, 2, 1, 2]
    # A contact is exact if one is; what is clear is so by all.
    assert found.exact.tolist() == [True, False, False, True, True, True, False, False, False]
    assert not found.outside.any(), "outside of one alone"


def test_the_nearest_is_exact_if_nobody_may_hold_a_nearer_one() -> None:
    first = answers(DistanceAnswers, 4, signed_distance=[1.0, 1.0, 1.0, INF], lower=[1.0, 1.0, 0.5, 2.0],
                    upper=[1.0, 1.0, 1.0, INF], exact=[True, True, False, True], verdict=[0] * 4)  # fmt: skip
    second = answers(DistanceAnswers, 4, signed_distance=[3.0, INF, 2.0, INF], lower=[0.9, 1.0, 2.0, 2.0],
                     upper=[3.0, INF, 2.0, INF], exact=[False, False, True, True], verdict=[2, 2, 0, 0])  # fmt: skip
    for pair in ([first, second], [second, first]):
        found = merge_answers(pair)
        assert found.signed_distance.tolist() == [1.0, 1.0, 1.0, INF]
        assert found.exact.tolist() == [False, True, False, True]
        assert found.lower.tolist() == [0.9, 1.0, 0.5, 2.0]
        assert found.upper.tolist() == [1.0, 1.0, 1.0, INF]
        assert found.verdict.tolist() == [UNKNOWN, UNKNOWN, CLEAR, CLEAR]


def test_of_equals_the_least_scan_point_is_named_then_the_least_avatar_centre() -> None:
    near = {"signed_distance": [0.5, 0.5], "lower": [0.5, 0.5], "upper": [0.5, 0.5], "exact": [True, True]}
    first = answers(
        DistanceAnswers,
        2,
        **near,
        witness_cloud=[[1, 2, 3], [1, 2, 3]],
        witness_avatar=[[0, 0, 0], [9, 0, 2]],
    )
    second = answers(
        DistanceAnswers,
        2,
        **near,
        witness_cloud=[[1, 2, 2], [1, 2, 3]],
        witness_avatar=[[5, 5, 5], [9, 0, 1]],
    )
    for pair in ([first, second], [second, first]):
        found = merge_answers(pair)
        assert found.witness_cloud.tolist() == [[1, 2, 2], [1, 2, 3]]
        assert found.witness_avatar.tolist() == [[5, 5, 5], [9, 0, 1]]


@pytest.mark.parametrize(
    ("other", "lower", "exact", "verdict"),
    [
        ((CLEAR, 1.0, INF, True), 0.5, True, CONTACT),
        ((UNKNOWN, 0.25, INF, False), 0.25, False, CONTACT),  # what could not be told comes first
        ((UNKNOWN, 0.75, INF, False), 0.5, True, CONTACT),  # what could not be told comes later
        ((CONTACT, 0.499, 0.75, True), 0.499, True, CONTACT),  # an interval around the one that is answered
        ((CONTACT, 0.499, 0.75, False), 0.499, False, CONTACT),
        ((CONTACT, 0.5, 0.75, False), 0.5, True, CONTACT),
    ],
)
def test_a_sweep_is_exact_if_what_begins_first_is_told(
    other: tuple[Any, ...], lower: float, exact: bool, verdict: int
) -> None:
    first = answers(SweepAnswers, 1, verdict=[CONTACT], lower=[0.5], upper=[0.5001], exact=[True],
                    witness_cloud=[[1, 0, 0]], steps=[3])  # fmt: skip
    names = ("verdict", "lower", "upper", "exact")
    second = answers(SweepAnswers, 1, steps=[4], **{n: [v] for n, v in zip(names, other, strict=True)})
    for pair in ([first, second], [second, first]):
        found = merge_answers(pair)
        assert (found.lower[0], found.upper[0], found.exact[0], found.verdict[0]) == (
            lower,
            0.5001,
            exact,
            verdict,
        )
        assert found.witness_cloud.tolist() == [[1, 0, 0]] and found.steps.tolist() == [7]


def test_a_motion_without_contact_is_clear_or_unknown_from_the_first_doubt_on() -> None:
    first = answers(SweepAnswers, 2, verdict=[0, 0], lower=[1, 1], exact=[True, True])
    second = answers(SweepAnswers, 2, verdict=[0, 2], lower=[1, 0.25], exact=[True, False])
    found = merge_answers([first, second])
    assert found.verdict.tolist() == [CLEAR, UNKNOWN]
    assert (found.lower.tolist(), found.upper.tolist(), found.exact.tolist()) == (
        [1.0, 0.25],
        [INF, INF],
        [True, False],
    )


def listed(depths: list[list[float]], scan: int) -> ContactsAnswers:
    """Contacts of poses, each a cluster of its own."""
    counts = [len(own) for own in depths]
    flat = np.array([depth for own in depths for depth in own])
    rows = len(flat)
    place = np.outer(flat, [1.0, 0, 0])
    starts = np.cumsum([0, *counts])
    return answers(
        ContactsAnswers, len(depths), verdict=[int(c > 0) for c in counts], exact=[True] * len(depths),
        pairs_found=counts, pair_starts=starts, avatar_point=place, cloud_point=place, signed_distance=flat,
        avatar_index=np.arange(rows), scan_index=np.full(rows, scan), cluster=[i for c in counts for i in range(c)],
        cluster_starts=starts, cluster_count=np.ones(rows), cluster_deepest=flat, cluster_avatar=place,
        cluster_cloud=place, cluster_scan=np.full(rows, scan), cluster_low=place, cluster_high=place,
    )  # fmt: skip


def test_contacts_are_listed_by_depth_with_the_clusters_they_are_in() -> None:
    found = merge_answers(
        [
            listed([[-3.0, -1.0], [], [-5.0]], 0),
            answers_in_world(listed([[-2.0], [], [-6.0, -4.0]], 0), None, 2),
        ]
    )
    assert found.pair_starts.tolist() == found.cluster_starts.tolist() == [0, 3, 3, 6]
    assert found.signed_distance.tolist() == found.cluster_deepest.tolist() == [-3, -2, -1, -6, -5, -4]
    assert found.cluster.tolist() == [0, 1, 2, 0, 1, 2]
    assert found.scan_index.tolist() == found.cluster_scan.tolist() == [0, 2, 0, 2, 0, 2]
    assert found.pairs_found.tolist() == [3, 0, 3]
    assert found.verdict.tolist() == [CONTACT, CLEAR, CONTACT]
    few = limit_pairs(found, 2)
    assert few.pair_starts.tolist() == [0, 2, 2, 4] and few.signed_distance.tolist() == [-3, -2, -6, -5]
    assert few.cluster_deepest.tolist() == found.cluster_deepest.tolist()
    assert limit_pairs(found, 0).signed_distance.tolist() == []
    assert limit_pairs(found, 3) is found
