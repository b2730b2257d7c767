"""Test the shape of packed trees: every item once, leaf nodes on one level, nodes as full as possible."""

import numpy as np
import pytest
from point_hierarchy import Tree, build_hierarchy
from solidcloud.builder.kernels.trees.pack_tree import max_nodes, node_counts, pack_tree
from synthetic_scans import make_steps

pytestmark = pytest.mark.interpreted

SHAPES = [(1, 2), (5, 4), (32, 16)]


def pack(points: np.ndarray, leaf: int, degree: int) -> Tree:
    """The tree of some points."""
    return Tree(*pack_tree(points.astype(np.int32), leaf, degree))


def assert_is_a_tree(tree: Tree, n: int, leaf: int, degree: int) -> None:
    """Runs nest, children follow in order, every level is cut from the one above it."""
    assert sorted(tree.order.tolist()) == list(range(n))
    levels = tree.levels.tolist()
    assert levels[0] == 0
    assert levels[-1] == len(tree.begin) == len(tree.end) == len(tree.count)
    for above, below, past in zip(levels[:-2], levels[1:-1], levels[2:], strict=True):
        child = below
        for node in range(above, below):
            held = int(tree.count[node])
            assert 1 <= held <= degree
            assert tree.begin[child] == tree.begin[node]
            assert tree.end[child + held - 1] == tree.end[node]
            assert (
                tree.begin[child + 1 : child + held].tolist() == tree.end[child : child + held - 1].tolist()
            )
            child += held
        assert child == past
    sizes = (tree.end - tree.begin)[levels[-2] :]
    assert (sizes == tree.count[levels[-2] :]).all()
    assert sizes.min() >= 1
    assert sizes.max() <= leaf


@pytest.mark.parametrize(("leaf", "degree"), SHAPES)
@pytest.mark.parametrize("n", [1, 32, 33, 200])
def test_any_number_of_points_packs(n: int, leaf: int, degree: int) -> None:
    tree = pack(make_steps("noise", n, n, 1000), leaf, degree)
    assert_is_a_tree(tree, n, leaf, degree)
    leaves = -(-n // leaf)
    assert len(tree.count) - tree.levels[-2] == leaves  # as few leaf nodes as can be: all full but one
    height = 0
    while degree**height < leaves:
        height += 1
    assert len(tree.levels) == height + 2  # and as few levels


@pytest.mark.parametrize("kind", ["duplicates", "one point"])
def test_scans_pack_into_full_leaf_nodes(kind: str) -> None:
    points = make_steps(kind, 1, 300, 1000)
    tree = pack(points, 8, 4)
    assert_is_a_tree(tree, len(points), 8, 4)
    sizes = tree.count[tree.levels[-2] :]
    assert (sizes < 8).sum() <= 1


def test_leaves_are_sorted_along_their_longest_edge() -> None:
    points = make_steps("corner", 1, 200, 1000).astype(np.int32)
    found, packed = build_hierarchy(points, leaf=16, degree=4), pack(points, 16, 4)
    tree = found.tree
    assert tree.begin.tolist() == packed.begin.tolist()
    for node in range(tree.levels[-2], len(tree.begin)):
        run = slice(tree.begin[node], tree.end[node])
        block = points[tree.order[run]]
        assert np.array_equal(found.points[run], block)
        assert sorted(tree.order[run]) == sorted(packed.order[run])
        assert found.axis[node] == np.ptp(block, axis=0).argmax()
        assert (np.diff(block[:, found.axis[node]]) >= 0).all()
        assert np.array_equal(found.block_low[node], block.min(axis=0))
    assert not found.axis[: tree.levels[-2]].any()
    assert not found.block_low[: tree.levels[-2]].any()


def plain_leaves(points: np.ndarray, leaf: int, degree: int) -> list[set[int]]:
    """The points of every leaf node in order, by sorting whole runs where the kernel only partitions them."""

    def cut(rows: list[int], parts: int) -> list[list[int]]:
        if parts == 1:
            return [rows]
        axis = np.ptp(points[rows], axis=0).argmax()
        rows = sorted(rows, key=lambda row: (points[row, axis], row))
        at = -(-len(rows) // leaf) * (parts // 2) // parts * leaf
        return cut(rows[:at], parts // 2) + cut(rows[at:], parts - parts // 2)

    def grow(rows: list[int], capacity: int) -> list[set[int]]:
        if capacity == 1:
            return [set(rows)]
        leaves = -(-len(rows) // leaf)
        parts = -(-leaves // (capacity // degree))
        return [found for part in cut(rows, parts) for found in grow(part, capacity // degree)]

    capacity = 1
    while capacity * leaf < len(points):
        capacity *= degree
    return grow(list(range(len(points))), capacity)


@pytest.mark.parametrize("kind", ["noise", "duplicates"])
@pytest.mark.parametrize(("n", "leaf", "degree"), [(33, 2, 3), (150, 7, 5)])
def test_parts_are_cut_along_their_longest_edge_ties_by_rank(
    kind: str, n: int, leaf: int, degree: int
) -> None:
    points = make_steps(kind, n, n, 50)
    tree = pack(points, leaf, degree)
    leaves = range(tree.levels[-2], len(tree.begin))
    found = [set(tree.order[tree.begin[i] : tree.end[i]].tolist()) for i in leaves]
    assert found == plain_leaves(points, leaf, degree)


@pytest.mark.parametrize(("leaf", "degree"), SHAPES)
def test_the_counts_of_a_tree_need_no_points(leaf: int, degree: int) -> None:
    for n in [*range(1, 40), 64, 65, 130, 257]:
        tree = pack(make_steps("noise", n, n, 1000), leaf, degree)
        count, held = (np.empty(max_nodes(n, leaf), kind) for kind in (np.uint8, np.int64))
        total = node_counts(n, leaf, degree, count, held)
        assert count[:total].tolist() == tree.count.tolist()
        assert held[:total].tolist() == (tree.end - tree.begin).tolist()
