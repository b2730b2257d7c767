"""Contacts and clusters by brute force: every pair of points, in integers, sorted and grouped directly."""

import math
from itertools import product
from typing import NamedTuple

import naive
import numpy as np
from numpy.typing import ArrayLike, NDArray


class Pair(NamedTuple):
    """A pair in contact, comparable in the order of the answers. Lattice point, exact units.

    gap: see `gap_key`.  reach: r_a + r_b + margin of this pair.
    """

    gap: int
    point: tuple[int, int, int]
    center: tuple[int, int, int]
    row: int
    scan: int
    square: int
    reach: int


def gap_key(square: int, reach: int) -> int:
    """Return sqrt(square) - reach times 2^128, rounded down.

    Keys are ordered as the gaps, for squares below 2^62. If two roots differ by a whole number
    other
    than 0, both are whole and nothing is rounded. Otherwise, the difference is a root of a
    polynomial
    with integer coefficients: its product with its conjugates, three of at most 2^33, is an
    integer. It
    is therefore not below 2^-99.
    """
    return math.isqrt(square << 256) - (reach << 128)


class Cluster(NamedTuple):
    """A cluster: its deepest pair, its pairs, the box of its points [lattice]."""

    deepest: Pair
    count: int
    low: tuple[int, int, int]
    high: tuple[int, int, int]


def edge_steps(units: int, step: float) -> int:
    """Return the edge of a grid cell [steps] for a cluster distance in exact units.

    It is rounded up, except for its own rounding error.
    """
    steps = units / (step * naive.UNITS)
    whole = round(steps)
    close = abs(steps - whole) <= 1e-9 * whole + 1 / (step * naive.UNITS)
    return max(1, whole if close else math.ceil(steps))


def pairs_of(
    lattice: NDArray[np.int64],
    numbers: NDArray[np.int64],
    step: float,
    origin: ArrayLike,
    avatar: NDArray[np.float64],
    pose: NDArray[np.float64],
    reach: int | NDArray[np.int64],
) -> list[Pair]:
    """Return all pairs of scan points (n, 3) and a placed avatar (m, 3) in reach, deepest first.

    scans: (n,).  reach: r_a + r_b + margin, exact units, of all scan points or (n,) of each.
    """
    b, a = naive.scan_units(lattice, step), naive.placed_units(avatar, pose, origin)
    reaches = np.broadcast_to(np.asarray(reach, np.int64), len(b))
    found = []
    for row, center in enumerate(a):
        apart = np.abs(b - center)
        for at in np.flatnonzero((apart <= reaches[:, None]).all(axis=1)):
            square, own = sum(int(d) ** 2 for d in apart[at]), int(reaches[at])
            if square <= own * own:
                point, place = tuple(lattice[at].tolist()), tuple(center.tolist())
                found.append(Pair(gap_key(square, own), point, place, row, int(numbers[at]), square, own))
    return sorted(found)


def clusters_of(pairs: list[Pair], edge: int) -> tuple[list[Cluster], list[int]]:
    """Return the clusters of sorted pairs, deepest first, and each pair's cluster number.

    The search goes through grid cells.
    """
    cell_of = [tuple(c // edge for c in pair.point) for pair in pairs]
    touched, number = set(cell_of), {}
    count = 0
    for start in cell_of:  # pairs are sorted deepest first, and so are their clusters
        if start in number:
            continue
        number[start], queue = count, [start]
        while queue:
            cell = queue.pop()
            for by in product((-1, 0, 1), repeat=3):
                near = tuple(c + d for c, d in zip(cell, by, strict=True))
                if near in touched and near not in number:
                    number[near] = count
                    queue.append(near)
        count += 1
    of_pair = [number[cell] for cell in cell_of]
    clusters = []
    for i in range(count):
        own = [pair for pair, n in zip(pairs, of_pair, strict=True) if n == i]
        points = list(zip(*(pair.point for pair in own), strict=True))
        low, high = tuple(map(min, points)), tuple(map(max, points))
        clusters.append(Cluster(own[0], len(own), low, high))  # type: ignore[arg-type]
    return clusters, of_pair


def signed_distance(square: int, radii: int) -> float:
    """Return the signed distance of a pair [m], as `distance` defines it.

    It is sqrt(square) - radii without cancellation.
    """
    both = math.sqrt(float(square)) + float(radii)
    return float(square - radii * radii) / both / naive.UNITS if both else 0.0
