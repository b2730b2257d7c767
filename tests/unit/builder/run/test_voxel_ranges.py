"""Ranges of voxels hold every row once, with about as many points each, the largest first."""

import numpy as np
import pytest
from solidcloud.builder.run.executor import jobs_of, run_units, voxel_ranges
from solidcloud.builder.run.progress import Silent

M = 1 << 20


@pytest.mark.parametrize("jobs", [1, 2, 7])
@pytest.mark.parametrize("counts", [[5], [M] * 100, [1, 40 * M, 2, 3], [0, 0, 9 * M, 0], list(range(1000))])
def test_every_row_is_in_one_portion_and_the_largest_come_first(counts: list[int], jobs: int) -> None:
    points = np.array(counts)
    runs = voxel_ranges(points, jobs)
    assert sorted(row for run in runs for row in run) == list(range(len(points)))
    held = [int(points[list(run)].sum()) for run in runs]
    assert held == sorted(held, reverse=True)
    planned = max(M, int(points.sum()) // (8 * jobs))
    assert all(h - points[run.stop - 1] <= planned for h, run in zip(held, runs, strict=True))
    assert len(runs) <= points.sum() // planned + 1


def test_no_rows_are_no_portions() -> None:
    assert voxel_ranges(np.empty(0, np.int64), 2) == []


def test_without_an_executor_units_run_here_in_order() -> None:
    done: list[int] = []

    class Counting(Silent):
        def advance(self, amount: int) -> None:
            done.append(amount)

    assert list(run_units(None, lambda unit: unit * 2, [3, 1, 2], Counting(), lambda unit: unit)) == [6, 2, 4]
    assert done == [3, 1, 2] and jobs_of(None) == 1
