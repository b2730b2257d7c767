"""Mean closest-point distance of an archive, over a sample of its distinct points.

Half of it is the radius of the model `mean`, as in the paper ([Fig12] section 7). It is computed
over distinct points, across voxel borders; duplicates would make it zero (NUMERICS.md case 28).

Closest points are found across voxel borders. A voxel is opened once for its own points. Points
that may have a closer point in another voxel are queried there in rounds, with all queries to one
voxel together. Each voxel is therefore opened twice in total, and one voxel at a time is in memory,
however many points they have: 12 bytes per point, 16 with intensities, for its frame, its bytes and
its nodes.
"""

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.archive import Archive
from ..kernels.neighbours.nearest_points import FAR, BoxTree, closest_in_record, make_box_tree, near_boxes
from ..kernels.points.voxel_records import first_of_each
from ..run.executor import Executor, Progress, Silent, jobs_of, run_units, voxel_ranges
from ..voxel.record_points import hash_limit, iter_points, leaves_of, spheres_of

# Voxels in which a point is queried at a time. A corner has 7 other voxels around it.
_NEAR_VOXELS = 8
# Number of points queried together that may have a closer point in other voxels; it bounds the
# lists of voxels.
_BATCH = 1 << 17
# Distances are added as integers of 2^-32 m: every order gives the same sum (NUMERICS.md N8), and
# 10^6 distances of 2 km fit 63 bits.
SUM_UNITS = 2.0**32
# Squares of distances below this [SUM_UNITS] can be summed in three parts of 64 bits: 2 km.
_SHORT = 1 << 43


class MeanDistance(NamedTuple):
    """Mean closest-point distance [m].

    error: its standard error [m], 0 if all points were used.  sample: number of points used.
    """

    mean: float
    error: float
    sample: int


class Sums(NamedTuple):
    """Sums over points, in any order: distances in SUM_UNITS, their squares, and the count."""

    total: int = 0
    squares: int = 0
    sample: int = 0

    def plus(self, other: "Sums") -> "Sums":
        """Return the sum of both."""
        return Sums(*(a + b for a, b in zip(self, other, strict=True)))


class PendingPoints(NamedTuple):
    """Points that may have a closer point in another voxel.

    lattice: (q, 3) int64.  own: (q,) int64, row of their voxel.
    best: (q,) int64, squared distance to the closest other point known [steps^2]; FAR if none is
    known.
    """

    lattice: NDArray[np.int64]
    own: NDArray[np.int64]
    best: NDArray[np.int64]


class _OwnUnit(NamedTuple):
    """Voxels whose sampled points are queried in their own voxel."""

    folder: Path
    rows: range
    share: float
    points: int


class _OtherUnit(NamedTuple):
    """Queries of points in voxels other than their own: starts[i] to starts[i + 1] in rows[i].

    lattice: (m, 3) int64; best: (m,) int64.
    """

    folder: Path
    rows: NDArray[np.int64]
    starts: NDArray[np.int64]
    lattice: NDArray[np.int64]
    best: NDArray[np.int64]


def archive_mean(
    folder: Path, sample: int, executor: Executor | None = None, progress: Progress | None = None
) -> MeanDistance:
    """Measure the mean closest-point distance [m] of the archive in `folder`.

    It uses about `sample` distinct points, or all, selected by their lattice coordinates alone. A
    point that is alone in the dataset, or 2^31 steps from every other, is left out. Progress
    advances by the archive's points. Raise CorruptError, FormatError.
    """
    progress = progress or Silent()
    with Archive(folder) as archive:
        header, base, points = archive.header, _corners(archive), _points(archive)
        boxes = make_box_tree(base + archive.voxels["low"], base + archive.voxels["high"])
    share = min(1.0, sample / header.points)
    units = [
        _OwnUnit(folder, rows, share, int(points[rows.start : rows.stop].sum()))
        for rows in voxel_ranges(points, jobs_of(executor))
    ]
    results = run_units(executor, _own_sums, units, progress, lambda unit: unit.points)
    found = [(unit.rows.start, *result) for unit, result in zip(units, results, strict=True)]
    found.sort(key=lambda part: part[0])
    sums = Sums()
    for _, part, _ in found:
        sums = sums.plus(part)
    left = PendingPoints(
        *(np.concatenate(column) for column in zip(*(part[2] for part in found), strict=True))
    )

    def ask(
        rows: NDArray[np.int64],
        starts: NDArray[np.int64],
        lattice: NDArray[np.int64],
        best: NDArray[np.int64],
    ) -> NDArray[np.int64]:
        runs = sorted(voxel_ranges(points[rows], jobs_of(executor)), key=lambda run: run.start)
        others = [_other_unit(folder, rows, starts, lattice, best, run) for run in runs]
        return np.concatenate(list(run_units(executor, _other_best, others, Silent(), len)))

    for begin in range(0, len(left.best), _BATCH):
        batch = PendingPoints(*(column[begin : begin + _BATCH] for column in left))
        refine_closest(batch, boxes, ask)
    sums = sums.plus(sums_of(left.best, header.lattice.step))
    return mean_of_squares(*sums, share >= 1.0)


def mean_of_squares(total: int, squares: int, sample: int, everything: bool) -> MeanDistance:
    """Return the mean from integer sums: distances in SUM_UNITS, and their squares."""
    if sample == 0:
        return MeanDistance(0.0, 0.0, 0)
    mean = total / sample
    variance = max(squares / sample - mean * mean, 0.0) * sample / max(sample - 1, 1)
    error = 0.0 if everything else math.sqrt(variance / sample) / SUM_UNITS
    return MeanDistance(mean / SUM_UNITS, error, sample)


def sums_of(best: NDArray[np.int64], step: float) -> Sums:
    """Return the sums for squared distances (q,) [steps^2], without those that are FAR."""
    distances = np.rint(np.sqrt(best[best < FAR].astype(np.float64)) * (step * SUM_UNITS)).astype(np.int64)
    total = squares = 0
    for begin in range(0, len(distances), 1 << 18):
        part = distances[begin : begin + (1 << 18)]
        if part.max() >= _SHORT:
            total, squares = total + sum(part.tolist()), squares + sum(d * d for d in part.tolist())
            continue
        high, low = part >> 22, part & ((1 << 22) - 1)
        total += int(part.sum())
        squares += (int((high * high).sum()) << 44) + (int((high * low).sum()) << 23) + int((low * low).sum())
    return Sums(total, squares, len(distances))


def refine_closest(
    left: PendingPoints,
    boxes: BoxTree,
    ask: Callable[
        [NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]], NDArray[np.int64]
    ],
) -> None:
    """Lower left.best by the points of other voxels, nearest boxes first, until none can be closer.

    ask(rows, starts, lattice, best): returns the new best (m,) of points (m, 3) queried in voxels:
    starts[i] to starts[i + 1] in rows[i]; rows ascend.
    """
    pending = np.arange(len(left.best))
    after = np.full((len(pending), 2), -1, np.int64)
    while len(pending):
        rows, distances = (np.empty((len(pending), _NEAR_VOXELS), np.int64) for _ in range(2))
        last = after[pending]
        near_boxes(boxes, left.lattice[pending], left.own[pending], left.best[pending], last, rows, distances)
        after[pending] = last
        query, column = np.nonzero(rows >= 0)
        if not len(query):
            return
        target = rows[query, column]
        order = np.argsort(target, kind="stable")
        query, target = pending[query[order]], target[order]
        begins = np.flatnonzero(np.diff(target, prepend=-1))
        found = ask(target[begins], np.append(begins, len(target)), left.lattice[query], left.best[query])
        # A point without a known distance queried one voxel only. A point whose candidates are
        # exhausted is done.
        again = (rows[:, -1] >= 0) | ((left.best[pending] >= FAR) & (rows[:, 0] >= 0))
        np.minimum.at(left.best, query, found)
        pending = pending[again]


def closest_in_own_voxel(archive: Archive, row: int, share: float) -> tuple[PendingPoints, NDArray[np.int64]]:
    """Find the closest other point, within one voxel, of its sampled distinct points.

    Return the points that may have a closer point elsewhere, and the squared distances [steps^2] of
    the others.
    """
    base, steps = _corners(archive)[row], archive.header.lattice.voxel_steps
    record = archive.open_voxel(row, columns=())
    parts = list(iter_points(record, base, limit=hash_limit(share)))
    nothing = np.empty(0, np.int64)
    if not parts:
        return PendingPoints(np.empty((0, 3), np.int64), nothing, nothing), nothing
    xyz, nodes = np.concatenate([p.xyz for p in parts]), np.concatenate([p.nodes for p in parts])
    first = first_of_each(xyz)
    queries, nodes = xyz[first].astype(np.int64), nodes[first]
    starts = np.flatnonzero(np.diff(nodes, prepend=-1))
    best = np.full(len(queries), FAR)
    groups = np.append(starts, len(queries))
    closest_in_record(leaves_of(record), spheres_of(record), queries, groups, nodes[starts], best)
    gap = np.minimum(queries + 1, steps - queries).min(axis=1)
    left = best > gap * gap
    own = np.full(int(left.sum()), row, np.int64)
    return PendingPoints(queries[left] + base, own, best[left]), best[~left]


def closest_in_other_voxel(
    archive: Archive, row: int, lattice: NDArray[np.int64], best: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Return the new best (q,) [steps^2] of points (q, 3) queried in another voxel."""
    record, best = archive.open_voxel(row, columns=()), best.copy()
    each = np.arange(len(best) + 1)
    home = np.full(len(best), -1, np.int32)
    closest_in_record(
        leaves_of(record), spheres_of(record), lattice - _corners(archive)[row], each, home, best
    )
    return best


def _corners(archive: Archive) -> NDArray[np.int64]:
    """Return the lattice coordinates of the corner of every voxel, (v, 3)."""
    return archive.coordinates * archive.header.lattice.voxel_steps


def _points(archive: Archive) -> NDArray[np.int64]:
    """Return the number of points of every voxel, (v,)."""
    return archive.voxels["rows"][:, 2].astype(np.int64)


def _own_sums(unit: _OwnUnit) -> tuple[Sums, PendingPoints]:
    """Return the sums of the points settled in a range of voxels, and the others.

    Runs in any process.
    """
    with Archive(unit.folder) as archive:
        sums, left = Sums(), []
        for row in unit.rows:
            still, done = closest_in_own_voxel(archive, row, unit.share)
            sums = sums.plus(sums_of(done, archive.header.lattice.step))
            left.append(still)
    return sums, PendingPoints(*(np.concatenate(column) for column in zip(*left, strict=True)))


def _other_unit(
    folder: Path,
    rows: NDArray[np.int64],
    starts: NDArray[np.int64],
    lattice: NDArray[np.int64],
    best: NDArray[np.int64],
    run: range,
) -> _OtherUnit:
    """Return the part of the queries that concerns rows[run]."""
    cuts = starts[run.start : run.stop + 1]
    a, b = int(cuts[0]), int(cuts[-1])
    return _OtherUnit(folder, rows[run.start : run.stop], cuts - a, lattice[a:b], best[a:b])


def _other_best(unit: _OtherUnit) -> NDArray[np.int64]:
    """Return `closest_in_other_voxel` of each voxel of a unit, concatenated; runs in any process."""
    with Archive(unit.folder) as archive:
        return np.concatenate(
            [
                closest_in_other_voxel(archive, int(row), unit.lattice[a:b], unit.best[a:b])
                for row, a, b in _runs(unit.rows, unit.starts)
            ]
        )


def _runs(rows: NDArray[np.int64], starts: NDArray[np.int64]) -> Iterator[tuple[int, int, int]]:
    """Return each row with the begin and end of its queries."""
    return zip(rows.tolist(), starts[:-1].tolist(), starts[1:].tolist(), strict=True)
