"""A heap is the cell that it would be of its points held at once, its columns in their order, and little is held."""

import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import solidcloud.builder.build_limits as build_limits
from dense_voxels import KEY, assert_same, decoded, hashed, spooled
from numpy.typing import NDArray
from sample_sizes import sample
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.spool.run_files import canonical_columns
from solidcloud.builder.spool.spool import Spool
from solidcloud.builder.voxel import dense_record
from solidcloud.builder.voxel.coincident_points import heap_place, heap_trees, merge_runs
from solidcloud.builder.voxel.dense_voxel import build_dense
from solidcloud.builder.voxel.voxel_octree import VoxelPoints, build_trees, build_voxel
from solidcloud.schemas.kernels.morton import morton_code

PLACE = (77, 5, 901)
CODE = int(morton_code(*(np.uint64(x) for x in PLACE)))
BOTH = ("scan_index", "intensity")
ALL = (*BOTH, "rgb", "classification")
DTYPE = np.dtype(
    [
        ("local", "<i4", (3,)),
        ("scan_index", "<u2"),
        ("intensity", "<f4"),
        ("rgb", "u1", (3,)),
        ("classification", "u1"),
    ]
)


def heap_of(count: int, *, scans: int = 1 << 16, names: tuple[str, ...] = BOTH) -> NDArray:
    """Rows of the spool of one place, of many different columns: of some values many, of others one."""
    rng = np.random.default_rng(8)
    rows = np.zeros(count, [("local", "<i4", (3,)), *((name, DTYPE[name]) for name in names)])
    rows["local"] = PLACE
    if "scan_index" in names:
        rows["scan_index"] = rng.integers(0, scans, count)
    if "intensity" in names:
        rows["intensity"] = rng.normal(0, 1e3, count).astype(np.float32)
        rows["intensity"][::3] = rng.choice(
            np.array([0, -1, 1e-40, np.inf, -np.inf, np.nan], np.float32), len(rows[::3])
        )
    for name in {"rgb", "classification"} & set(names):
        rows[name] = rng.choice(np.array([0, 1, 255], np.uint8), rows[name].shape)
    return rows


def in_order(rows: NDArray) -> NDArray:
    """Rows of one place in canonical order."""
    return rows[np.lexsort((*canonical_columns(rows), np.zeros(len(rows))))]


def windows(rows: NDArray, most: int) -> Iterator[NDArray]:
    """Rows a few at a time."""
    return (rows[at : at + most] for at in range(0, len(rows), most))


@pytest.mark.parametrize(
    "names", [ALL, BOTH, ("scan_index",), ("intensity",), ("rgb",), ("classification",), ()], ids=",".join
)
@pytest.mark.parametrize("scans", [3, 1 << 16])
def test_runs_are_merged_in_canonical_order(names: tuple[str, ...], scans: int) -> None:
    rows = heap_of(3000, scans=scans, names=names)
    expected = in_order(rows)
    for cuts in ([], [1], [1000, 1001, 2500], list(range(40, 3000, 40))):
        for most in (1, 7, 5000):
            runs = [windows(in_order(part), most) for part in np.split(rows, cuts)]
            found = np.concatenate(list(merge_runs(runs)))
            assert found.tobytes() == expected.tobytes()


def test_what_comes_in_turn_is_read_in_turn() -> None:
    """As of scans of one place each: of a run that comes later no more than its first window is read."""
    rows = in_order(heap_of(6000, scans=60))
    read = [0, 0]

    def noted(number: int, part: NDArray) -> Iterator[NDArray]:
        for window in windows(part, 100):
            read[number] += len(window)
            yield window

    merged = merge_runs([noted(1, rows[3000:]), noted(0, rows[:3000])])
    assert sum(len(next(merged)) for _ in range(25)) == 2500
    assert read == [2600, 100]
    assert sum(map(len, merged)) == 3500 and read == [3000, 3000]


@pytest.mark.parametrize("count", [201, 5000, 70_001])
@pytest.mark.parametrize(
    "config", [BuildConfig(), BuildConfig(leaf=3, degree=2), BuildConfig(leaf=1, degree=3)]
)
def test_the_cell_is_that_of_its_points(count: int, config: BuildConfig) -> None:
    assert heap_place(CODE).tolist() == [list(PLACE)]
    points = np.repeat(heap_place(CODE), count, axis=0)
    expected = build_trees(points, np.zeros(1, np.int64), np.zeros(1, np.uint8), config)
    found = heap_trees(CODE, count, config)
    for name in set(found._fields) - {"xyz", "rank", "nodes"}:
        assert np.array_equal(getattr(found, name), getattr(expected, name)), name
    for column, other in zip(found.nodes, expected.nodes, strict=True):
        assert column.dtype == other.dtype and np.array_equal(column, other)


@pytest.mark.parametrize("classified", [True, False])
@pytest.mark.parametrize("names", [BOTH, ("scan_index",), ("intensity",), ()], ids=",".join)
def test_a_heap_of_many_pairs_is_the_voxel_built_at_once(
    names: tuple[str, ...], classified: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(build_limits, "DENSE_POINTS", 500)
    monkeypatch.setattr(dense_record, "WINDOW_POINTS", 70)
    heap = heap_of(5000, names=names)
    around = heap_of(300, names=names)
    around["local"] += np.random.default_rng(2).integers(-20, 20, (300, 3)).astype(np.int32) * [0, 0, 1]
    rows = np.random.default_rng(3).permutation(np.concatenate([heap, around]))
    config = BuildConfig(cell_points=60, leaf=8, degree=3)
    whole = VoxelPoints(
        rows["local"],
        rows["scan_index"] if "scan_index" in names else None,
        rows["intensity"] if "intensity" in names else None,
        hashed(rows["local"], range(0)) if classified else None,
    )
    asked, counted = [], 0

    def classify(local: NDArray[np.int32], codes: range, times: int) -> NDArray[np.uint8]:
        nonlocal counted
        asked.append(len(local))
        counted += times * len(local)
        return hashed(local, codes)

    spool = spooled(tmp_path / "spool", rows, 1000, [400, 410, 3000])
    built = build_dense(KEY, spool, config, bytes(16), tmp_path, classify if classified else None)
    found, expected = decoded(built, 1000), build_voxel(KEY, whole, 1000, config)
    if "intensity" in names:  # not equal where they are NaN
        assert found.intensity is not None and expected.intensity is not None
        assert found.intensity.tobytes() == expected.intensity.tobytes()
        found, expected = found._replace(intensity=None), expected._replace(intensity=None)
    assert_same(found, expected)
    assert counted == classified * len(rows)
    # The heap is asked once, by one point.
    assert max(asked, default=0) <= 500 and sum(asked) <= 1 + len(around)


def test_what_is_held_of_a_heap_is_a_part(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Points in parts of 2,000: rows and all that sorts them would be 75 bytes a point; the nodes take most of 6.75.

    That is 30 and 2.7 MB of 400,000 points.
    """
    count, most = sample((150_000, 2_400_000), (400_000, 3_500_000))
    monkeypatch.setattr(build_limits, "DENSE_POINTS", 2000)
    monkeypatch.setattr(dense_record, "WINDOW_POINTS", 1000)
    config = BuildConfig()
    spool = spooled(tmp_path / "spool", heap_of(count), 1000, list(range(0, count, 30_000)))
    small = spooled(tmp_path / "small", heap_of(3000), 1000, [])
    build_dense(KEY, small, config, bytes(16), tmp_path)  # what is compiled and loaded once
    assert len(spool.keys) == 1
    tracemalloc.start()
    try:
        record = build_dense(KEY, spool, config, bytes(16), tmp_path).record
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert record.point_rows == count
    assert peak < most


def test_a_run_cut_short_is_told(tmp_path: Path) -> None:
    """Its rows are read as late as they are wanted."""
    rows = heap_of(100)
    spool = spooled(tmp_path / "spool", rows, 1000, [50])
    parts = spool.block_windows(KEY, CODE, CODE + 1, 20)
    assert [[len(window) for window in part] for part in parts] == [[10] * 5] * 2
    assert isinstance(spool, Spool) and len(spool.block_windows(KEY, CODE, CODE + 1, 1)) == 2
    assert spool.block_windows(KEY, CODE + 1, CODE + 2, 20) == []
