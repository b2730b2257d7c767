"""Transform and merge the answers of several archives into those of one scene.

`ColumnRules.frame` and `ColumnRules.merge` of each column declare how. All functions are pure. Ties
of the nearest are broken by the least scan point (x, y, z), then the least avatar centre, as in one
archive.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any, NamedTuple, TypeVar

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from ...schemas.wire.answers import ContactsAnswers, Cost, Verdict
from ...schemas.wire.question_rules import ColumnFrame, Merge, Rows, total_cost
from ...schemas.wire.question_table import CONTACTS, question_of
from .rigid_transform import Pose, rotate_vectors, transform_boxes, transform_points

_A = TypeVar("_A", bound=Cost)
_Integers = NDArray[np.int64]

_PAIRS, _CLUSTERS = CONTACTS.rows_of("pair_starts"), CONTACTS.rows_of("cluster_starts")
# Rank of each verdict, clear, unknown, contact in ascending order; also the verdict of each rank.
_RANK = np.array([0, 2, 1], np.uint8)


@cache
def _framed(kind: type[Cost]) -> dict[str, ColumnFrame]:
    """Return the frames of the columns whose values depend on an archive."""
    rules = question_of(kind).columns
    return {name: rule.frame for name, rule in rules.items() if rule.frame is not ColumnFrame.NONE}


def answers_in_world(answers: _A, pose: Pose | None, first_source: int = 0) -> _A:
    """Return the answers of an archive at a pose, in the world; None: at the identity.

    first_source: number of the archive's first source among those of the scene. A box becomes the
    box around its transformed corners.
    """
    fields: dict[str, Any] = {}
    low = ""
    for name, frame in _framed(type(answers)).items():
        column = getattr(answers, name)
        if frame is ColumnFrame.SCAN:
            if first_source:
                fields[name] = np.where(column >= 0, column + np.int32(first_source), column)
        elif pose is None:
            continue
        elif frame is ColumnFrame.POINT:
            fields[name] = transform_points(pose, column)
        elif frame is ColumnFrame.DIRECTION:
            fields[name] = rotate_vectors(pose, column)
        elif frame is ColumnFrame.BOX_LOW:
            low = name
        else:
            fields[low], fields[name] = transform_boxes(pose, getattr(answers, low), column)
    return structs.replace(answers, **fields) if fields else answers


def merge_answers(answers: Sequence[_A]) -> _A:
    """Merge the answers of several archives to the same items, in the world, into those of a scene.

    answers: at least one, in the order of the archives. Fields that are neither columns nor costs
    are taken from the first archive.
    """
    first = answers[0]
    if len(answers) == 1:
        return first
    question = question_of(type(first))
    rules = {
        name: rule.merge
        for name, rule in question.columns.items()
        if rule.merge in _RULES and not (rule.rows is Rows.BOUNDED and not len(getattr(first, name)))
    }
    columns = {name: np.array([getattr(a, name) for a in answers]) for name in rules}
    verdict, distances, nearest = _RANK[np.maximum.reduce(_RANK[columns["verdict"]])], None, None
    if question.nearest is not None:
        value, witnesses = question.nearest
        distances = columns[value]
        # Of equals the least witnesses; one that has none is NaN, which is last.
        keys = [columns[name][..., axis] for name in witnesses for axis in range(3)]
        nearest = np.lexsort([*keys[::-1], distances], axis=0)[0]
    found = _Merged(columns, verdict, distances, nearest)
    fields: dict[str, Any] = {name: _RULES[merge](found, columns[name]) for name, merge in rules.items()}
    if isinstance(first, ContactsAnswers):
        fields |= _contacts(answers)  # type: ignore[arg-type]  # all are of one type
    return structs.replace(first, **fields, **total_cost(answers))


def limit_pairs(answers: ContactsAnswers, limit: int) -> ContactsAnswers:
    """Return the answers with only the first `limit` listed pairs of each pose."""
    counts = np.minimum(np.diff(answers.pair_starts), limit)
    if int(counts.sum()) == len(answers.signed_distance):
        return answers
    starts = _starts(counts)
    rows = np.arange(starts[-1]) + np.repeat(answers.pair_starts[:-1] - starts[:-1], counts)
    columns = {name: getattr(answers, name)[rows] for name in _PAIRS}
    return structs.replace(answers, pair_starts=starts, **columns)


class _Merged(NamedTuple):
    """Input of the merge rules.

    columns: of all archives (archives, k, ...), by name.  verdict: (k,), merged.
    distances: the column that selects the nearest archive.  nearest: (k,), number of that archive.
    """

    columns: Mapping[str, NDArray[Any]]
    verdict: NDArray[np.uint8]
    distances: Any
    nearest: Any

    def of_nearest(self, column: NDArray[Any]) -> NDArray[Any]:
        """Return the values (k, ...) of the nearest archive."""
        return np.asarray(column[self.nearest, np.arange(len(self.nearest))])


def _sum(_: _Merged, column: NDArray[Any]) -> NDArray[Any]:
    """Return the sums, clipped to the largest value of the column's dtype."""
    total = np.add.reduce(column, dtype=np.int64)
    return np.asarray(np.minimum(total, np.iinfo(column.dtype).max).astype(column.dtype))


def _exact_verdict(found: _Merged, exact: NDArray[Any]) -> NDArray[Any]:
    """Return which merged verdicts are exact (k,).

    A contact is exact if that with any archive is; another verdict, if those of all archives are.
    """
    touches = (exact & (found.columns["verdict"] == Verdict.CONTACT)).any(axis=0)
    return np.where(found.verdict == Verdict.CONTACT, touches, exact.all(axis=0))


def _exact_nearest(found: _Merged, exact: NDArray[Any]) -> NDArray[Any]:
    """Return where the nearest is exact, and no other archive can contain a nearer one (k,)."""
    # An archive whose answer is not exact contains nothing nearer than its lower bound.
    known = exact | (found.columns["lower"] >= found.of_nearest(found.distances))
    return np.asarray(known.all(axis=0) & found.of_nearest(exact))


def _exact_interval(found: _Merged, exact: NDArray[Any]) -> NDArray[Any]:
    """Return where the interval of the first contact is exact, or all archives are clear (k,)."""
    verdicts, lower = found.columns["verdict"], found.columns["lower"]
    # The merged interval begins with the first interval and ends no later, so it is no longer.
    first = exact & (verdicts == Verdict.CONTACT) & (lower == lower.min(axis=0))
    return np.asarray(first.any(axis=0) | (verdicts == Verdict.CLEAR).all(axis=0))


# Merge.FIRST leaves the column of the first archive. The columns of Merge.LISTED depend on one another:
# see `_contacts`.
_RULES: dict[Merge, Callable[[_Merged, NDArray[Any]], NDArray[Any]]] = {
    Merge.VERDICT: lambda found, _: found.verdict,
    Merge.ALL: lambda _, column: np.asarray(np.logical_and.reduce(column)),
    Merge.SUM: _sum,
    Merge.LEAST: lambda _, column: np.asarray(np.minimum.reduce(column)),
    Merge.NEAREST: _Merged.of_nearest,
    Merge.EXACT_VERDICT: _exact_verdict,
    Merge.EXACT_NEAREST: _exact_nearest,
    Merge.EXACT_INTERVAL: _exact_interval,
}


def _contacts(answers: Sequence[ContactsAnswers]) -> dict[str, Any]:
    """Return the listed columns of `ContactsAnswers`: pairs and clusters of all archives by depth.

    Clusters of different archives are not joined.
    """
    clusters, cluster_poses, cluster_starts = _listed(answers, "cluster_starts", _CLUSTERS)
    # Clusters of several archives may contain the same deepest pair.
    keys = (
        *_by_axis(clusters["cluster_high"]),
        *_by_axis(clusters["cluster_low"]),
        clusters["cluster_count"],
    )
    keys += (*_by_axis(clusters["cluster_avatar"]), *_by_axis(clusters["cluster_cloud"]))
    order = np.lexsort((*keys, clusters["cluster_deepest"], cluster_poses))
    fields = {name: column[order] for name, column in clusters.items()}
    # New number of each archive's cluster within its pose.
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order)) - cluster_starts[cluster_poses[order]]
    pairs, pair_poses, pair_starts = _listed(answers, "pair_starts", _PAIRS)
    pairs["cluster"] = place[_own_clusters(answers)].astype(np.int32)
    keys = (pairs["scan_index"], pairs["cluster"], pairs["avatar_index"])
    keys += (*_by_axis(pairs["avatar_point"]), *_by_axis(pairs["cloud_point"]))
    order = np.lexsort((*keys, pairs["signed_distance"], pair_poses))
    fields |= {name: column[order] for name, column in pairs.items()}
    return fields | {"cluster_starts": cluster_starts, "pair_starts": pair_starts}


def _by_axis(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """Return the keys with which `np.lexsort` sorts points (n, 3) by x, then y, then z."""
    x, y, z = points.T
    return z, y, x


def _listed(
    answers: Sequence[ContactsAnswers], starts: str, names: Sequence[str]
) -> tuple[dict[str, NDArray[Any]], _Integers, _Integers]:
    """Return listed columns of all archives one behind the other, and how they divide among k poses.

    starts: name of the column with the first row of each pose.  names: of the listed columns.
    Return the columns (n, ...), the pose of each row (n,), and the starts of the merged rows (k + 1,).
    """
    k = len(answers[0])
    poses = np.concatenate([np.repeat(np.arange(k), np.diff(getattr(a, starts))) for a in answers])
    columns = {name: np.concatenate([getattr(a, name) for a in answers]) for name in names}
    return columns, poses, _starts(np.bincount(poses, minlength=k))


def _starts(counts: _Integers) -> _Integers:
    """Return the first row of each item (k + 1,), and the number of all rows."""
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)


def _own_clusters(answers: Sequence[ContactsAnswers]) -> _Integers:
    """Return the row of each pair's cluster; rows are of the archives' concatenated columns."""
    rows, first = [], 0
    for a in answers:
        rows.append(np.repeat(a.cluster_starts[:-1], np.diff(a.pair_starts)) + a.cluster + first)
        first += len(a.cluster_count)
    return np.concatenate(rows).astype(np.int64)
