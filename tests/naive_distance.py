"""The judge of `distance`: the nearest pair by its definition, every pair of points, in Python's integers."""

import math
from typing import NamedTuple

import naive
import numpy as np
from numpy.typing import ArrayLike, NDArray


class Nearest(NamedTuple):
    """The nearest pair of one pose. square: |a - b|^2 [exact units].  lattice: b [steps].  placed: a [exact units]."""

    square: int
    lattice: tuple[int, int, int]
    placed: tuple[int, int, int]


def nearest(lattice: NDArray[np.int64], step: float, placed: NDArray[np.int64]) -> Nearest:
    """The nearest pair of lattice points (n, 3) and placed centres (m, 3), n, m > 0: of those at equal distance the one
    with the least lattice point, then the least placed centre."""
    b = naive.scan_units(lattice, step)
    apart = (placed[:, None] - b).reshape(-1, 3)
    nearly = (apart.astype(np.float64) ** 2).sum(axis=1)
    # float64 is off by less than 10^-15 of a square: the least is among those within 10^-9 of the least.
    found = []
    for at in np.flatnonzero(nearly <= nearly.min() * (1 + 1e-9)).tolist():
        square = sum(d * d for d in apart[at].tolist())
        a, scan = divmod(at, len(b))
        found.append((square, tuple(lattice[scan].tolist()), tuple(placed[a].tolist())))
    return Nearest(*min(found))


def signed_distance(square: int, radii: int) -> float:
    """The signed distance [m] of spheres whose centres are sqrt(square) apart, radii r_a + r_b, exact units."""
    both = math.sqrt(float(square)) + float(radii)
    return float(square - radii * radii) / both / naive.UNITS if both else 0.0


class Expected(NamedTuple):
    """What `distance` must answer for one pose; None instead where nothing is within reach."""

    signed: float
    witness_avatar: list[float]
    witness_cloud: list[float]
    normal: list[float]
    square: int


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
    """The nearest pair under each of the poses (k, 4, 4), to the last bit."""
    lattice = naive.lattice_of(points, origin, step)
    answers: list[Expected | None] = []
    for pose in poses:
        found = nearest(lattice, step, naive.placed_units(avatar, pose, origin))
        if found.square > naive.reach_units(pose, avatar_radius, scan_radius, reach) ** 2:
            answers.append(None)
            continue
        radii = naive.reach_units(pose, avatar_radius, scan_radius, 0.0)
        scan = naive.scan_units(np.array([found.lattice]), step)[0].tolist()
        length = math.sqrt(float(found.square))
        normal = [(a - b) / length if length else 0.0 for a, b in zip(found.placed, scan, strict=True)]
        answers.append(
            Expected(
                signed_distance(found.square, radii),
                [a / naive.UNITS + float(o) for a, o in zip(found.placed, origin, strict=True)],
                [b * step + float(o) for b, o in zip(found.lattice, origin, strict=True)],
                normal,
                found.square,
            )
        )
    return answers
