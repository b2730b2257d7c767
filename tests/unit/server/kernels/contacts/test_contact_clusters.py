"""The parts that gather pairs: a heap, a hash of grid cells, union-find. Each against the plain way."""

import numpy as np
import pytest
from naive_contacts import Pair, clusters_of, gap_key
from solidcloud.server.kernels.contacts.contact_cells import (
    CELLS,
    CLUSTER,
    DEFICIT,
    HIGH,
    KEPT,
    LOW,
    ORDER,
    PAIRS,
    PLACE,
    RECORD,
    SQUARE,
    TAG,
    ContactState,
    empty_cells,
    enter_cell,
    find_slot,
    grow_cells,
    keep_deepest,
    make_cells,
    sort_rows,
)
from solidcloud.server.kernels.contacts.contact_clusters import list_pose
from solidcloud.server.runtime.stop_flag import NO_STOP

pytestmark = pytest.mark.interpreted


def random_records(rng: np.random.Generator, count: int) -> np.ndarray:
    """Records with many ties in their first columns, also of gaps of unlike pairs: 2 less 1 is 1 less 0."""
    records = rng.integers(-2, 3, (count, RECORD))
    records[:, SQUARE] = rng.choice([0, 1, 2, 4, 9], count)
    records[:, DEFICIT] = rng.integers(0, 3, count)
    return records


def place_of(record: list[int]) -> tuple[int, ...]:
    """What a record is sorted by."""
    return gap_key(record[SQUARE], -record[DEFICIT]), *record[DEFICIT + 1 : ORDER]


@pytest.mark.parametrize("limit", [1, 2, 7, 64])
def test_the_deepest_are_kept_whatever_the_order(rng: np.random.Generator, limit: int) -> None:
    records = random_records(rng, 150)
    records[:, TAG] = 0
    expected = [place_of(record) for record in sorted(records.tolist(), key=place_of)[:limit]]
    for _ in range(3):
        heap, kept = np.empty((limit, RECORD), np.int64), 0
        for record in rng.permutation(records):
            kept = keep_deepest(heap, kept, record[None])
        sort_rows(heap, kept, NO_STOP.flag)
        assert [place_of(record) for record in heap[:kept].tolist()] == expected


def test_nothing_is_kept_without_room(rng: np.random.Generator) -> None:
    assert keep_deepest(np.empty((0, RECORD), np.int64), 0, random_records(rng, 1)) == 0


@pytest.mark.parametrize("count", [0, 1, 2, 3, 100])
def test_rows_are_sorted_by_all_columns_that_order(rng: np.random.Generator, count: int) -> None:
    rows = random_records(rng, count)
    rows[:, TAG] = np.arange(count)
    expected = sorted(map(place_of, rows.tolist()))
    before = {tuple(row) for row in rows.tolist()}
    sort_rows(rows, count, NO_STOP.flag)
    assert [place_of(row) for row in rows.tolist()] == expected
    assert {tuple(row) for row in rows.tolist()} == before


def test_a_cell_is_found_again_through_growth_and_after_emptying(rng: np.random.Generator) -> None:
    # Multiples of the hash's mask collide; negative and far coordinates are as good as others.
    places = np.concatenate(
        [
            rng.integers(-4, 4, (60, 3)),
            rng.integers(-3, 3, (60, 3)) << 21,
            rng.integers(-(1 << 50), 1 << 50, (9, 3)),
        ]
    )
    cells = make_cells(32, NO_STOP.flag)
    for _ in range(2):
        rows: dict[tuple[int, ...], int] = {}
        for place in map(tuple, places.tolist()):
            if len(rows) == len(cells.table):
                cells = grow_cells(cells, len(rows), NO_STOP.flag)
            row = enter_cell(cells, len(rows), *place)
            assert row == rows.setdefault(place, len(rows))
        for place, row in rows.items():
            assert cells.slots[find_slot(cells, *place)] == row
            assert tuple(cells.table[row, PLACE:].tolist()) == place
        assert len(cells.slots) == 2 * len(cells.table) < 4 * max(32, len(rows))
        empty_cells(cells, len(rows), NO_STOP.flag)
        assert (cells.slots == -1).all()


@pytest.mark.parametrize("spread", [2, 4, 8])
def test_neighbouring_cells_are_one_cluster(rng: np.random.Generator, spread: int) -> None:
    """One pair a cell; three poses in turn, so that nothing of one is left for the next."""
    memory = ContactState(
        make_cells(64, NO_STOP.flag), np.empty((10, RECORD), np.int64), np.array([0, 0, 0, 0, -1]),
        np.zeros(3, np.int64), np.empty((1, 2), np.int64), np.empty((0, RECORD), np.int64),
        np.empty((0, CLUSTER), np.int64),
    )  # fmt: skip
    for _ in range(3):
        places = np.unique(rng.integers(-spread, spread, (40, 3)), axis=0)
        squares, drops = rng.integers(0, 9, len(places)).tolist(), rng.integers(0, 3, len(places)).tolist()
        pairs = [
            Pair(gap_key(square, -drop), tuple(place), (0, 0, 0), 0, -1, square, -drop)
            for square, drop, place in zip(squares, drops, places.tolist(), strict=True)
        ]
        for pair in pairs:
            row = enter_cell(memory.cells, memory.sizes[CELLS], *pair.point)
            assert row == memory.sizes[CELLS]
            memory.sizes[CELLS] += 1
            record = np.array([[pair.square, -pair.reach, *pair.point, 0, 0, 0, 0, -1, row]])
            memory.cells.table[row, :ORDER] = record[0, :ORDER]
            memory.cells.table[row, PAIRS : PAIRS + 7] = [1, *pair.point, *pair.point]
            memory.sizes[KEPT] = keep_deepest(memory.heap, memory.sizes[KEPT], record)
        runs = np.empty(4, np.int64)
        memory, listed = list_pose(memory, runs, NO_STOP.flag)
        assert listed
        clusters, of_pair = clusters_of(sorted(pairs), 1)
        own = memory.clusters[runs[2] : runs[2] + runs[3]]
        assert own[:, PAIRS].tolist() == [cluster.count for cluster in clusters]
        assert own[:, SQUARE].tolist() == [cluster.deepest.square for cluster in clusters]
        assert own[:, DEFICIT].tolist() == [-cluster.deepest.reach for cluster in clusters]
        boxes = [tuple(row) for row in own[:, LOW : HIGH + 3].tolist()]
        assert boxes == [(*c.low, *c.high) for c in clusters]
        assert memory.pairs[runs[0] : runs[0] + runs[1], TAG].tolist() == of_pair[:10]
        assert (memory.cells.slots == -1).all() and memory.sizes[CELLS] == 0
