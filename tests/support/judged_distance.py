"""Comparison of answers of `distance`, and of the bounded searches, with expected ones."""

import naive_distance
import numpy as np
from numpy.typing import NDArray
from solidcloud.schemas.wire.answers import CollideAnswers, DistanceAnswers, Verdict

# Bounds are rounded outward by some exact units of 2^-26 m.
ROUNDED = 2e-7


def compare(answers: DistanceAnswers, expected: list[naive_distance.Expected | None], reach: float) -> None:
    """Assert that answers equal the expected ones, bit for bit."""
    assert answers.exact.all()
    for i, judged in enumerate(expected):
        found = (
            answers.signed_distance[i], answers.witness_avatar[i], answers.witness_cloud[i], answers.normal[i]
        )  # fmt: skip
        if judged is None:
            assert found[0] == answers.upper[i] == np.inf and answers.lower[i] == reach
            assert all(np.isnan(column).all() for column in found[1:])
            assert answers.verdict[i] == Verdict.CLEAR
            continue
        assert found[0] == answers.lower[i] == answers.upper[i] == judged.signed, (i, found, judged)
        assert [column.tolist() for column in found[1:]] == list(judged[1:4]), (i, found, judged)
        assert answers.verdict[i] == (Verdict.CONTACT if judged.signed <= 0 else Verdict.CLEAR)


def judge_distance(
    answers: DistanceAnswers, signed: NDArray[np.float64], reach: float, tolerance: float, ended: bool
) -> None:
    """Assert the guarantees of `distance` for true signed distances (k,), inf beyond reach.

    ended: the search ended for another reason than its budget.
    """
    beyond = np.isinf(signed)
    assert (answers.lower <= np.where(beyond, reach, signed)).all() and (answers.upper >= signed).all()
    assert (answers.signed_distance >= signed).all() and (answers.signed_distance >= answers.upper).all()
    assert (answers.signed_distance[answers.exact] == signed[answers.exact]).all()
    assert (signed[answers.verdict == Verdict.CONTACT] <= 0).all()
    assert (signed[answers.verdict == Verdict.CLEAR] > 0).all()
    found = ~np.isinf(answers.signed_distance)
    assert (np.isfinite(answers.witness_cloud).all(axis=1) == found).all()
    if ended:
        assert (found == ~beyond).all()
        assert (answers.upper[found] - answers.lower[found] <= tolerance + ROUNDED).all()
        assert tolerance > 0 or answers.exact.all()


def judge_collide(
    answers: CollideAnswers, signed: NDArray[np.float64], margin: float, tolerance: float, ended: bool
) -> None:
    """Assert the guarantees of `collide`.

    Signed distances are the true ones (k,), inf beyond reach and tolerance.
    """
    contact, verdict = signed <= margin, answers.verdict
    assert (answers.lower <= np.minimum(signed, margin)).all() and (answers.upper >= signed).all()
    assert contact[answers.exact & (verdict == Verdict.CONTACT)].all()
    assert (signed[verdict == Verdict.CONTACT] <= margin + tolerance).all(), "too early"
    assert not contact[verdict == Verdict.CLEAR].any(), "a false clear"
    assert (
        answers.exact[verdict == Verdict.CLEAR].all() and not answers.exact[verdict == Verdict.UNKNOWN].any()
    )
    if ended:
        assert (verdict != Verdict.UNKNOWN).all()
        assert tolerance > 0 or answers.exact.all()
