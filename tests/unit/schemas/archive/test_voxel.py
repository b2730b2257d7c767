"""Compare `link_nodes` with a plain walk, and test every check of `check_voxel` alone."""

from collections.abc import Callable

import numpy as np
import pytest
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.voxel.voxel_octree import VoxelPoints, build_voxel
from solidcloud.schemas.archive.voxel import (
    CELL_BITS,
    MAX_DEGREE,
    MAX_LEAF,
    LeafCells,
    Nodes,
    VoxelData,
    check_voxel,
    link_nodes,
    top_shift,
)
from solidcloud.schemas.errors import CorruptError
from synthetic_scans import WITH_POINTS, make_steps

STEPS = 1000  # no power of two, so that cells stick out of the voxel


def built(kind: str = "noise", count: int = 300, **options: int) -> VoxelData:
    """A voxel of STEPS with several cells, some of them one leaf node, unless the options say otherwise."""
    config = BuildConfig(**{"cell_points": 60, "leaf": 8, "degree": 3, **options})
    return build_voxel(5, VoxelPoints(make_steps(kind, 1, count, STEPS)), STEPS, config)


def one_cell() -> VoxelData:
    """A voxel that is one cell, its tree three levels high."""
    return built(count=50, cell_points=1000)


def by_hand(counts: list[int], cell_nodes: list[int], cell_points: list[int]) -> VoxelData:
    """A voxel with these counts and everything else zero."""
    n, c, p = len(counts), len(cell_nodes), sum(cell_points)
    nodes = Nodes(
        np.zeros((n, 3), np.uint16), np.zeros(n, np.uint16), np.zeros((n, 3), np.int8), np.zeros((n, 2), np.int32),
        np.array(counts, np.uint8), np.zeros(n, np.uint8), np.zeros((n, 3), np.uint16),
    )  # fmt: skip
    low = np.zeros((c, 3), np.int32)
    cells = LeafCells(
        low, np.zeros(c, np.uint8), np.array(cell_nodes, np.uint32), np.array(cell_points, np.uint32)
    )
    return VoxelData(5, 0, cells, nodes, np.zeros((p, 3), np.uint16))


def plain_links(voxel: VoxelData) -> tuple[list[int], list[bool], list[int], int]:
    """first, is_leaf, cell and height as schemas/FORMAT.md tells it: level by level, with Python lists."""
    counts, cells = voxel.nodes.count.tolist(), voxel.cells
    n, c = len(counts), len(cells.nodes)
    first, leaf, cell_of = [-9] * n, [False] * n, [-9] * n
    top = n - sum(cells.nodes.tolist())

    def walk(root: int, others: range, below: int, cell: int) -> int:
        level, rest, levels = [root], list(others), 0
        while True:
            size = sum(counts[row] for row in level)
            children = rest[:size] if rest else list(range(below, below + size))
            for row in level:
                first[row], cell_of[row] = children[0], cell
                leaf[row] = not rest and cell >= 0
                children = children[counts[row] :]
            levels += 1
            if not rest:
                return levels
            level, rest = rest[:size], rest[size:]

    top_levels = walk(0, range(1, top), top, -1) if top else 0
    rest, point, heights = top + c, 0, []
    for i in range(c):
        held = int(cells.nodes[i])
        heights.append(walk(top + i, range(rest, rest + held - 1), point, i))
        rest += held - 1
        point += int(cells.points[i])
    return first, leaf, cell_of, top_levels + max(heights)


@pytest.mark.interpreted
@pytest.mark.parametrize("kind", WITH_POINTS)
@pytest.mark.parametrize("cell_points", [1, 20, 60, 10_000])
def test_links_equal_a_plain_walk(kind: str, cell_points: int) -> None:
    voxel = built(kind, 200, cell_points=cell_points)
    links = link_nodes(voxel)
    first, leaf, cell, height = plain_links(voxel)
    assert links.first.tolist() == first
    assert links.is_leaf.tolist() == leaf
    assert links.cell.tolist() == cell
    assert links.height == height


def change(part: str, field: str, at: object, value: object) -> Callable[[VoxelData], VoxelData]:
    """A function that sets one element of one column."""

    def apply(voxel: VoxelData) -> VoxelData:
        columns = getattr(voxel, part)
        column = getattr(columns, field).copy()
        column[at] = value
        return voxel._replace(**{part: columns._replace(**{field: column})})

    return apply


def shorten(part: str, field: str) -> Callable[[VoxelData], VoxelData]:
    """A function that leaves out the last row of one column."""

    def apply(voxel: VoxelData) -> VoxelData:
        columns = getattr(voxel, part)
        return voxel._replace(**{part: columns._replace(**{field: getattr(columns, field)[:-1]})})

    return apply


def no_cells(voxel: VoxelData) -> VoxelData:
    """No cells, though nodes and points are there."""
    return voxel._replace(cells=LeafCells(*(column[:0] for column in voxel.cells)))


def fewer_nodes(voxel: VoxelData) -> VoxelData:
    """Fewer nodes than the cells claim."""
    return voxel._replace(nodes=Nodes(*(column[:3] for column in voxel.nodes)))


def no_top(voxel: VoxelData) -> VoxelData:
    """Several cells and nothing over them."""
    top = len(voxel.nodes.count) - int(voxel.cells.nodes.sum())
    return voxel._replace(nodes=Nodes(*(column[top:] for column in voxel.nodes)))


def needless_top(voxel: VoxelData) -> VoxelData:
    """One cell and a node over it."""
    return voxel._replace(nodes=Nodes(*(np.concatenate([column[:1], column]) for column in voxel.nodes)))


def fewer_points(voxel: VoxelData) -> VoxelData:
    """A point less than the cells claim."""
    return voxel._replace(points=voxel.points[:-1])


def inner_row(voxel: VoxelData) -> int:
    """A node above leaf nodes, inside a cell."""
    links = link_nodes(voxel)
    return int(np.flatnonzero(~links.is_leaf & (links.cell >= 0))[0])


def at_inner(value: Callable[[int], int]) -> Callable[[VoxelData], VoxelData]:
    """Change the count of an inner node."""
    return lambda voxel: change(
        "nodes", "count", inner_row(voxel), value(int(voxel.nodes.count[inner_row(voxel)]))
    )(voxel)


def at_leaf(delta: int) -> Callable[[VoxelData], VoxelData]:
    """Change the count of the last leaf node."""
    return lambda voxel: change("nodes", "count", -1, int(voxel.nodes.count[-1]) + delta)(voxel)


def at_cell(field: str, value: Callable[[int], int]) -> Callable[[VoxelData], VoxelData]:
    """Change one number of the last cell."""
    return lambda voxel: change("cells", field, -1, value(int(getattr(voxel.cells, field)[-1])))(voxel)


def far_point(voxel: VoxelData) -> VoxelData:
    """A point moved by its cell's size."""
    points = voxel.points.copy()
    points[0, 1] += 1 << int(voxel.cells.log2_size[0])
    return voxel._replace(points=points)


def beyond_the_edge(voxel: VoxelData) -> VoxelData:
    """A point inside its cell, but beyond the voxel's edge, in a cell that sticks out."""
    cells = voxel.cells
    size = 1 << cells.log2_size.astype(np.int64)
    cell = int(np.flatnonzero(cells.low[:, 0] + size > STEPS)[0])
    points, lows = voxel.points.copy(), voxel.nodes.block_low
    links = link_nodes(voxel)
    node = int(np.flatnonzero(links.is_leaf & (links.cell == cell))[0])
    points[links.first[node], 0] = STEPS - int(cells.low[cell, 0]) - int(lows[node, 0])
    return voxel._replace(points=points)


FAULTS: dict[str, tuple[Callable[[], VoxelData], Callable[[VoxelData], VoxelData], str]] = {
    **{f"short cells.{f}": (built, shorten("cells", f), "columns of unequal length") for f in LeafCells._fields},
    **{f"short nodes.{f}": (built, shorten("nodes", f), "columns of unequal length") for f in Nodes._fields},
    "top unit": (built, lambda v: v._replace(top_shift=1), r"top unit 2\^1 steps, expected 2\^0"),
    "no cells": (built, no_cells, "nodes for 0 cells are inconsistent"),
    "a cell without nodes": (built, at_cell("nodes", lambda n: 0), "cells are inconsistent"),
    "a cell without points": (built, at_cell("points", lambda n: 0), "cells are inconsistent"),
    "fewer nodes than claimed": (built, fewer_nodes, "3 nodes for .* cells are inconsistent"),
    "no top over several cells": (built, no_top, "cells are inconsistent"),
    "a top over one cell": (one_cell, needless_top, "nodes for 1 cells are inconsistent"),
    "an inner node of none": (built, at_inner(lambda n: 0), r"counts of node \d+ do not"),
    "an inner node of fewer": (built, at_inner(lambda n: n - 1), r"counts of node \d+ do not"),
    "an inner node of more": (built, at_inner(lambda n: n + 1), r"counts of node \d+ do not"),
    "a top node of more": (built, change("nodes", "count", 0, 9), r"counts of node \d+ do not"),
    "a leaf node of none": (one_cell, change("nodes", "count", -1, 0), r"counts of node \d+ do not"),
    "a leaf node of more": (built, at_leaf(1), r"counts of node \d+ do not"),
    "a cell of more points": (built, at_cell("points", lambda n: n + 1), r"counts of node \d+ do not"),
    "a cell of more nodes": (built, at_cell("nodes", lambda n: n + 1), r"counts of node \d+ do not"),
    "fewer points than claimed": (built, fewer_points, "cells claim 300 points, found 299"),
    "a cell too large": (built, change("cells", "log2_size", 0, CELL_BITS + 1), "a cell larger than"),
    "a cell below zero": (built, change("cells", "low", (0, 2), -1024), "a cell off its grid or outside"),
    "a cell off its grid": (built, change("cells", "low", (0, 1), 1), "a cell off its grid or outside"),
    "a cell outside": (built, change("cells", "low", (0, 0), 1024), "a cell off its grid or outside"),
    "a leaf node too large": (
        lambda: by_hand([MAX_LEAF + 1], [1], [MAX_LEAF + 1]), lambda v: v, "a node over 32 points",
    ),
    "an inner node too large": (
        lambda: by_hand([MAX_DEGREE + 1] + [1] * (MAX_DEGREE + 1), [MAX_DEGREE + 2], [MAX_DEGREE + 1]),
        lambda v: v, "or 16 children",
    ),
    "an axis that is none": (built, change("nodes", "axis", -1, 3), "sort axis 3"),
    "a point outside its cell": (built, far_point, "a point outside its cell"),
    "a block outside its cell": (built, change("nodes", "block_low", (-1, 0), 65535), "a point outside its cell"),
    "a point outside the voxel": (built, beyond_the_edge, "a point outside its cell"),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_each_guard_refuses_its_own_fault(fault: str) -> None:
    make, spoil, message = FAULTS[fault]
    voxel = spoil(make())
    with pytest.raises(CorruptError, match=rf"voxel 0x5: .*{message}"):
        check_voxel(voxel, STEPS)


@pytest.mark.interpreted
@pytest.mark.parametrize("make", [built, one_cell])
def test_a_sound_voxel_passes_and_gives_its_links(make: Callable[[], VoxelData]) -> None:
    voxel = make()
    links, expected = check_voxel(voxel, STEPS), link_nodes(voxel)
    assert np.array_equal(links.first, expected.first)
    assert links.height == expected.height


@pytest.mark.parametrize(
    ("steps", "shift"), [(1, 0), (65535, 0), (65536, 0), (65537, 1), (131072, 1), (131073, 2), (1 << 21, 5)]
)
def test_top_unit_is_the_least_that_fits_the_voxel(steps: int, shift: int) -> None:
    assert top_shift(steps) == shift
    assert (steps - 1) >> shift < 1 << 16
    assert shift == 0 or (steps - 1) >> (shift - 1) >= 1 << 16
