"""Test the octree of a voxel: every point in exactly one cell, capacity, depth, bounds, and the cells' order."""

import os
from itertools import pairwise

import numpy as np
import pytest
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.kernels.points.octree_cells import (
    by_axis,
    by_cell,
    first_at_least,
    is_ascending,
    merge_order,
    split_octree,
    voxel_codes,
)
from solidcloud.builder.spool.run_files import canonical_columns, row_codes
from solidcloud.builder.voxel.voxel_octree import VoxelPoints, build_voxel, gather_voxel
from solidcloud.schemas.archive.codec import encode_voxel
from solidcloud.schemas.archive.voxel import CELL_BITS, VoxelData, check_voxel
from synthetic_scans import WITH_POINTS, make_steps

INTERPRETED = os.environ.get("NUMBA_DISABLE_JIT") == "1"
SIZES = [1000, 65536, 200_000, 1 << 21]


def build(points: np.ndarray, steps: int, **options: object) -> VoxelData:
    """The voxel of some points, in small cells unless the options say otherwise."""
    config = BuildConfig(**{"cell_points": 40, "leaf": 8, "degree": 4, **options})
    return build_voxel(9, VoxelPoints(points.astype(np.int32)), steps, config)


def runs_below(voxel: VoxelData, steps: int) -> tuple[list[np.ndarray], list[int], list[np.ndarray]]:
    """The points (k, 3) below every node, its unit and its corner [steps]; by recursion."""
    links = check_voxel(voxel, steps)
    counts = voxel.nodes.count.tolist()
    below: list[np.ndarray] = [np.empty((0, 3))] * len(counts)

    def collect(node: int) -> np.ndarray:
        first, held = int(links.first[node]), counts[node]
        if links.is_leaf[node]:
            corner = voxel.cells.low[links.cell[node]].astype(np.int64) + voxel.nodes.block_low[node]
            below[node] = voxel.points[first : first + held] + corner
        else:
            below[node] = np.concatenate([collect(child) for child in range(first, first + held)])
        return below[node]

    collect(0)
    units = [1 if cell >= 0 else 1 << voxel.top_shift for cell in links.cell]
    corners = [voxel.cells.low[cell] if cell >= 0 else np.zeros(3, np.int64) for cell in links.cell]
    return below, units, corners


def loose_nodes(voxel: VoxelData, steps: int) -> list[int]:
    """Nodes whose sphere or slab does not hold every point below them, judged with Python integers."""
    nodes, loose = voxel.nodes, []
    for node, (points, unit, corner) in enumerate(zip(*runs_below(voxel, steps), strict=True)):
        center = corner.astype(object) + nodes.center[node].astype(object) * unit
        apart = points.astype(object) - center
        normal = nodes.normal[node].astype(object)
        along = (apart * normal).sum(axis=1)
        inside = max((apart * apart).sum(axis=1)) <= (int(nodes.radius[node]) * unit) ** 2
        if any(normal):
            inside &= int(nodes.slab[node, 0]) <= min(along) and max(along) <= int(nodes.slab[node, 1])
        if not inside:
            loose.append(node)
    return loose


def sorted_rows(points: np.ndarray) -> list[list[int]]:
    """Rows in an order of their own."""
    return sorted(points.tolist())


@pytest.mark.interpreted
@pytest.mark.parametrize("kind", WITH_POINTS)
@pytest.mark.parametrize("steps", SIZES)
def test_every_point_is_in_exactly_one_cell(kind: str, steps: int) -> None:
    points = make_steps(kind, 1, 200, steps)
    voxel = build(points, steps)
    size = 1 << voxel.cells.log2_size.astype(np.int64)
    low = voxel.cells.low.astype(np.int64)
    inside = (points[:, None] >= low) & (points[:, None] < low + size[:, None])
    assert (inside.all(axis=2).sum(axis=1) == 1).all()
    assert inside.all(axis=2).sum(axis=0).tolist() == voxel.cells.points.tolist()
    assert (voxel.cells.points <= 40).all() or kind == "duplicates"
    assert voxel.cells.log2_size.max() <= CELL_BITS
    assert sorted_rows(runs_below(voxel, steps)[0][0]) == sorted_rows(points)


@pytest.mark.interpreted
@pytest.mark.parametrize("kind", WITH_POINTS)
@pytest.mark.parametrize("steps", SIZES)
def test_every_node_of_a_voxel_encloses_its_points(kind: str, steps: int) -> None:
    voxel = build(make_steps(kind, 2, 200, steps), steps)
    assert not loose_nodes(voxel, steps)
    assert not loose_nodes(build(make_steps(kind, 2, 100, steps), steps, with_slab=False), steps)


def test_a_cell_is_split_only_when_it_must_be() -> None:
    points = make_steps("noise", 1, 500, 1000)
    voxel = build(points, 1000)
    for low, log2 in zip(voxel.cells.low, voxel.cells.log2_size, strict=True):
        size = 2 << int(log2)
        parent = low // size * size
        assert ((points >= parent) & (points < parent + size)).all(axis=1).sum() > 40


@pytest.mark.interpreted
def test_a_cell_may_be_full() -> None:
    codes = np.sort(voxel_codes(make_steps("noise", 3, 40, 64)))
    assert [column.tolist() for column in split_octree(codes, 6, 6, 40)] == [[0], [6]]
    assert len(split_octree(codes, 6, 6, 39)[0]) > 1
    assert set(split_octree(codes, 6, 5, 40)[1].tolist()) == {5}, (
        "cells above the largest are split, full or not"
    )
    corners = np.arange(8, dtype=np.uint64)
    assert [column.tolist() for column in split_octree(corners, 1, 1, 7)] == [list(range(8)), [0] * 8]


@pytest.mark.interpreted
def test_points_on_cell_borders_are_in_one_cell() -> None:
    # NUMERICS.md case 10: the border belongs to the cell above it.
    borders = np.array([[x, y, z] for x in (511, 512) for y in (511, 512) for z in (0, 999)])
    voxel = build(borders, 1000, cell_points=1)
    assert voxel.cells.points.tolist() == [1] * 8
    cells = sorted(map(tuple, (voxel.cells.low >= 512).tolist()))
    assert len(set(cells)) == 8


@pytest.mark.interpreted
@pytest.mark.parametrize("steps", [1, 1 << 21])
def test_identical_points_end_in_one_cell_of_one_step(steps: int) -> None:
    # NUMERICS.md cases 7 and 12: one leaf over capacity, the depth bounded by the lattice step.
    count, capacity = (1_000, 400) if INTERPRETED else (10_000, 4096)
    points = np.full((count, 3), steps - 1)
    voxel = build(points, steps, leaf=32, degree=8, cell_points=capacity)
    assert voxel.cells.points.tolist() == [count]
    assert voxel.cells.log2_size.tolist() == [0]
    assert not voxel.points.any()
    assert not voxel.nodes.radius.any()
    check_voxel(voxel, steps)


@pytest.mark.interpreted
def test_identical_points_among_others_are_one_cell_over_capacity() -> None:
    points = np.concatenate([np.full((300, 3), 77), make_steps("noise", 1, 100, 1000)])
    voxel = build(points, 1000)
    assert sorted(voxel.cells.points.tolist())[-1] >= 300
    assert (np.sort(voxel.cells.points)[:-1] <= 40).all()
    assert not loose_nodes(voxel, 1000)


@pytest.mark.interpreted
@pytest.mark.parametrize("capacity", [1, 5, 300])
def test_cells_are_runs_of_the_sorted_codes(capacity: int) -> None:
    codes = np.sort(voxel_codes(make_steps("corner", 1, 200, 1 << 16)))
    starts, log2_size = split_octree(codes, 16, 12, capacity)
    assert starts[0] == 0
    assert (np.diff(starts) > 0).all()
    assert log2_size.max() <= 12
    for lo, hi, log2 in zip(starts, np.append(starts[1:], len(codes)), log2_size, strict=True):
        prefixes = {int(code) >> (3 * int(log2)) for code in codes[lo:hi]}
        assert len(prefixes) == 1
        assert hi - lo <= capacity or log2 == 0
    prefixes = [(int(codes[a]) >> (3 * int(b)), int(b)) for a, b in zip(starts, log2_size, strict=True)]
    assert len(set(prefixes)) == len(prefixes)


@pytest.mark.interpreted
@pytest.mark.parametrize("kind", WITH_POINTS)
def test_all_leaf_nodes_of_a_hierarchy_are_on_one_level(kind: str) -> None:
    voxel = build(make_steps(kind, 4, 300, 1000), 1000)
    links = check_voxel(voxel, 1000)
    top = len(voxel.nodes.count) - int(voxel.cells.nodes.sum())

    def depths(node: int) -> set[int]:
        """Levels from a node of a cell's BSH down to its leaf nodes."""
        if links.is_leaf[node]:
            return {0}
        first = int(links.first[node])
        children = range(first, first + int(voxel.nodes.count[node]))
        return {1 + d for child in children for d in depths(child)}

    for cell in range(len(voxel.cells.nodes)):
        assert len(depths(top + cell)) == 1


@pytest.mark.interpreted
def test_any_order_of_points_gives_the_same_voxel() -> None:
    rng = np.random.default_rng(0)
    points = make_steps("duplicates", 1, 300, 1000)
    columns = rng.integers(0, 3, 300).astype(np.uint16), rng.integers(0, 3, 300).astype(np.float32)
    order = rng.permutation(300)
    config = BuildConfig(cell_points=20, leaf=8)
    a = build_voxel(9, VoxelPoints(points, *columns), 1000, config)
    b = build_voxel(9, VoxelPoints(points[order], *(c[order] for c in columns)), 1000, config)
    for x, y in zip((*a.cells, *a.nodes, *a[4:]), (*b.cells, *b.nodes, *b[4:]), strict=True):
        assert np.array_equal(x, y)


def test_columns_stay_with_their_points() -> None:
    points = make_steps("noise", 1, 300, 1000)
    intensity = (points @ [1, 1000, 1_000_000]).astype(np.float32)
    voxel = build_voxel(
        9, VoxelPoints(points, points[:, 0].astype(np.uint16), intensity), 1000, BuildConfig(cell_points=50)
    )
    found = runs_below(voxel, 1000)[0][0]
    assert np.array_equal(voxel.scan_index, found[:, 0])
    assert np.array_equal(voxel.intensity, (found @ [1, 1000, 1_000_000]).astype(np.float32))


@pytest.mark.interpreted
@pytest.mark.parametrize("sizes", [[5], [4, 4], [1, 30, 2], [0, 7, 7, 7, 3], [9, 1, 1, 1, 1, 1, 8]])
def test_sorted_runs_are_merged_stably(sizes: list[int]) -> None:
    rng = np.random.default_rng(3)
    runs = [np.sort(rng.integers(0, 12, n)).astype(np.uint64) for n in sizes]
    codes, starts = np.concatenate(runs), np.cumsum([0, *sizes])
    before = codes.copy()
    assert merge_order(codes, starts).tolist() == np.argsort(codes, kind="stable").tolist()
    assert np.array_equal(codes, before)
    assert is_ascending(np.sort(codes))
    assert not is_ascending(np.append(np.sort(codes), np.uint64(0)))


@pytest.mark.parametrize("columns", [(), ("scan_index",), ("scan_index", "intensity")])
def test_a_voxel_gathered_from_runs_is_the_voxel(columns: tuple[str, ...]) -> None:
    rng = np.random.default_rng(8)
    kinds = {"scan_index": "<u2", "intensity": "<f4"}
    rows = np.zeros(600, [("local", "<i4", (3,)), *((name, kinds[name]) for name in columns)])
    rows["local"] = make_steps("duplicates", 1, 600, 1000)
    for name in columns:
        rows[name] = rng.integers(-2, 3, 600) + 2
    if "intensity" in columns:
        rows["intensity"][::3] = np.nan
    order = [
        np.lexsort((*canonical_columns(part), row_codes(part))) for part in np.split(rows, [7, 300, 420])
    ]
    parts = [part[by] for part, by in zip(np.split(rows, [7, 300, 420]), order, strict=True)]
    plain = VoxelPoints(rows["local"], *(rows[name] for name in columns))
    config = BuildConfig(cell_points=20, leaf=8)
    a, b = build_voxel(9, plain, 1000, config), build_voxel(9, gather_voxel(parts), 1000, config)
    assert encode_voxel(a, bytes(16)) == encode_voxel(b, bytes(16))


@pytest.mark.interpreted
def test_the_first_that_is_not_below_is_found_in_every_part() -> None:
    values = np.array([0, 1, 1, 1, 4, 9, 9, 2**63, 2**64 - 1], np.uint64)
    wanted = np.unique(np.concatenate([values, values + np.uint64(1), values - np.uint64(1)]))
    for lo in range(len(values) + 1):
        for hi in range(lo, len(values) + 1):
            for value in wanted:
                expected = lo + np.searchsorted(values[lo:hi], value)
                assert first_at_least(values, lo, hi, value) == expected, (lo, hi, value)


@pytest.mark.interpreted
@pytest.mark.parametrize("sizes", [[1], [3, 1, 4], [2, 7, 1, 1, 9]])
def test_a_cells_axes_stand_side_by_side(sizes: list[int]) -> None:
    starts = np.cumsum([0, *sizes])
    xyz = np.arange(3 * starts[-1], dtype=np.uint16).reshape(3, -1) + 500
    flat = by_cell(xyz, starts)
    expected = [xyz[:, a:b].ravel() for a, b in pairwise(starts)]
    assert flat.tolist() == np.concatenate(expected).tolist()
    assert np.array_equal(by_axis(flat, starts), xyz)
    # Any run of cells alone.
    some = slice(3 * int(starts[len(sizes) // 2]), None)
    rest = starts[len(sizes) // 2 :]
    assert np.array_equal(by_axis(flat[some], rest - rest[0]), xyz[:, rest[0] :])
