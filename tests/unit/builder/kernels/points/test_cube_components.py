"""Compare counts in cubes, components of touching cubes and those that hang with plain Python."""

import os
from collections import Counter

import numpy as np
import pytest
from numpy.typing import NDArray
from solidcloud.builder.kernels.points.cube_components import (
    MAX_CUBE,
    add_cubes,
    count_around,
    count_points,
    find_hanging,
    find_slots,
    join_cubes,
)

INTERPRETED = os.environ.get("NUMBA_DISABLE_JIT") == "1"
EDGE = 0.1
Cube = tuple[int, int, int]
AROUND = [(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)]


def table(size: int) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    return np.zeros((size, 3), np.int32), np.zeros(size, np.int64)


def held(cubes: NDArray[np.int32], counts: NDArray[np.int64]) -> dict[Cube, int]:
    """Return the content of a table."""
    return {tuple(cubes[slot].tolist()): int(counts[slot]) for slot in np.flatnonzero(counts)}


def judged_groups(numbers: dict[Cube, int]) -> list[set[Cube]]:
    """Return the components of cubes that touch, by flooding."""
    left, found = set(numbers), []
    while left:
        group, edge = set(), [left.pop()]
        while edge:
            x, y, z = edge.pop()
            group.add((x, y, z))
            near = {(x + a, y + b, z + c) for a, b, c in AROUND} & left
            left -= near
            edge += near
        found.append(group)
    return found


def judged_hanging(numbers: dict[Cube, int], few: int, deep: int) -> list[set[Cube]]:
    """Return the components that hang, by definition."""
    groups = judged_groups(numbers)
    large = {cube for group in groups if sum(numbers[c] for c in group) >= few for cube in group}
    found = []
    for group in groups:
        low = min(z for _, _, z in group)
        if not group & large and any(
            (x + a, y + b, low - down) in large
            for x, y, z in group
            if z == low
            for a in (-1, 0, 1)
            for b in (-1, 0, 1)
            for down in range(1, deep + 1)
        ):
            found.append(group)
    return found


@pytest.mark.parametrize("origin", [(0, 0, 0), (5, -7, 2)])
def test_points_are_counted_in_their_cubes(origin: Cube, rng: np.random.Generator) -> None:
    xyz = rng.normal(0.0, 0.5, (2000, 3))
    xyz[1::2] = xyz[::2]  # the same cube twice
    cubes, counts = table(1 << 12)
    known = np.zeros(1, np.int64)
    assert count_points(xyz, EDGE, np.array(origin), cubes, counts, known) == 2000
    expected = Counter(map(tuple, (np.floor(xyz / EDGE).astype(int) - origin).tolist()))
    assert held(cubes, counts) == expected and known[0] == len(expected)


def test_a_full_table_ends_it_and_a_larger_one_goes_on() -> None:
    xyz = (np.arange(40.0)[:, None] + 0.5) * EDGE * np.ones(3)
    cubes, counts = table(16)
    known = np.zeros(1, np.int64)
    assert count_points(xyz, EDGE, np.zeros(3, np.int64), cubes, counts, known) == 12
    more, numbers = table(64)
    assert add_cubes(cubes[counts > 0], counts[counts > 0], more, numbers) == 12
    assert count_points(xyz[12:], EDGE, np.zeros(3, np.int64), more, numbers, known) == 28
    assert known[0] == 40 and held(more, numbers) == {(k, k, k): 1 for k in range(40)}
    # Those that are in it are added to.
    assert add_cubes(cubes[counts > 0], 2 * counts[counts > 0], more, numbers) == 0
    assert held(more, numbers) == {(k, k, k): 3 if k < 12 else 1 for k in range(40)}
    slots = np.empty(12, np.int64)
    find_slots(cubes[counts > 0], more, numbers, slots)
    assert np.array_equal(more[slots], cubes[counts > 0])


def test_cubes_beyond_the_limit_are_counted_at_it() -> None:
    xyz = np.array([[1e9, -1e9, 0.05], [9e8, -9e8, 0.05]])
    cubes, counts = table(16)
    count_points(xyz, EDGE, np.zeros(3, np.int64), cubes, counts, np.zeros(1, np.int64))
    assert held(cubes, counts) == {(MAX_CUBE, -MAX_CUBE, 0): 2}


@pytest.mark.parametrize("size", [1 << 9, 1 << 11])
@pytest.mark.parametrize(("span", "few", "deep"), [(6, 12, 2), (9, 8, 3), (12, 5, 6), (30, 3, 20)])
def test_groups_are_those_of_brute_force(
    size: int, span: int, few: int, deep: int, rng: np.random.Generator
) -> None:
    for _ in range(2 if INTERPRETED else 20):
        chosen = np.unique(rng.integers(-span, span, (rng.integers(1, 300), 3)), axis=0).astype(np.int32)
        numbers = rng.integers(1, 4, len(chosen))
        cubes, counts = table(size)
        assert add_cubes(chosen, numbers, cubes, counts) == len(chosen)
        parents, points, around, lowest = (np.full(size, 7, np.int64) for _ in range(4))
        hangs = np.ones(size, np.bool_)
        join_cubes(cubes, counts, parents, points)
        content = held(cubes, counts)
        groups: dict[int, set[Cube]] = {}
        for slot in np.flatnonzero(counts).tolist():
            groups.setdefault(int(parents[slot]), set()).add(tuple(cubes[slot].tolist()))
        assert (parents[counts == 0] == -1).all()
        assert sorted(map(sorted, groups.values())) == sorted(map(sorted, judged_groups(content)))
        for root, group in groups.items():
            assert points[root] == sum(content[cube] for cube in group)
        assert points.sum() == numbers.sum()
        find_hanging(cubes, counts, parents, points, few, deep, lowest, hangs)
        found = [groups[root] for root in np.flatnonzero(hangs).tolist()]
        assert sorted(map(sorted, found)) == sorted(map(sorted, judged_hanging(content, few, deep)))
        count_around(cubes, counts, around)
        for slot in range(size):
            x, y, z = cubes[slot].tolist()
            expected = sum(content.get((x + a, y + b, z + c), 0) for a, b, c in AROUND)
            assert around[slot] == (expected if counts[slot] else 0)


@pytest.mark.parametrize(
    ("cube", "hangs"),
    [
        ((0, 0, 1), False),  # touches
        ((0, 0, 2), True),
        ((0, 0, 20), True),
        ((0, 0, 21), False),
        ((3, 0, 5), True),  # the floor ends at 2
        ((4, 0, 5), False),
        ((0, 0, -2), False),
    ],
)
def test_what_hangs_is_above_a_floor_and_near(cube: Cube, hangs: bool) -> None:
    floor = np.array([(x, y, 0) for x in range(-2, 3) for y in range(-2, 3)], np.int32)
    cubes, counts = table(64)
    add_cubes(floor, np.full(25, 10), cubes, counts)
    add_cubes(np.array([cube], np.int32), np.array([9]), cubes, counts)
    parents, points, lowest = (np.empty(64, np.int64) for _ in range(3))
    found = np.empty(64, np.bool_)
    join_cubes(cubes, counts, parents, points)
    find_hanging(cubes, counts, parents, points, 250, 20, lowest, found)
    assert found.sum() == hangs


def test_a_group_with_few_points_hangs_and_one_with_more_does_not() -> None:
    for number, hangs in ((99, True), (100, False)):
        cubes, counts = table(16)
        add_cubes(np.array([[0, 0, 0], [0, 0, 5]], np.int32), np.array([100, number]), cubes, counts)
        parents, points, lowest = (np.empty(16, np.int64) for _ in range(3))
        found = np.empty(16, np.bool_)
        join_cubes(cubes, counts, parents, points)
        find_hanging(cubes, counts, parents, points, 100, 20, lowest, found)
        assert found.any() == hangs
