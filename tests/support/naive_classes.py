"""Radius classes by the definition in schemas/FORMAT.md: every point against every other."""

from fractions import Fraction
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

# The figures of the definition, repeated here.
NEIGHBOURS = 24
LOCAL_NEIGHBOUR = 12
REACH = Fraction(362, 1000)
LADDER = [
    1000,
    1260,
    1587,
    2000,
    2520,
    3175,
    4000,
    5040,
    6350,
    8000,
    10079,
    12699,
    16000,
    20159,
    25398,
    32000,
]


class Judged(NamedTuple):
    """Result for one point: its local class, rim or not, and whether it has too few neighbours."""

    local: int
    rim: bool
    capped: bool


def closest_of(distinct: NDArray[np.int64], i: int, step: Fraction) -> list[tuple[int, ...]]:
    """Return offsets [steps] to the points that count for point i.

    They are sorted by distance, then by coordinates.
    """
    apart = distinct - distinct[i]
    d2 = (apart**2).sum(axis=1)
    order = np.lexsort((apart[:, 2], apart[:, 1], apart[:, 0], d2))
    order = order[(d2[order] > 0) & (d2[order] <= int(REACH**2 / step**2))]
    return [tuple(offset) for offset in apart[order[:NEIGHBOURS]].tolist()]


def square(offset: tuple[int, ...]) -> int:
    """Return the squared length."""
    return sum(c * c for c in offset)


def judge_point(closest: list[tuple[int, ...]], step: Fraction) -> Judged:
    """Return the class of a point with these neighbours, in fractions."""
    n = len(closest)
    if n < LOCAL_NEIGHBOUR:
        return Judged(len(LADDER) - 1, False, True)
    twelfth2 = square(closest[LOCAL_NEIGHBOUR - 1]) * step**2
    fits = [twelfth2 <= (13 * Fraction(radius, 1_000_000)) ** 2 for radius in LADDER]
    local = fits.index(True) if True in fits else len(LADDER) - 1
    mean2 = sum(Fraction(sum(axis), n) ** 2 for axis in zip(*closest, strict=True))
    return Judged(local, mean2 > Fraction(sum(map(square, closest)), n) / 6, False)


def judge(lattice: NDArray[np.int64], step: str) -> dict[tuple[int, ...], Judged]:
    """Return the classes of each distinct point (n, 3) [steps]. step: decimal text [m]."""
    distinct, size = np.unique(lattice, axis=0), Fraction(step)
    return {
        tuple(point): judge_point(closest_of(distinct, i, size), size)
        for i, point in enumerate(distinct.tolist())
    }
