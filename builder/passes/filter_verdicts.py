"""Application of the filter rules (filter_rules.py) to one block and its surroundings."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ..kernels.neighbours.filter_counts import best_of_cells, count_others, other_scans
from ..spool.run_files import row_codes
from ..spool.spool_blocks import Block, BlockReader, Box, Grid, NearPoints
from .filter_rules import MOVING, OUTLIER, THINNED, Reach, Rules

# Verdict of a kept point. A verdict v > 0 means left out for REASONS[v - 1].
KEPT = 0
REASONS = (MOVING, OUTLIER, THINNED)


def near_verdicts(block: Block, reader: BlockReader, rules: Rules) -> NDArray[np.uint8]:
    """Return the verdicts of `moving` and `outliers`."""
    verdict = np.full(len(block.rows), KEPT, np.uint8)
    if rules.outliers is not None:
        verdict[_is_outlier(block, reader, rules.outliers)] = 1 + REASONS.index(OUTLIER)
    if rules.moving is not None and rules.seen is not None:
        alone = (
            _scans_around(block, reader, rules.moving, np.ones(len(block.rows), np.bool_))
            < rules.moving.number
        )
        if alone.any():
            seen = _scans_around(block, reader, rules.seen, alone) >= rules.seen.number
            verdict[alone & seen] = 1 + REASONS.index(MOVING)
    return verdict


def _pieces(
    block: Block, reader: BlockReader, reach: Reach, left: NDArray[np.bool_]
) -> Iterator[tuple[NearPoints, NDArray[np.int64], NDArray[np.int32], Grid]]:
    """Yield the points within reach of undecided query points, piece by piece.

    left: (n,), mask of undecided points, which the caller updates; the iteration ends when none is
    left. Each item: a piece of the surroundings, the indices of the undecided points in the order
    of their cells, their positions, and the grid. The block's own points come first, because in
    dense places they decide every query.
    """
    low, high = block.bounds()
    box = low - reach.steps, high + reach.steps
    own = NearPoints.of(block.rows, block.low - box[0])
    grid = Grid.over(box, reach.steps)

    def queries() -> NDArray[np.int64]:
        which = np.flatnonzero(left)
        return which[np.argsort(grid.cells(own.positions[which]), kind="stable")]

    which = queries()
    yield own, which, own.positions[which], grid
    which = queries()
    if not len(which):
        return
    low, high = own.positions[which].min(axis=0) + box[0], own.positions[which].max(axis=0) + box[0]
    base, box = box[0], (low - reach.steps, high + reach.steps)
    grid = Grid.over(box, reach.steps)
    own = own._replace(positions=own.positions - (box[0] - base).astype(np.int32))
    for piece in reader.around(block, box):
        which = queries()
        if not len(which):
            return
        yield piece, which, own.positions[which], grid


def _is_outlier(block: Block, reader: BlockReader, reach: Reach) -> NDArray[np.bool_]:
    """Return a mask of the points with too few others around them."""
    counts = np.zeros(len(block.rows), np.int64)
    left = np.ones(len(block.rows), np.bool_)
    for piece, which, queries, grid in _pieces(block, reader, reach, left):
        positions = piece.positions
        cells = grid.cells(positions)
        order = np.lexsort((*positions.T, cells))
        positions, cells = positions[order], cells[order]
        first = np.append(True, (positions[1:] != positions[:-1]).any(axis=1))
        positions, cells = positions[first], cells[first]
        found = counts[which]
        count_others(
            queries,
            grid.cells(queries),
            positions,
            cells,
            grid.across,
            grid.deep,
            reach.squared,
            reach.number,
            found,
        )
        counts[which] = found
        left[which] = found < reach.number
    return counts < reach.number


def _scans_around(
    block: Block, reader: BlockReader, reach: Reach, asked: NDArray[np.bool_]
) -> NDArray[np.int64]:
    """Count the other scans, up to `reach.number`, with a point within reach of each point.

    asked: mask of the points to count for; the result is 0 for all others.
    """
    counts = np.zeros(len(block.rows), np.int64)
    found = np.full((len(block.rows), reach.number), -1, np.int64)
    scans = block.rows["scan_index"].astype(np.int64)
    left = asked.copy()
    for piece, which, queries, grid in _pieces(block, reader, reach, left):
        cells = grid.cells(piece.positions)
        order = np.lexsort((piece.scans, cells))
        of, cells = piece.scans[order], cells[order]
        starts = np.flatnonzero(np.append(True, (cells[1:] != cells[:-1]) | (of[1:] != of[:-1])))
        rows, held = found[which], counts[which]
        other_scans(
            queries, grid.cells(queries), scans[which], piece.positions[order],
            np.append(starts, len(of)), cells[starts], of[starts], grid.across, grid.deep, reach.squared, rows, held,
        )  # fmt: skip
        found[which], counts[which] = rows, held
        left[which] = held < reach.number
    return counts


def thin_verdicts(block: Block, reader: BlockReader, edge: int) -> NDArray[np.uint8]:
    """Return the verdicts of `thin`. Each cube keeps the best of its points, over all voxels."""
    low, high = block.bounds()
    box = low // edge * edge, high // edge * edge + (edge - 1)
    grid = Grid.over(box, edge)
    own = NearPoints.of(block.rows, block.low - box[0])
    best = _best(own, grid, edge)
    cells = grid.cells(own.positions[best])
    candidates = [own.taken(best)]
    if _lies_across(block, box, reader.spool.lattice.voxel_steps):
        for piece in reader.around(block, box):
            rival = piece.taken(np.isin(grid.cells(piece.positions), cells))
            if len(rival.scans):
                candidates.append(rival.taken(_best(rival, grid, edge)))
    # The block's own points come first, so that one of several equal points is found here and in no
    # other block: points equal to it are at the same position and therefore in the same block.
    chosen = _best(NearPoints.joined(candidates), grid, edge)
    verdict = np.full(len(block.rows), 1 + REASONS.index(THINNED), np.uint8)
    verdict[best[chosen[chosen < len(best)]]] = KEPT
    return verdict


def _lies_across(block: Block, box: Box, voxel_steps: int) -> bool:
    """Return whether lattice cubes of a block's points reach beyond the block."""
    low = block.low + block.corner
    high = np.minimum(low + block.size, block.low + voxel_steps)
    return bool((box[0] < low).any() or (box[1] >= high).any())


def _best(points: NearPoints, grid: Grid, edge: int) -> NDArray[np.int64]:
    """Return the index of the best point of each cube, ordered by cube."""
    cells = grid.cells(points.positions)
    inside = points.positions % edge
    away = (2 * inside.astype(np.int64) - (edge - 1)) ** 2
    return np.asarray(
        best_of_cells(
            np.argsort(cells, kind="stable"),
            cells,
            away.sum(axis=1),
            _codes_of(inside),
            points.scans,
            points.intensities,
            points.looks,
        )
    )


def _codes_of(positions: NDArray[np.int32]) -> NDArray[np.uint64]:
    """Return the Morton codes (n,) of positions (n, 3) in a cube no larger than a voxel."""
    rows = np.empty(len(positions), [("local", "<i4", (3,))])
    rows["local"] = positions
    return row_codes(rows)
