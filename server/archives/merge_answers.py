"""Transform and merge the answers of several archives into those of one scene.

`ColumnRules.frame` and `ColumnRules.merge` of each column declare how. All functions are pure. Ties
of the nearest are broken by the least scan point (x, y, z), then the least avatar centre, as in one
archive.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from ...schemas.wire.answers import ContactsAnswers, Cost, Verdict
from ...schemas.wire.arrays import array_fields
from ...schemas.wire.question_rules import ColumnFrame, Merge, Question, Rows
from ...schemas.wire.question_table import CONTACTS, question_of
from .rigid_transform import Pose, rotate_vectors, transform_boxes, transform_points

_A = TypeVar("_A", bound=Cost)

_PAIRS, _CLUSTERS = CONTACTS.rows_of("pair_starts"), CONTACTS.rows_of("cluster_starts")


def answers_in_world(answers: _A, pose: Pose | None, first_source: int = 0) -> _A:
    """Return the answers of an archive at a pose, in the world; None: at the identity.

    first_source: number of the archive's first source among those of the scene. A box becomes the
    box around its transformed corners.
    """
    fields: dict[str, Any] = {}
    low = ""
    for name, rule in question_of(type(answers)).columns.items():
        if rule.frame is ColumnFrame.SCAN and first_source:
            numbers = _column(answers, name)
            fields[name] = np.where(numbers >= 0, numbers + np.int32(first_source), numbers)
        if pose is None:
            continue
        if rule.frame is ColumnFrame.POINT:
            fields[name] = transform_points(pose, _column(answers, name))
        elif rule.frame is ColumnFrame.DIRECTION:
            fields[name] = rotate_vectors(pose, _column(answers, name))
        elif rule.frame is ColumnFrame.BOX_LOW:
            low = name
        elif rule.frame is ColumnFrame.BOX_HIGH:
            fields[low], fields[name] = transform_boxes(pose, _column(answers, low), _column(answers, name))
    return structs.replace(answers, **fields) if fields else answers


def merge_answers(answers: Sequence[_A]) -> _A:
    """Merge the answers of several archives to the same items, in the world, into those of a scene.

    answers: at least one, in the order of the archives. Fields that are neither columns nor costs
    are taken from the first archive.
    """
    first = answers[0]
    if len(answers) == 1:
        return first
    kind = type(first)
    question = question_of(kind)
    fields = {
        name: getattr(first, name)
        for name in kind.__struct_fields__
        if name not in question.columns and name not in Cost.__struct_fields__
    }
    found = _Merged(answers, question, _verdict(answers), _nearest(answers, question))
    for name, rule in question.columns.items():
        if rule.rows is Rows.BOUNDED and not len(_column(first, name)):
            continue
        if rule.merge in _RULES:
            fields[name] = _RULES[rule.merge](found, name)
    if isinstance(first, ContactsAnswers):
        fields |= _contacts(answers)  # type: ignore[arg-type]  # all are of one type
    return kind(**fields, **_cost(answers))


def limit_pairs(answers: ContactsAnswers, limit: int) -> ContactsAnswers:
    """Return the answers with only the first `limit` listed pairs of each pose."""
    counts = np.minimum(np.diff(answers.pair_starts), limit)
    if int(counts.sum()) == len(answers.signed_distance):
        return answers
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    rows = np.arange(starts[-1]) + np.repeat(answers.pair_starts[:-1] - starts[:-1], counts)
    columns = {name: _column(answers, name)[rows] for name in _PAIRS}
    return structs.replace(answers, pair_starts=starts, **columns)


class _Merged(NamedTuple):
    """Input of the merge rules: the answers of several archives to one question.

    verdict: (k,), merged.  nearest: (k,), number of the nearest archive; empty for questions
    without a nearest.
    """

    answers: Sequence[Cost]
    question: Question[Any]
    verdict: NDArray[np.uint8]
    nearest: NDArray[np.int64]

    def stack(self, name: str) -> NDArray[Any]:
        """Return a column of all archives (archives, k, ...)."""
        return np.stack([_column(a, name) for a in self.answers])


def _column(answers: Cost, name: str) -> NDArray[Any]:
    """Return a column of answers, typed as an array."""
    column: NDArray[Any] = getattr(answers, name)
    return column


def _stack(answers: Sequence[Cost], name: str) -> NDArray[Any]:
    """Return a column of all archives (archives, k, ...)."""
    return np.stack([_column(a, name) for a in answers])


def _cost(answers: Sequence[Cost]) -> dict[str, Any]:
    """Return the fields of `Cost`: sums, distinct faults and late voxels, the first stop reason."""
    total: dict[str, Any] = {
        name: sum(getattr(a, name) for a in answers)
        for name in ("engine_seconds", "hits", "misses", "resident", "resident_bytes", "wait_seconds")
    }
    for name in ("faults", "late"):
        total[name] = tuple(dict.fromkeys(each for a in answers for each in getattr(a, name)))
    total["stopped"] = next((a.stopped for a in answers if a.stopped), "")
    return total


def _verdict(answers: Sequence[Cost]) -> NDArray[np.uint8]:
    """Return the merged verdicts (k,): contact if any is, else unknown if any is, else clear."""
    verdicts = _stack(answers, "verdict")
    unknown = np.where((verdicts == Verdict.UNKNOWN).any(axis=0), Verdict.UNKNOWN, Verdict.CLEAR)
    return np.where((verdicts == Verdict.CONTACT).any(axis=0), Verdict.CONTACT, unknown).astype(np.uint8)


def _nearest(answers: Sequence[Cost], question: Question[Any]) -> NDArray[np.int64]:
    """Return the number of the archive with the least value (k,), of equals by least witnesses."""
    if question.nearest is None:
        return np.zeros(0, np.int64)
    value, names = question.nearest
    values, witnesses = _stack(answers, value), [_stack(answers, name) for name in names]
    poses = np.arange(values.shape[1])
    found = np.zeros(len(poses), np.int64)
    for number in range(1, len(values)):
        better = values[number] < values[found, poses]
        undecided = values[number] == values[found, poses]
        for places in witnesses:
            for axis in range(3):
                own, other = places[number, :, axis], places[found, poses, axis]
                better |= undecided & (own < other)
                undecided &= own == other  # false where there is no witness, because NaN != NaN
        found[better] = number
    return found


def _sum(found: _Merged, name: str) -> NDArray[Any]:
    """Return the sums of a column, clipped to the largest value of its dtype."""
    dtype = array_fields(type(found.answers[0]))[name].dtype
    total = sum(_column(a, name).astype(np.int64) for a in found.answers)
    return np.minimum(total, np.iinfo(dtype).max).astype(dtype)


def _of_nearest(found: _Merged, name: str) -> NDArray[Any]:
    """Return the values of the nearest archive."""
    return np.asarray(found.stack(name)[found.nearest, np.arange(len(found.nearest))])


def _exact_verdict(found: _Merged, name: str) -> NDArray[np.bool_]:
    """Return which merged verdicts are exact (k,).

    A contact is exact if that with any archive is; another verdict, if those of all archives are.
    """
    verdicts, exact = found.stack("verdict"), found.stack(name)
    touches = (exact & (verdicts == Verdict.CONTACT)).any(axis=0)
    return np.asarray(np.where(found.verdict == Verdict.CONTACT, touches, exact.all(axis=0)))


def _exact_nearest(found: _Merged, name: str) -> NDArray[np.bool_]:
    """Return where the nearest is exact, and no other archive can contain a nearer one (k,)."""
    value, _ = found.question.nearest or ("", ())
    exact = found.stack(name)
    # An archive whose answer is not exact contains nothing nearer than its lower bound.
    known = (exact | (found.stack("lower") >= _of_nearest(found, value))).all(axis=0)
    return np.asarray(known & _of_nearest(found, name))


def _exact_interval(found: _Merged, name: str) -> NDArray[np.bool_]:
    """Return where the interval of the first contact is exact, or all archives are clear (k,)."""
    verdicts, lower = found.stack("verdict"), found.stack("lower")
    # The merged interval begins with the first interval and ends no later, so it is no longer.
    first = found.stack(name) & (verdicts == Verdict.CONTACT) & (lower == lower.min(axis=0))
    return np.asarray(first.any(axis=0) | (verdicts == Verdict.CLEAR).all(axis=0))


# Merge.LISTED is missing, because its columns depend on one another: see `_contacts`.
_RULES: dict[Merge, Callable[[_Merged, str], NDArray[Any]]] = {
    Merge.VERDICT: lambda found, _: found.verdict,
    Merge.ALL: lambda found, name: np.asarray(found.stack(name).all(axis=0)),
    Merge.SUM: _sum,
    Merge.LEAST: lambda found, name: np.asarray(found.stack(name).min(axis=0)),
    Merge.NEAREST: _of_nearest,
    Merge.FIRST: lambda found, name: _column(found.answers[0], name),
    Merge.EXACT_VERDICT: _exact_verdict,
    Merge.EXACT_NEAREST: _exact_nearest,
    Merge.EXACT_INTERVAL: _exact_interval,
}


def _contacts(answers: Sequence[ContactsAnswers]) -> dict[str, Any]:
    """Return the listed columns of `ContactsAnswers`: pairs and clusters of all archives by depth.

    Clusters of different archives are not joined.
    """
    k = len(answers[0])
    clusters, cluster_starts, cluster_rows = _by_pose(answers, "cluster_starts", k)
    own = {name: np.concatenate([_column(a, name) for a in answers])[clusters] for name in _CLUSTERS}
    # Clusters of several archives may contain the same deepest pair.
    keys = (*_by_axis(own["cluster_high"]), *_by_axis(own["cluster_low"]), own["cluster_count"])
    keys += (*_by_axis(own["cluster_avatar"]), *_by_axis(own["cluster_cloud"]), own["cluster_deepest"])
    order = np.lexsort((*keys, cluster_rows))
    clusters = clusters[order]
    fields = {name: column[order] for name, column in own.items()}
    fields["cluster_starts"] = cluster_starts
    # New number of each archive's cluster within its pose.
    place = np.empty(len(clusters), np.int64)
    place[clusters] = np.arange(len(clusters)) - cluster_starts[cluster_rows[order]]
    pairs, pair_starts, pair_rows = _by_pose(answers, "pair_starts", k)
    columns = {name: np.concatenate([_column(a, name) for a in answers])[pairs] for name in _PAIRS}
    columns["cluster"] = place[_own_clusters(answers)][pairs].astype(np.int32)
    keys = (columns["scan_index"], columns["cluster"], columns["avatar_index"])
    keys += (*_by_axis(columns["avatar_point"]), *_by_axis(columns["cloud_point"]))
    order = np.lexsort((*keys, columns["signed_distance"], pair_rows))
    return fields | {name: column[order] for name, column in columns.items()} | {"pair_starts": pair_starts}


def _by_axis(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """Return the keys with which `np.lexsort` sorts points (n, 3) by x, then y, then z."""
    x, y, z = points.T
    return z, y, x


def _by_pose(
    answers: Sequence[ContactsAnswers], starts: str, k: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Order the rows of the archives' concatenated columns by pose.

    starts: name of the column with the first row of each pose, "pair_starts" or "cluster_starts".
    Return the rows (n,) in the order of the k poses, the starts of the poses' rows (k + 1,), and
    the pose of each row (n,).
    """
    poses = np.concatenate([np.repeat(np.arange(k), np.diff(_column(a, starts))) for a in answers])
    order = np.argsort(poses, kind="stable")
    counts = np.bincount(poses, minlength=k) if k else np.zeros(0, np.int64)
    return order, np.concatenate([[0], np.cumsum(counts)]).astype(np.int64), poses[order]


def _own_clusters(answers: Sequence[ContactsAnswers]) -> NDArray[np.int64]:
    """Return the row of each pair's cluster; rows are of the archives' concatenated columns."""
    rows, first = [], 0
    for a in answers:
        rows.append(np.repeat(a.cluster_starts[:-1], np.diff(a.pair_starts)) + a.cluster + first)
        first += len(a.cluster_count)
    return np.concatenate(rows).astype(np.int64)
