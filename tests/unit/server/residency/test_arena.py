"""The arena: runs that never overlap, never leave the buffer, and join again."""

import re
from itertools import pairwise

import numpy as np
import pytest
from solidcloud.server.residency.arena import ALIGNMENT, ArenaBuffer


@pytest.mark.parametrize("budget", [0, 1, 63])
def test_a_budget_below_a_cache_line_holds_nothing(budget: int) -> None:
    buffer = ArenaBuffer(budget)
    assert buffer.free_runs() == [] and buffer.allocate(1) is None


def test_runs_are_taken_best_fit_and_joined() -> None:
    buffer = ArenaBuffer(64 * 6)
    a, b, c = buffer.allocate(64), buffer.allocate(65), buffer.allocate(1)
    assert (a, b, c) == (0, 64, 192)
    assert buffer.free_runs() == [(256, 128)]
    buffer.release(0, 64)
    buffer.release(192, 1)  # joins what is free behind it
    assert buffer.free_runs() == [(0, 64), (192, 192)]
    assert buffer.allocate(64 * 4) is None, "256 bytes are free, but not in one run"
    buffer.release(64, 65)  # joins both sides
    assert buffer.free_runs() == [(0, 384)]
    assert buffer.largest_run() == (0, 384)
    assert buffer.allocate(384) == 0 and buffer.free_runs() == []
    assert buffer.largest_run() == (-1, 0)
    buffer.release(0, 128)
    buffer.release(256, 64)
    assert buffer.allocate(64) == 256, "the run that just suffices, though another comes first"


def test_random_use_against_a_model(rng: np.random.Generator) -> None:
    """The model: an array of owners, one a cache line."""
    lines = 50
    buffer, owners, held = ArenaBuffer(lines * ALIGNMENT), np.zeros(lines, int), {}
    for number in range(1, 1500):
        if held and rng.random() < 0.5:
            owner = list(held)[rng.integers(len(held))]
            buffer.release(*held.pop(owner))
            owners[owners == owner] = 0
        else:
            size = int(rng.integers(1, 12 * ALIGNMENT))
            taken = buffer.rounded(size) // ALIGNMENT
            offset = buffer.allocate(size)
            free = "".join("." if owner == 0 else "x" for owner in owners)
            fits = [(len(run[0]), run.start()) for run in re.finditer(r"\.+", free) if len(run[0]) >= taken]
            at = min(fits)[1] if fits else -1
            assert (offset if offset is not None else -ALIGNMENT) == at * ALIGNMENT
            if offset is not None:
                owners[at : at + taken] = number
                held[number] = (offset, size)
        runs = buffer.free_runs()
        assert buffer.largest_run()[1] == max((size for _, size in runs), default=0)
        assert sum(size for _, size in runs) == (owners == 0).sum() * ALIGNMENT
        assert all(a + size < b for (a, size), (b, _) in pairwise(runs))
