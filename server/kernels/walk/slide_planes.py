"""Planes of the surfaces that an avatar touches, and displacements that lead into none of them."""

import math

from ....schemas.kernels import compiling as nb
from ..core.kernel_decorators import njit_no_refcount
from .walk_vectors import cross, dot, minus, norm, times, vector

# A displacement may lead into a surface by this share of its length, which is rounding.
ROUNDING = 1e-9


@njit_no_refcount
def limit_displacement(gone, way, most):
    """Shorten a displacement so that its sum with `gone` is at most `most` long [m].

    gone, way: vectors. The direction of `way` is kept.
    """
    a, b, c = dot(way, way), dot(gone, way), dot(gone, gone) - most * most * (1.0 - 1e-12)
    if a + 2.0 * b + c <= 0.0:
        return way
    root = b * b - a * c
    share = (math.sqrt(root) - b) / a if root > 0.0 and c < 0.0 else 0.0
    return times(max(0.0, share), way)


@njit_no_refcount
def _is_free(way, planes, count, least):
    free = True
    for n in range(count):
        free &= dot(way, vector(planes[n])) >= least
    return free


@nb.njit(nogil=True, cache=True)
def clip(rest, planes, count):
    """Return whether a displacement can be clipped, and its longest projection that leads into no plane.

    planes: (p, 3) unit normals that point to the free side; the first `count` count. The candidates are
    the displacement itself, then its projections onto one plane, then those onto the crease of two.
    """
    least = -ROUNDING * norm(rest)
    if _is_free(rest, planes, count, least):
        return True, rest
    best, longest = rest, -1.0
    for n in range(count):
        plane = vector(planes[n])
        way = minus(rest, times(dot(rest, plane), plane))
        if norm(way) > longest and _is_free(way, planes, count, least):
            best, longest = way, norm(way)
    if longest >= 0.0:
        return True, best
    for n in range(count):
        for m in range(n + 1, count):
            crease = cross(vector(planes[n]), vector(planes[m]))
            square = dot(crease, crease)
            if square > 1e-6:
                way = times(dot(rest, crease) / square, crease)
                if norm(way) > longest and _is_free(way, planes, count, least):
                    best, longest = way, norm(way)
    return longest >= 0.0, best
