"""Merging of the answers of several archives to one query of an effect: the least, with a tie rule.

archives/merge_answers.py does the same for the answers of requests, with many poses at a time.
"""

import msgspec
import numpy as np

from ....schemas.wire.answers import DistanceAnswers, Verdict
from ...queries.resident_fast_path import SweepResult
from .frame import Vec


def comes_first(
    value: float, witness: tuple[Vec | None, ...], other: float, other_witness: tuple[Vec | None, ...]
) -> bool:
    """Return whether an answer replaces that of an earlier archive (NUMERICS.md N11).

    value, witness: of the answer.  other, other_witness: of the earlier archive. The lesser value
    comes first; of equal values, that with the least witness: scan point, then avatar centre, as in
    merge_answers.py.
    """
    if value != other:
        return value < other
    for own, place in zip(witness, other_witness, strict=True):
        if own is None or place is None:
            return False
        one, two = own.tolist(), place.tolist()
        if one != two:
            return bool(one < two)
    return False


def merge_swept(one: SweepResult, other: SweepResult) -> SweepResult:
    """Return the merged answer of two archives about a motion."""
    other_first = comes_first(other.upper, (other.cloud, other.avatar), one.upper, (one.cloud, one.avatar))
    first = other if other_first else one
    lower = min(one.lower, other.lower)
    verdict = Verdict.CLEAR if lower >= 1.0 else Verdict.UNKNOWN
    if first.upper < np.inf:
        verdict = Verdict.CONTACT
    exact = first.exact and lower >= first.lower
    return first._replace(
        verdict=verdict,
        lower=lower,
        exact=exact,
        visits=one.visits + other.visits,
        unknown=one.unknown or other.unknown,
    )


def merge_distances(one: DistanceAnswers, other: DistanceAnswers) -> DistanceAnswers:
    """Return the merged answer of two archives about a distance."""
    other_first = comes_first(
        float(other.signed_distance[0]), (other.witness_cloud[0], other.witness_avatar[0]),
        float(one.signed_distance[0]), (one.witness_cloud[0], one.witness_avatar[0]),
    )  # fmt: skip
    first = other if other_first else one
    verdicts = {int(one.verdict[0]), int(other.verdict[0])}
    verdict = Verdict.CONTACT if Verdict.CONTACT in verdicts else max(verdicts)
    lower = min(one.lower[0], other.lower[0])
    return msgspec.structs.replace(
        first,
        verdict=np.array([verdict], np.uint8),
        lower=np.array([lower]),
        upper=np.array([min(one.upper[0], other.upper[0])]),
        exact=np.array([bool(first.exact[0]) and lower >= first.lower[0]]),
        outside=one.outside & other.outside,
        voxels_missing=one.voxels_missing + other.voxels_missing,
        node_visits=one.node_visits + other.node_visits,
        point_tests=one.point_tests + other.point_tests,
    )
