"""Rays and points by brute force: every ray against every scan point, in plain numpy.

Uses no code of the project except `naive`. Exact units of 2^-26 m, as there.
"""

from fractions import Fraction
from math import isqrt
from typing import NamedTuple

import naive
import numpy as np
from numpy.typing import ArrayLike, NDArray


class Hits(NamedTuple):
    """Results of k rays or points.

    distance: (k,) [m], inf if none.  row: (k,) of the lattice point, -1 if none.  outside: (k,).
    """

    distance: NDArray[np.float64]
    row: NDArray[np.int64]
    outside: NDArray[np.bool_]


def world_units(points: ArrayLike, origin: ArrayLike) -> NDArray[np.int64]:
    """Return world positions (n, 3) in exact units from the dataset's origin."""
    return np.rint((np.asarray(points, np.float64) - np.asarray(origin, np.float64)) * naive.UNITS).astype(
        np.int64
    )


def unit_vectors(directions: ArrayLike) -> NDArray[np.float64]:
    """Return unit vectors (k, 3).

    Divides by the largest component, then by the root of (x x + y y) + z z.
    """
    array = np.asarray(directions, np.float64)
    scaled = array / np.abs(array).max(axis=1)[:, None]
    square = (scaled[:, 0] * scaled[:, 0] + scaled[:, 1] * scaled[:, 1]) + scaled[:, 2] * scaled[:, 2]
    return scaled / np.sqrt(square)[:, None]


def meetings(d: NDArray[np.int64], u: NDArray[np.float64], radii: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return t (n,) at which a ray hits spheres; inf if it misses.

    d: (n, 3), the spheres from the start.  u: (3,), direction.  radii: (n,).  All in exact units.
    """
    radius = radii.astype(np.float64)
    x, y, z = d.astype(np.float64).T
    along = (x * u[0] + y * u[1]) + z * u[2]
    cx, cy, cz = y * u[2] - z * u[1], z * u[0] - x * u[2], x * u[1] - y * u[0]
    miss = np.sqrt((cx * cx + cy * cy) + cz * cz)
    with np.errstate(invalid="ignore"):
        t = np.maximum(along - np.sqrt((radius - miss) * (radius + miss)), 0.0)
    t[~(along > 0) | (miss > radius)] = np.inf
    near = (np.abs(d) <= radii[:, None]).all(axis=1)
    near[near] = (d[near] ** 2).sum(axis=1) <= radii[near] ** 2
    t[near] = 0.0
    return t


def _least(keys: NDArray[np.float64] | NDArray[np.int64], b: NDArray[np.int64]) -> int:
    """Return the row of the least key; on ties, that of the least point."""
    rows = np.flatnonzero(keys == keys.min())
    return int(rows[np.lexsort(b[rows].T[::-1])[0]])


def raycast(
    points: ArrayLike,
    origin: ArrayLike,
    step: float,
    radius: ArrayLike,
    origins: ArrayLike,
    directions: ArrayLike,
    reach: float,
) -> Hits:
    """Return the first sphere that each ray hits.

    points: (n, 3) world, n at least 1. radius: [m], of all or (n,) of each.
    """
    b = naive.scan_units(naive.lattice_of(points, origin, step), step)
    o, u = world_units(origins, origin), unit_vectors(directions)
    reach_units = int(np.rint(reach * naive.UNITS))
    radii = np.rint(np.broadcast_to(np.asarray(radius, np.float64), len(b)) * naive.UNITS).astype(np.int64)
    distance, row = np.full(len(o), np.inf), np.full(len(o), -1)
    for i in range(len(o)):
        t = meetings(b - o[i], u[i], radii)
        if t.min() <= reach_units:
            row[i], distance[i] = _least(t, b), t.min() / naive.UNITS
    ends = np.stack([o.astype(np.float64), o + float(reach_units) * u])
    outside = ((ends < b.min(axis=0)) | (ends > b.max(axis=0))).any(axis=(0, 2))
    return Hits(distance, row, outside)


def within(points: ArrayLike, origin: ArrayLike, step: float, loose: ArrayLike, reach: float) -> Hits:
    """Return the scan point nearest to each given point. points: (n, 3) world, n at least 1."""
    b = naive.scan_units(naive.lattice_of(points, origin, step), step)
    q = world_units(loose, origin)
    reach_units = int(np.rint(reach * naive.UNITS))
    distance, row = np.full(len(q), np.inf), np.full(len(q), -1)
    for i in range(len(q)):
        d = b - q[i]
        near = np.flatnonzero((np.abs(d) <= reach_units).all(axis=1))  # their squares fit into 63 bits
        square = (d[near] ** 2).sum(axis=1)
        if len(near) and square.min() <= reach_units**2:
            row[i] = near[_least(square, b[near])]
            distance[i] = np.sqrt(np.float64(square.min())) / naive.UNITS
    outside = ((q - reach_units < b.min(axis=0)) | (q + reach_units > b.max(axis=0))).any(axis=1)
    return Hits(distance, row, outside)


def ideal_miss(d: list[int], direction: list[float]) -> tuple[Fraction, Fraction]:
    """Return |d x u|^2 and (d .

    u)^2 of a point at d from the start of a ray, exactly, for the given direction.
    """
    w = [Fraction(c) for c in direction]
    length = sum(c * c for c in w)
    dot = sum(a * c for a, c in zip(d, w, strict=True))
    cross = [d[1] * w[2] - d[2] * w[1], d[2] * w[0] - d[0] * w[2], d[0] * w[1] - d[1] * w[0]]
    return sum((c * c for c in cross), Fraction(0)) / length, dot * dot / length


def root(value: Fraction, bits: int = 80) -> Fraction:
    """Return the root of a fraction, rounded down to 2^-bits."""
    scaled = value.numerator * (1 << (2 * bits)) // value.denominator
    return Fraction(isqrt(scaled), 1 << bits)
