"""Test the octree of a voxel: every point in exactly one cell, capacity, depth, bounds, and the cells' order."""

import os

import numpy as np
import pytest
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.spool.run_files import canonical_columns, row_codes
from solidcloud.builder.voxel.voxel_octree import VoxelPoints, build_voxel, gather_voxel
from solidcloud.schemas.archive.codec import encode_voxel
from solidcloud.schemas.archive.voxel import CELL_BITS, VoxelData, check_voxel
from synthetic_scans import make_steps

INTERPRETED = os.environ.get("NUMBA_DISABLE_JIT") == "1"
SIZES = [1000, 1 << 21]
KINDS = ["corner", "duplicates", "one point"]


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
@pytest.mark.parametrize("kind", KINDS)
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
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("steps", SIZES)
def test_every_node_of_a_voxel_encloses_its_points(kind: str, steps: int) -> None:
    voxel = build(make_steps(kind, 2, 200, steps), steps)
    assert not loose_nodes(voxel, steps)
    assert not loose_nodes(build(make_steps(kind, 2, 100, steps), steps, with_slab=False), steps)


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


@pytest.mark.parametrize("columns", [(), ("scan_index", "intensity")])
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
