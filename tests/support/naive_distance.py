"""The nearest pair by definition: every pair of points, in Python's integers."""

import math
from decimal import Context, Decimal
from typing import NamedTuple

import naive
import numpy as np
from numpy.typing import ArrayLike, NDArray

# Two gaps sqrt(D) - R are equal or, because their conjugates are below 2^40, differ by more than
# 2^-120, which 80 digits show. Equal gaps give equal numbers: roots that are not whole numbers
# differ by a whole number only if D is equal.
DIGITS = Context(prec=80)


class Nearest(NamedTuple):
    """The nearest pair of one pose.

    square: |a - b|^2 [exact units]. lattice: b [steps]. placed: a [exact units].

    radius: of b's sphere [exact units].
    """

    square: int
    lattice: tuple[int, int, int]
    placed: tuple[int, int, int]
    radius: int


def nearest(
    lattice: NDArray[np.int64], step: float, radii: NDArray[np.int64], placed: NDArray[np.int64]
) -> Nearest:
    """Return the nearest pair of lattice points (n, 3) and placed centres (m, 3), n, m > 0.

    It has the least |a - b| - radius, with radii (n,). Ties: the least lattice point, then the
    least
    placed centre.
    """
    b = naive.scan_units(lattice, step)
    apart = (placed[:, None] - b).reshape(-1, 3)
    roots = np.sqrt((apart.astype(np.float64) ** 2).sum(axis=1))
    nearly = roots - np.tile(radii, len(placed))
    # The error of float64 is below 10^-15 of a root: the least is among those within 10^-9 of the
    # apparent least.
    at_least = nearly.argmin()
    found = []
    for at in np.flatnonzero(nearly <= nearly[at_least] + 1e-9 * (1.0 + roots[at_least])).tolist():
        square = sum(d * d for d in apart[at].tolist())
        a, scan = divmod(at, len(b))
        pair = Nearest(square, tuple(lattice[scan].tolist()), tuple(placed[a].tolist()), int(radii[scan]))
        found.append((Decimal(square).sqrt(DIGITS) - pair.radius, pair.lattice, pair.placed, pair))
    return min(found)[-1]


def signed_distance(square: int, radii: int) -> float:
    """Return the signed distance [m] of spheres.

    Their centres are sqrt(square) apart, their radii r_a + r_b, exact units.
    """
    both = math.sqrt(float(square)) + float(radii)
    return float(square - radii * radii) / both / naive.UNITS if both else 0.0


class Expected(NamedTuple):
    """Expected answer of `distance` for one pose; None if nothing is within reach. radii: r_a + r_b."""

    signed: float
    witness_avatar: list[float]
    witness_cloud: list[float]
    normal: list[float]
    square: int
    radii: int


def distance(
    points: ArrayLike,
    origin: ArrayLike,
    step: float,
    scan_radius: float,
    avatar: NDArray[np.float64],
    avatar_radius: float,
    poses: NDArray[np.float64],
    reach: float,
) -> list[Expected | None]:
    """Return the exact nearest pair under each of the poses (k, 4, 4).

    All scan points (n, 3) [m] have one radius.
    """
    lattice = naive.lattice_of(points, origin, step)
    radii = np.full(len(lattice), np.rint(scan_radius * naive.UNITS)).astype(np.int64)
    return distance_by_radii(lattice, origin, step, radii, avatar, avatar_radius, poses, reach)


def distance_by_radii(
    lattice: NDArray[np.int64],
    origin: ArrayLike,
    step: float,
    radii: NDArray[np.int64],
    avatar: NDArray[np.float64],
    avatar_radius: float,
    poses: NDArray[np.float64],
    reach: float,
) -> list[Expected | None]:
    """Return nearest pairs as `distance` does, for lattice points (n, 3) of several radii.

    radii: (n,) [exact units].
    """
    answers: list[Expected | None] = []
    for pose in poses:
        found = nearest(lattice, step, radii, naive.placed_units(avatar, pose, origin))
        if found.square > (naive.reach_units(avatar_radius, 0.0, reach) + found.radius) ** 2:
            answers.append(None)
            continue
        both = naive.reach_units(avatar_radius, 0.0, 0.0) + found.radius
        scan = naive.scan_units(np.array([found.lattice]), step)[0].tolist()
        length = math.sqrt(float(found.square))
        normal = [(a - b) / length if length else 0.0 for a, b in zip(found.placed, scan, strict=True)]
        answers.append(
            Expected(
                signed_distance(found.square, both),
                [a / naive.UNITS + float(o) for a, o in zip(found.placed, origin, strict=True)],
                [b * step + float(o) for b, o in zip(found.lattice, origin, strict=True)],
                normal,
                found.square,
                both,
            )
        )
    return answers
