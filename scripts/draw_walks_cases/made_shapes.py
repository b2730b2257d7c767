"""Scan points of made shapes, and a body whose outline is known."""

import itertools

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

# Distance of scan points, and of the body's points [m]. The body has fewer than 8,192 spheres, so
# that frames take the server's fast path.
SPACING, BODY_SPACING = 0.02, 0.025
# Radius of the body's spheres [m]: they leave no gaps.
SPHERE = 0.018
# Standard deviation of the scan points' coordinates [m].
NOISE = 0.001
# Height of walls [m].
WALL_HEIGHT = 1.8
# The body is round seen from above: radius, height and rounding of the shoulders, radius of the
# head, and height of its centre [m].
RADIUS, SHOULDER, ROUNDING, HEAD, HEAD_HEIGHT = 0.2, 1.4, 0.12, 0.13, 1.48
HEIGHT = HEAD_HEIGHT + HEAD


def along(line: Floats, spacing: float) -> Floats:
    """Return points (n, 2) of a polyline (k, 2), at most `spacing` apart, its vertices included."""
    parts = [line[:1]]
    for begin, end in itertools.pairwise(line):
        count = max(1, int(np.ceil(np.linalg.norm(end - begin) / spacing - 1e-9)))
        parts.append(begin + (end - begin) * (np.arange(1, count + 1) / count)[:, None])
    return np.concatenate(parts)


def walls(lines: list[Floats], floor: tuple[float, float, float, float], spacing: float) -> Floats:
    """Return points (n, 3) of upright walls over polylines (k, 2) in x and y, and of a floor at z = 0.

    floor: (x, y, x, y) of its corners.
    """
    heights = np.arange(spacing, WALL_HEIGHT, spacing)
    upright = [_extruded(along(line, spacing), heights) for line in lines]
    x0, y0, x1, y1 = floor
    across = along(np.array([[x0, 0.0], [x1, 0.0]]), spacing)
    level = _extruded(across, np.arange(y0, y1 + spacing / 2, spacing))[:, [0, 2, 1]]
    return np.concatenate([*upright, level])


def ground(profile: Floats, half_width: float, spacing: float) -> Floats:
    """Return points (n, 3) of a ground with a profile (k, 2) in x and z, level across."""
    across = np.arange(-half_width, half_width + spacing / 2, spacing)
    return _extruded(along(profile, spacing), across)[:, [0, 2, 1]]


def noisy(points: Floats, rng: np.random.Generator) -> Floats:
    """Return points (n, 3) with the noise of a scanner."""
    return points + rng.normal(scale=NOISE, size=points.shape)


def box(low: tuple[float, float], high: tuple[float, float]) -> Floats:
    """Return the outline (5, 2) of a rectangle."""
    (x0, y0), (x1, y1) = low, high
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]])


def circle(centre: tuple[float, float], radius: float, count: int = 64) -> Floats:
    """Return the outline (count + 1, 2) of a circle."""
    angles = np.linspace(0.0, 2 * np.pi, count + 1)
    return np.array(centre) + radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)


def crate(side: float) -> Floats:
    """Return the centres (n, 3) of spheres that cover a cube on z = 0, centred in x and y."""
    inner = side - 2 * SPHERE
    steps = np.linspace(0.0, inner, int(np.ceil(inner / BODY_SPACING)) + 1)
    found = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    outside = ((found == 0.0) | (found == inner)).any(axis=1)
    return found[outside] + np.array([SPHERE - side / 2, SPHERE - side / 2, SPHERE])


def body_profile(inset: float = 0.0) -> Floats:
    """Return half of the body's outline (k, 2), from the middle of its base to the top of its head.

    First column: distance from the axis.  inset: distance by which the line lies inside [m].
    """
    turns = np.linspace(0.0, np.pi / 2, 9)[:, None]
    rounding, head = ROUNDING - inset, HEAD - inset
    shoulder = np.array([RADIUS - ROUNDING, SHOULDER - ROUNDING])
    shoulders = shoulder + rounding * np.hstack([np.cos(turns), np.sin(turns)])
    neck = np.arcsin((SHOULDER - inset - HEAD_HEIGHT) / head)
    turns = np.linspace(neck, np.pi / 2, 25)[:, None]
    skull = np.array([0.0, HEAD_HEIGHT]) + head * np.hstack([np.cos(turns), np.sin(turns)])
    return np.concatenate([[[0.0, inset], [RADIUS - inset, inset]], shoulders, skull])


def body() -> Floats:
    """Return the centres (n, 3) of the body's spheres: its base on z = 0, its axis upright."""
    parts = []
    for radius, height in along(body_profile(SPHERE), BODY_SPACING):
        count = max(1, int(np.ceil(2 * np.pi * radius / BODY_SPACING)))
        angles = 2 * np.pi * np.arange(count) / count
        parts.append(
            np.stack([radius * np.cos(angles), radius * np.sin(angles), np.full(count, height)], axis=1)
        )
    return np.concatenate(parts)


def _extruded(line: Floats, third: Floats) -> Floats:
    """Return points (n, 3): each of a line (k, 2) with each value of a third coordinate."""
    both = np.repeat(line, len(third), axis=0)
    return np.column_stack([both, np.tile(third, len(line))])
