"""Test the context of queries: splitting the voxels of a request."""

import pytest
from fake_store import BLOCK, FakeStore
from solidcloud.server.queries.context.query_context import parts_that_fit
from solidcloud.server.residency.voxel_cache import VoxelCache


@pytest.mark.interpreted
def test_parts_that_fit_look_at_each_row_once() -> None:
    looks = 0

    class Counting(list[int]):
        def __getitem__(self, row: int) -> int:  # type: ignore[override]
            nonlocal looks
            looks += 1
            return super().__getitem__(row)

    blocks = [1, 2, 1, 4, 9, 1, 1, 1, 1, 1] * 100
    residency = VoxelCache(FakeStore(blocks), 9 * BLOCK)
    residency._sizes = Counting(residency._sizes)
    parts = list(parts_that_fit(residency, range(len(blocks)), 4 * BLOCK))
    assert [row for part in parts for row in part] == list(range(len(blocks)))
    assert parts[:4] == [[0, 1, 2], [3], [4], [5, 6, 7, 8]], "a row that takes more stands alone"
    assert looks == len(blocks)
    assert list(parts_that_fit(residency, [], BLOCK)) == []
