"""Comparison of answers with the true ones.

A row that is `unknown` is never wrong if its bounds hold. A row that is `exact` must have every
figure of the truth, bit for bit.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from solidcloud.schemas.wire.answers import ContactsAnswers, Cost, ObjectsAnswers, SweepAnswers, Verdict
from solidcloud.schemas.wire.arrays import array_fields
from solidcloud.schemas.wire.motion_messages import Moved
from solidcloud.schemas.wire.question_table import CONTACTS

# Columns that are judged separately, that depend on the cache, or that state certainty.
_NOT_COMPARED = {
    "verdict",
    "voxels_missing",
    "node_visits",
    "point_tests",
    "steps",
    "exact",
    "lower",
    "upper",
}
_VALUES = ("signed_distance", "distance")


class Judgement(NamedTuple):
    """Numbers of rows of one answer. faults: sentences.  false_clear: rows called clear that are in contact."""

    right: int
    unknown: int
    clear: int
    faults: list[str]
    false_clear: int = 0


def judge(got: Any, truths: Sequence[Any]) -> Judgement:
    """Judge an answer by several possible truths: it is wrong if it is wrong by each of them."""
    found = [_judge_one(got, truth) for truth in truths]
    return min(found, key=lambda judgement: (len(judgement.faults), judgement.false_clear))


def _judge_one(got: Any, truth: Any) -> Judgement:
    """Judge an answer by one truth."""
    if isinstance(truth, Moved):
        return _judge_moved(got, truth)
    if type(got) is not type(truth) or len(got) != len(truth):
        return Judgement(
            0,
            0,
            0,
            [f"{type(got).__name__} of {len(got)} rows: expected {len(truth)} of {type(truth).__name__}"],
        )
    known = got.verdict != Verdict.UNKNOWN
    clear = got.verdict == Verdict.CLEAR
    false = clear & (truth.verdict == Verdict.CONTACT)
    faults = [
        f"row {row}: verdict {Verdict(int(got.verdict[row])).name}, true is {Verdict(int(truth.verdict[row])).name}"
        for row in np.flatnonzero(known & (got.verdict != truth.verdict))
    ]
    exact = got.exact.astype(bool) if len(getattr(got, "exact", ())) == len(got) else known
    if isinstance(truth, SweepAnswers) and isinstance(got, SweepAnswers):
        faults += _motions(got, truth, known & exact)
        # Of several pairs that touch first, any that is resident may be the witness.
        exact = exact & (got.voxels_missing == 0)
    faults += _figures(got, truth, known & exact)
    faults += _bounds(got, truth, ~(known & exact))
    right = known & (got.verdict == truth.verdict)
    return Judgement(int(right.sum()), int((~known).sum()), int(clear.sum()), faults, int(false.sum()))


def _figures(got: Cost, truth: Cost, rows: Any) -> list[str]:
    """Return differences in exact rows."""
    faults = []
    skip = set(_NOT_COMPARED)
    if isinstance(truth, ContactsAnswers):
        skip |= {name for name, rule in CONTACTS.columns.items() if rule.of} | {
            "pair_starts",
            "cluster_starts",
        }
    if isinstance(truth, ObjectsAnswers):
        skip |= {"pairs", "pair_verdict"}
    if isinstance(truth, SweepAnswers) and got.stopped:
        # Of several pairs that touch first, any that was examined before the stop may be the witness.
        skip |= {"witness_avatar", "witness_cloud"}
    for name in array_fields(type(truth)):
        one, other = getattr(got, name), getattr(truth, name)
        if name in skip or len(one) != len(rows) or len(other) != len(rows):
            continue
        same = _same(one, other)
        faults += [
            f"row {row}: {name} {one[row]}, true is {other[row]}" for row in np.flatnonzero(rows & ~same)
        ]
    if isinstance(truth, ContactsAnswers) and isinstance(got, ContactsAnswers):
        for starts in ("pair_starts", "cluster_starts"):
            faults += _lists(got, truth, rows, starts, CONTACTS.rows_of(starts))
    if isinstance(truth, ObjectsAnswers) and isinstance(got, ObjectsAnswers):
        faults += _pairs(got, truth)
    return faults


def _same(one: Any, other: Any) -> Any:
    """Return which rows have the same bits; NaN equals NaN."""
    equal = (one == other) | ((one != one) & (other != other))
    return equal.all(axis=tuple(range(1, equal.ndim)))


def _lists(got: Any, truth: Any, rows: Any, starts: str, names: Sequence[str]) -> list[str]:
    """Return differences in lists of pairs or clusters."""
    faults = []
    for row in np.flatnonzero(rows):
        mine, theirs = (slice(*getattr(each, starts)[row : row + 2].tolist()) for each in (got, truth))
        for name in names:
            one, other = getattr(got, name)[mine], getattr(truth, name)[theirs]
            if len(one) != len(other) or not _same(one, other).all():
                faults.append(
                    f"row {row}: {name} of {len(one)} entries is not that of the {len(other)} true ones"
                )
    return faults


def _pairs(got: ObjectsAnswers, truth: ObjectsAnswers) -> list[str]:
    """Return differences in the pairs of objects in contact; an unknown pair is no fault."""
    said, true = (
        {
            tuple(pair): verdict
            for pair, verdict in zip(each.pairs.tolist(), each.pair_verdict.tolist(), strict=True)
        }
        for each in (got, truth)
    )
    faults = [f"objects {pair} touch, which is not said" for pair in true if pair not in said]
    wrong = (pair for pair, verdict in said.items() if verdict == Verdict.CONTACT and pair not in true)
    return [*faults, *(f"objects {pair} do not touch, as is said" for pair in wrong)]


def _motions(got: SweepAnswers, truth: SweepAnswers, rows: Any) -> list[str]:
    """Return motions whose first contact differs from the true one by more than the query's tolerance."""
    wrong = rows & ~((got.lower <= truth.upper) & (truth.lower <= got.upper))
    return [
        f"row {row}: first contact within {got.lower[row]} .. {got.upper[row]} of the motion, "
        f"truly within {truth.lower[row]} .. {truth.upper[row]}"
        for row in np.flatnonzero(wrong)
    ]


def _bounds(got: Any, truth: Any, rows: Any) -> list[str]:
    """Return rows, not exact, whose bounds do not include the true figure."""
    name = next((name for name in _VALUES if hasattr(truth, name)), None)
    if name is None or not hasattr(got, "lower") or len(got.lower) != len(rows):
        return []
    true = getattr(truth, name)
    # Bounds are rounded outward, and the true figure to nearest.
    low, high = got.lower - 1e-9, got.upper + 1e-9
    wrong = rows & np.isfinite(true) & ((true < low) | (true > high))
    return [
        f"row {row}: {name} {true[row]} is not within {got.lower[row]} .. {got.upper[row]}"
        for row in np.flatnonzero(wrong)
    ]


def _judge_moved(got: Moved, truth: Moved) -> Judgement:
    """Judge one frame. A frame with unknown answers is not judged."""
    if got.unknown or not got.simulated:
        return Judgement(0, 1, 0, [])
    faults = []
    if got.verdict != truth.verdict:
        faults.append(f"verdict {got.verdict}, true is {truth.verdict}")
    if truth.verdict != Verdict.UNKNOWN and not np.array_equal(got.pose, truth.pose):
        faults.append(f"pose at {got.pose[0, :3, 3]}, true is {truth.pose[0, :3, 3]}")
    false = got.verdict == Verdict.CLEAR and truth.verdict == Verdict.CONTACT
    return Judgement(1, 0, int(got.verdict == Verdict.CLEAR), faults, int(false))
