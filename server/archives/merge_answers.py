"""Answers of several archives as those of one scene: carried to the world, and merged. Pure.

The nearest of equals is that with the least scan point (x, y, z), then the least avatar centre, as one archive has it.
"""

from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from ...schemas.wire.answers import (
    CollideAnswers,
    ContactsAnswers,
    Cost,
    DistanceAnswers,
    ObjectsAnswers,
    RaycastAnswers,
    SweepAnswers,
    Verdict,
    WithinAnswers,
)
from ...schemas.wire.columns import CLUSTER_COLUMNS, PAIR_COLUMNS
from .rigid_transform import Pose, moved, moved_boxes, turned

_A = TypeVar("_A", bound=Cost)

_PLACES = (
    "witness_avatar", "witness_cloud", "hit", "cloud_point", "avatar_point", "cluster_avatar", "cluster_cloud",
)  # fmt: skip
_SUMS = ("voxels_missing", "node_visits", "point_tests", "steps")
_MOST = np.iinfo(np.uint32).max


def carried(answers: _A, pose: Pose | None, first_source: int = 0) -> _A:
    """The answers of an archive at a pose, in the world; None: at the identity.

    first_source: which of the scene's sources the archive's first is. A box becomes the box around its corners.
    """
    fields: dict[str, Any] = {}
    if first_source:
        for name in ("scan_index", "cluster_scan"):
            numbers = getattr(answers, name, None)
            if numbers is not None:
                fields[name] = np.where(numbers >= 0, numbers + np.int32(first_source), numbers)
    if pose is not None:
        fields |= {name: moved(pose, getattr(answers, name)) for name in _PLACES if hasattr(answers, name)}
        if hasattr(answers, "normal"):
            fields["normal"] = turned(pose, answers.normal)
        if isinstance(answers, ContactsAnswers):
            low, high = moved_boxes(pose, answers.cluster_low, answers.cluster_high)
            fields |= {"cluster_low": low, "cluster_high": high}
    return structs.replace(answers, **fields) if fields else answers


def merged(answers: Sequence[_A]) -> _A:
    """The answers of several archives to the same poses (rays, points, motions, objects), in the world, as one."""
    if len(answers) == 1:
        return answers[0]
    kind = type(answers[0])
    fields = _COLUMNS[kind](answers)
    fields["verdict"] = _verdict(answers)
    fields["outside"] = np.all([_of(a, "outside") for a in answers], axis=0)
    for name in _SUMS:
        if hasattr(answers[0], name):
            total = sum(_of(a, name).astype(np.int64) for a in answers)
            fields[name] = np.minimum(total, _MOST).astype(np.uint32)
    return kind(**fields, **_cost(answers))


def _of(answers: Cost, name: str) -> NDArray[Any]:
    """A column of answers."""
    column: NDArray[Any] = getattr(answers, name)
    return column


def _stack(answers: Sequence[Cost], name: str) -> NDArray[Any]:
    """A column of each archive's answers, one row an archive."""
    return np.stack([_of(a, name) for a in answers])


def _cost(answers: Sequence[Cost]) -> dict[str, Any]:
    """What all of them cost, and what is in memory of all."""
    total: dict[str, Any] = {
        name: sum(getattr(a, name) for a in answers)
        for name in ("engine_seconds", "hits", "misses", "resident", "resident_bytes", "wait_seconds")
    }
    for name in ("faults", "late"):
        total[name] = tuple(dict.fromkeys(each for a in answers for each in getattr(a, name)))
    total["stopped"] = next((a.stopped for a in answers if a.stopped), "")
    return total


def _verdict(answers: Sequence[Cost]) -> NDArray[np.uint8]:
    """CONTACT with any is contact; CLEAR is what is clear of all."""
    verdicts = _stack(answers, "verdict")
    unknown = np.where((verdicts == Verdict.UNKNOWN).any(axis=0), Verdict.UNKNOWN, Verdict.CLEAR)
    return np.where((verdicts == Verdict.CONTACT).any(axis=0), Verdict.CONTACT, unknown).astype(np.uint8)


def _sure(answers: Sequence[Cost], verdict: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Whether a verdict is the one of tolerance 0: a sure contact with one, or all surely clear."""
    verdicts, exact = _stack(answers, "verdict"), _stack(answers, "exact")
    touches = (exact & (verdicts == Verdict.CONTACT)).any(axis=0)
    return np.asarray(np.where(verdict == Verdict.CONTACT, touches, exact.all(axis=0)))


def _collide(answers: Sequence[CollideAnswers]) -> dict[str, Any]:
    """The bounds of `CollideAnswers`, where there are any."""
    if not len(answers[0].exact):
        return {}
    return {
        "lower": _stack(answers, "lower").min(axis=0),
        "upper": _stack(answers, "upper").min(axis=0),
        "exact": _sure(answers, _verdict(answers)),
    }


def _least(values: NDArray[np.float64], *witnesses: NDArray[np.float64]) -> NDArray[np.int64]:
    """Which of n archives has the least value (n, k); of equals the one with the least witnesses (n, k, 3)."""
    k = values.shape[1]
    found = np.zeros(k, np.int64)
    for number in range(1, len(values)):
        better = values[number] < values[found, np.arange(k)]
        undecided = values[number] == values[found, np.arange(k)]
        for places in witnesses:
            for axis in range(3):
                own, other = places[number, :, axis], places[found, np.arange(k), axis]
                better |= undecided & (own < other)
                undecided &= own == other  # not so where there are none, NaN
        found[better] = number
    return found


def _taken(answers: Sequence[Cost], names: Sequence[str], which: NDArray[np.int64]) -> dict[str, Any]:
    """Of each of the columns, the row of the archive that `which` (k,) says."""
    poses = np.arange(len(which))
    return {name: _stack(answers, name)[which, poses] for name in names}


def _nearest(
    answers: Sequence[Cost], value: str, witnesses: Sequence[str], taken: Sequence[str]
) -> dict[str, Any]:
    """The columns of what is nearest: value, `taken` of the same archive, bounds, and whether it is surely nearest."""
    values, lower = _stack(answers, value), _stack(answers, "lower")
    which = _least(values, *(_stack(answers, name) for name in witnesses))
    fields = _taken(answers, (value, *witnesses, *taken), which)
    exact = _stack(answers, "exact")
    # Others may hold something no nearer than their bounds say, where they do not know it.
    known = (exact | (lower >= fields[value])).all(axis=0)
    fields["exact"] = known & exact[which, np.arange(len(which))]
    fields["lower"], fields["upper"] = lower.min(axis=0), _stack(answers, "upper").min(axis=0)
    return fields


def _distance(answers: Sequence[DistanceAnswers]) -> dict[str, Any]:
    """The columns of `DistanceAnswers`."""
    return _nearest(answers, "signed_distance", ("witness_cloud", "witness_avatar"), ("normal",))


def _raycast(answers: Sequence[RaycastAnswers]) -> dict[str, Any]:
    """The columns of `RaycastAnswers`."""
    return _nearest(answers, "distance", ("cloud_point",), ("hit", "normal"))


def _within(answers: Sequence[WithinAnswers]) -> dict[str, Any]:
    """The columns of `WithinAnswers`."""
    return _nearest(answers, "distance", ("cloud_point",), ())


def _sweep(answers: Sequence[SweepAnswers]) -> dict[str, Any]:
    """The columns of `SweepAnswers`: nothing touches before the least `lower`, the pose at the least `upper` does."""
    verdicts, exact = _stack(answers, "verdict"), _stack(answers, "exact")
    lower, upper = _stack(answers, "lower"), _stack(answers, "upper")
    witnesses = ("witness_cloud", "witness_avatar")
    which = _least(upper, *(_stack(answers, name) for name in witnesses))
    earliest = lower.min(axis=0)
    # An interval that begins there and ends no earlier than the one that is answered is within the tolerance.
    close = (exact & (verdicts == Verdict.CONTACT) & (lower == earliest)).any(axis=0)
    clear = (verdicts == Verdict.CLEAR).all(axis=0)
    return {
        "lower": earliest,
        "exact": close | clear,
        **_taken(answers, ("upper", *witnesses), which),
    }


def _objects(answers: Sequence[ObjectsAnswers]) -> dict[str, Any]:
    """What objects do to one another: the first archive was asked of that."""
    names = ("pairs", "pair_verdict", "pairs_tested", "pairs_filtered", "pair_visits", "pair_tests")
    return {name: getattr(answers[0], name) for name in names}


def _contacts(answers: Sequence[ContactsAnswers]) -> dict[str, Any]:
    """The columns of `ContactsAnswers`: all pairs, of all clusters, each by depth. No cluster is of two archives."""
    fields: dict[str, Any] = {
        "exact": _stack(answers, "exact").all(axis=0),
        "pairs_found": _stack(answers, "pairs_found").sum(axis=0),
    }
    k = len(answers[0])
    clusters, cluster_starts, cluster_rows = _by_pose(answers, "cluster_starts", k)
    deepest = np.concatenate([a.cluster_deepest for a in answers])[clusters]
    cloud = np.concatenate([a.cluster_cloud for a in answers])[clusters]
    order = np.lexsort((*cloud.T[::-1], deepest, cluster_rows))
    clusters = clusters[order]
    fields |= {name: np.concatenate([_of(a, name) for a in answers])[clusters] for name in CLUSTER_COLUMNS}
    fields["cluster_starts"] = cluster_starts
    # Where each archive's own cluster of each pose went, from the pose's first.
    place = np.empty(len(clusters), np.int64)
    place[clusters] = np.arange(len(clusters)) - cluster_starts[cluster_rows[order]]
    pairs, pair_starts, pair_rows = _by_pose(answers, "pair_starts", k)
    columns = {name: np.concatenate([_of(a, name) for a in answers])[pairs] for name in PAIR_COLUMNS}
    columns["cluster"] = place[_own_clusters(answers)][pairs].astype(np.int32)
    keys = (columns["avatar_index"], *columns["avatar_point"].T[::-1], *columns["cloud_point"].T[::-1])
    order = np.lexsort((*keys, columns["signed_distance"], pair_rows))
    return fields | {name: column[order] for name, column in columns.items()} | {"pair_starts": pair_starts}


def _by_pose(
    answers: Sequence[ContactsAnswers], starts: str, k: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Rows of the archives' columns joined, in the order of the k poses; where each pose's begin (k + 1,), and the
    pose of each."""
    poses = np.concatenate([np.repeat(np.arange(k), np.diff(_of(a, starts))) for a in answers])
    order = np.argsort(poses, kind="stable")
    counts = np.bincount(poses, minlength=k) if k else np.zeros(0, np.int64)
    return order, np.concatenate([[0], np.cumsum(counts)]).astype(np.int64), poses[order]


def _own_clusters(answers: Sequence[ContactsAnswers]) -> NDArray[np.int64]:
    """Of each pair of the archives' columns joined, its cluster's row in those joined."""
    rows, first = [], 0
    for a in answers:
        rows.append(np.repeat(a.cluster_starts[:-1], np.diff(a.pair_starts)) + a.cluster + first)
        first += len(a.cluster_count)
    return np.concatenate(rows).astype(np.int64)


def limited(answers: ContactsAnswers, limit: int) -> ContactsAnswers:
    """The answers with at most `limit` pairs listed a pose, the first ones."""
    counts = np.minimum(np.diff(answers.pair_starts), limit)
    if int(counts.sum()) == len(answers.signed_distance):
        return answers
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    rows = np.arange(starts[-1]) + np.repeat(answers.pair_starts[:-1] - starts[:-1], counts)
    columns = {name: _of(answers, name)[rows] for name in PAIR_COLUMNS}
    return structs.replace(answers, pair_starts=starts, **columns)


_COLUMNS: dict[type[Cost], Any] = {
    CollideAnswers: _collide,
    DistanceAnswers: _distance,
    ContactsAnswers: _contacts,
    SweepAnswers: _sweep,
    RaycastAnswers: _raycast,
    WithinAnswers: _within,
    ObjectsAnswers: _objects,
}
