"""Poses and contacts along a motion: by the documented formula, and by definition with high precision.

Plain Python and numpy, without code of the project except `naive`. `pose_at` is the documented
float64 formula (server/kernels/motion/screw_motion.py), operation by operation. `ideal_pose` is
exp(t log(M1 M0^-1)) M0 in 60 decimal digits.
"""

import math
from decimal import Decimal, localcontext
from typing import Any

import naive
import numpy as np
from numpy.typing import ArrayLike, NDArray

DIGITS = 60


def _sine_cosine(x: float) -> tuple[float, float]:
    square, s, c = x * x, 0.0, 0.0
    for n in range(10, -1, -1):
        s = s * square + (-1.0) ** n / math.factorial(2 * n + 1)
    for n in range(11, -1, -1):
        c = c * square + (-1.0) ** n / math.factorial(2 * n)
    return s * x, c


def _cross(u: Any, v: Any) -> list[Any]:
    return [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]]


def _turn(u: Any, s: Any, c: Any, v: Any) -> list[Any]:
    once = _cross(u, v)
    twice = _cross(u, once)
    return [a + (2 * s * c * b + 2 * s * s * d) for a, b, d in zip(v, once, twice, strict=True)]


def _turn_back(u: Any, s: Any, c: Any, v: Any) -> list[Any]:
    return [c * a - s * b for a, b in zip(v, _cross(u, v), strict=True)]


def _quaternion(turn: list[list[Any]]) -> tuple[Any, Any, Any, Any]:
    """Return w, x, y, z of a rotation, not normalised, by the largest of the four."""
    a, b, c = turn[0][0], turn[1][1], turn[2][2]
    x, y, z = turn[2][1] - turn[1][2], turn[0][2] - turn[2][0], turn[1][0] - turn[0][1]
    xy, zx, yz = turn[0][1] + turn[1][0], turn[2][0] + turn[0][2], turn[1][2] + turn[2][1]
    if a + b + c >= max(a, b, c):
        return 1 + a + b + c, x, y, z
    if a >= b and a >= c:
        return x, 1 + a - b - c, xy, zx
    if b >= c:
        return y, xy, 1 + b - a - c, yz
    return z, zx, yz, 1 + c - a - b


def pose_at(first: NDArray[np.float64], last: NDArray[np.float64], t: float) -> NDArray[np.float64]:
    """Return M(t) (4, 4), bit for bit."""
    if t <= 0:
        return first.copy()
    if t >= 1:
        return last.copy()
    m0, m1 = first.tolist(), last.tolist()
    square0 = square1 = 0.0
    for r in range(3):
        for k in range(3):
            square0 += m0[r][k] * m0[r][k]
            square1 += m1[r][k] * m1[r][k]
    size = math.sqrt(square0 / 3.0 * (square1 / 3.0))
    turn = [
        [(m1[r][0] * m0[k][0] + m1[r][1] * m0[k][1] + m1[r][2] * m0[k][2]) / size for k in range(3)]
        for r in range(3)
    ]
    w, x, y, z = _quaternion(turn)
    size = math.sqrt(w * w + x * x + y * y + z * z)
    if next((v for v in (w, x, y, z) if v != 0), 1.0) < 0:
        size = -size
    w, x, y, z = w / size, x / size, y / size, z / size
    sine, half, u = math.sqrt(x * x + y * y + z * z), 0.0, [1.0, 0.0, 0.0]
    if sine >= 1e-30:
        u = [x / sine, y / sine, z / sine]
        half = sine if sine <= w else 0.5 * math.pi - w
        for _ in range(3):
            s, c = _sine_cosine(min(max(half, 0.0), 0.5 * math.pi))
            half += sine * c - w * s
        half = min(max(half, 0.0), 0.5 * math.pi)
    sine, cosine = _sine_cosine(half)
    dot = 0.0
    for r in range(3):
        dot += u[r] * (m1[r][3] - m0[r][3])
    along = [dot * v for v in u]
    across = [(m1[r][3] - m0[r][3]) - along[r] for r in range(3)]
    pose = np.eye(4)
    s, c = _sine_cosine(t * half)
    for k in range(3):
        back = _turn(u, -sine, cosine, [m1[r][k] for r in range(3)])
        pose[:3, k] = _turn(u, s, c, [m0[r][k] + t * (back[r] - m0[r][k]) for r in range(3)])
    ratio = t if sine == 0 else s / sine
    turned = _turn_back(u, *_sine_cosine((1.0 - t) * half), across)
    pose[:3, 3] = [m0[r][3] + (t * along[r] + ratio * turned[r]) for r in range(3)]
    return pose


def _exact_sine_cosine(x: Decimal) -> tuple[Decimal, Decimal]:
    s = c = Decimal(0)
    term, n = Decimal(1), 0
    while abs(term) > Decimal(10) ** -DIGITS:
        c, s = (c + term, s) if n % 2 == 0 else (c, s + term)
        n += 1
        term = term * x / n * (-1 if n % 2 == 0 else 1)
    return s, c


def ideal_pose(first: NDArray[np.float64], last: NDArray[np.float64], t: float) -> NDArray[np.float64]:
    """Return exp(t log(M1 M0^-1)) M0 (4, 4), rounded once.

    The poses are rigid up to rounding. The rotation is the one nearest to the two given, by its
    quaternion. What they differ by beyond it is proportional to t.
    """
    with localcontext() as context:
        context.prec = DIGITS + 10
        m0 = [[Decimal(float(v)) for v in row] for row in first]
        m1 = [[Decimal(float(v)) for v in row] for row in last]
        size = (
            sum(v * v for row in m0[:3] for v in row[:3]) * sum(v * v for row in m1[:3] for v in row[:3]) / 9
        ).sqrt()
        turn = [[sum(m1[r][j] * m0[k][j] for j in range(3)) / size for k in range(3)] for r in range(3)]
        q = _quaternion(turn)
        length = sum(v * v for v in q).sqrt()
        if q[0] < 0:
            length = -length
        w, *v = (value / length for value in q)
        sine = sum(value * value for value in v).sqrt()
        u = [value / sine for value in v] if sine else [Decimal(1), Decimal(0), Decimal(0)]
        half = Decimal(math.atan2(float(sine), float(w)))
        for _ in range(4):
            s, c = _exact_sine_cosine(half)
            half += sine * c - w * s
        step = Decimal(float(t))
        s, c = _exact_sine_cosine(step * half)
        way = [m1[r][3] - m0[r][3] for r in range(3)]
        dot = sum(a * b for a, b in zip(u, way, strict=True))
        across = [a - dot * b for a, b in zip(way, u, strict=True)]
        ratio = s / sine if sine else step
        turned = _turn_back(u, *_exact_sine_cosine((1 - step) * half), across)
        pose = np.eye(4)
        for k in range(3):
            back = _turn(u, -sine, w, [m1[r][k] for r in range(3)])
            moved = [m0[r][k] + step * (back[r] - m0[r][k]) for r in range(3)]
            pose[:3, k] = [float(value) for value in _turn(u, s, c, moved)]
        pose[:3, 3] = [float(m0[r][3] + step * dot * u[r] + ratio * turned[r]) for r in range(3)]
        return pose


def touching_pairs(
    points: NDArray[np.float64],
    origin: ArrayLike,
    step: float,
    scan_radius: ArrayLike,
    avatar: NDArray[np.float64],
    avatar_radius: float,
    pose: NDArray[np.float64],
    margin: float = 0.0,
) -> list[tuple[list[int], list[int]]]:
    """Return all pairs in contact under a pose: scan points [lattice steps], avatar centres [exact units].

    scan_radius: as in `touching`. A sweep from this pose names the least of them.
    """
    lattice = naive.lattice_of(points, origin, step)
    b = naive.scan_units(lattice, step)
    a = naive.placed_units(avatar, pose, origin)
    radii = np.broadcast_to(np.rint(np.asarray(scan_radius) * naive.UNITS).astype(np.int64), len(b))
    rows, own = np.nonzero(_near(a, b, naive.reach_units(avatar_radius, 0.0, margin) + radii).T)
    return list(zip(lattice[rows].tolist(), a[own].tolist(), strict=True))


def _near(a: NDArray[np.int64], b: NDArray[np.int64], reach: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return which pairs (m, n) of centres are within reach (n,), exact units."""
    apart = np.abs(a[:, None] - b)
    # A pair farther apart than its reach on one axis does not touch; the squares of all others fit
    # into 63 bits.
    near = (apart <= reach[:, None]).all(axis=2)
    apart[~near] = 0
    return near & ((apart * apart).sum(axis=2) <= reach * reach)


def touching(
    points: NDArray[np.float64],
    origin: ArrayLike,
    step: float,
    scan_radius: ArrayLike,
    avatar: NDArray[np.float64],
    avatar_radius: float,
    motion: tuple[NDArray[np.float64], NDArray[np.float64]],
    fractions: ArrayLike,
    margin: float = 0.0,
) -> NDArray[np.bool_]:
    """Return whether the avatar touches at each of the fractions of a motion (first, last).

    Contact is by definition. scan_radius: of all scan points, or (n,) of each [m]. The poses on the
    way
    are in the dataset's frame: the origin is subtracted from the end poses.
    """
    first, last = (pose.copy() for pose in motion)
    for end in (first, last):
        end[:3, 3] -= origin
    b = naive.scan_units(naive.lattice_of(points, origin, step), step)
    radii = np.broadcast_to(np.rint(np.asarray(scan_radius) * naive.UNITS).astype(np.int64), len(b))
    found = []
    for t in np.asarray(fractions):
        pose = pose_at(first, last, float(t))
        reach = naive.reach_units(avatar_radius, 0.0, margin) + radii
        found.append(bool(_near(naive.placed_units(avatar, pose, np.zeros(3)), b, reach).any()))
    return np.array(found, bool)
