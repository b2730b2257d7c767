"""Points that cover the surface of a mesh: the avatar's spheres around them leave no hole."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.units import MAX_COORDINATE
from ...schemas.errors import BadRequestError, TooLargeError
from ...schemas.wire.request_limits import MAX_AVATAR_POINTS

_Triangles = NDArray[np.float64]

# Longest edge of a triangle whose corners cover it, in radii. No point of a triangle is farther from
# the nearest corner than the longest edge / sqrt(3), which an equilateral triangle attains. The rest
# up to sqrt(3) = 1.7321 covers the rounding of the corners.
_LONGEST_EDGE = 1.732
# Default radius of a mesh: the square root of its area, divided by this. The avatar then has some
# 10,000 to 30,000 points, whatever its size. It is 14 mm for a person.
_RADII = 100.0
# Step to which the default radius is rounded, as in `make_avatar` [m].
_STEP = 2.0**-20
# Largest default radius [m], that of an avatar in a scene file.
_MAX_RADIUS = 8.0
# Triangles held at most, 72 bytes each. A closed surface has half as many points as triangles.
_MAX_TRIANGLES = 3 * MAX_AVATAR_POINTS


class SurfaceCover(NamedTuple):
    """Cover of a surface.

    points: (n, 3) [m].  radius: used [m]; None if none was given and the surface has no area.
    triangles: (k, 3, 3), of the surface, after halving [m].
    """

    points: NDArray[np.float64]
    radius: float | None
    triangles: _Triangles


def cover_surface(triangles: _Triangles, radius: float | None, what: str) -> SurfaceCover:
    """Cover a surface with points: no part of it is farther than a radius from one.

    triangles: (m, 3, 3), the corners of each [m].  what: name of the mesh, for messages.
    radius: above 0 [m]; None: a hundredth of the square root of the area.
    Triangles with an edge longer than sqrt(3) radii are halved at their longest edge until none is
    left. The points are the corners of all triangles, each once, sorted: they depend neither on a
    random number nor on the order of vertices.
    Raise BadRequestError for a corner that is not finite or too far away, or a radius that is too
    small or too large, TooLargeError for more than MAX_AVATAR_POINTS points.
    """
    if not np.isfinite(triangles).all() or np.abs(triangles).max() > MAX_COORDINATE:
        raise BadRequestError(
            f"{what}: a vertex that is not finite or beyond {MAX_COORDINATE:g} m: expected finite coordinates [m]"
        )
    area = _area(triangles)
    if radius is None:
        if area == 0.0:
            return SurfaceCover(_distinct(triangles.reshape(-1, 3)), None, triangles)
        radius = max(1, round(math.sqrt(area) / _RADII / _STEP)) * _STEP
        if radius > _MAX_RADIUS:
            raise BadRequestError(
                f"{what}: a surface of {area:.3g} m², for which spheres of {radius:.3g} m would be used: expected "
                f"metres, and at most {_MAX_RADIUS:g} m: give the unit of its file, scale the mesh, or give a radius"
            )
    if not 0 < radius < math.inf:
        raise BadRequestError(
            f"{what}: radius {radius:g} m: expected a positive length, with which spheres cover the surface: give "
            "one, or add the vertices of the mesh instead"
        )
    longest = _LONGEST_EDGE * radius
    # An equilateral triangle has the largest area for its longest edge.
    if len(triangles) > _MAX_TRIANGLES or area > _MAX_TRIANGLES * math.sqrt(3) / 4 * longest**2:
        raise _too_large(what, area, radius)
    corners, small = [triangles.reshape(-1, 3)], []
    count = 0
    while len(triangles):
        # Of equally long edges, that of the least corners is halved, whatever the order of the corners.
        order = np.lexsort(triangles.transpose(2, 0, 1)[::-1], axis=-1)
        triangles = np.take_along_axis(triangles, order[:, :, None], axis=1)
        edges = np.linalg.norm(triangles[:, [1, 2, 0]] - triangles, axis=2)
        begin = edges.argmax(axis=1)
        long = edges.max(axis=1) > longest
        count += len(triangles) - int(long.sum())
        small.append(triangles[~long])
        triangles, begin = triangles[long], begin[long]
        rows = np.arange(len(triangles))
        first, second = triangles[rows, begin], triangles[rows, (begin + 1) % 3]
        third = triangles[rows, (begin + 2) % 3]
        # Triangles that share an edge compute the same bits: the sum does not depend on the order.
        middle = (first + second) / 2
        corners.append(middle)
        halves = (first, middle, third), (middle, second, third)
        triangles = np.concatenate([np.stack(half, axis=1) for half in halves])
        if count + len(triangles) > _MAX_TRIANGLES:
            raise _too_large(what, area, radius)
    points = _distinct(np.concatenate(corners))
    if len(points) > MAX_AVATAR_POINTS:
        raise _too_large(what, area, radius)
    return SurfaceCover(points, radius, np.concatenate(small))


def _area(triangles: _Triangles) -> float:
    """Return the area of all triangles [m²]. The order of the triangles does not change it."""
    sides = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    return math.fsum((np.linalg.norm(sides, axis=1) / 2).tolist())


def _distinct(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distinct points (n, 3), sorted by x, then y, then z."""
    points = points[np.lexsort((points + 0.0).T[::-1])] + 0.0
    new = np.ones(len(points), bool)
    new[1:] = (points[1:] != points[:-1]).any(axis=1)
    return np.ascontiguousarray(points[new])


def _too_large(what: str, area: float, radius: float) -> TooLargeError:
    return TooLargeError(
        f"{what}: a surface of {area:.3g} m² takes more than {MAX_AVATAR_POINTS} points at a radius of {radius:g} m: "
        "expected at most that many: give a larger radius, or simplify the mesh"
    )
