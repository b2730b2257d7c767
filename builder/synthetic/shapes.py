"""Solids that a façade consists of, collected as one triangle mesh.

Every solid is closed and convex. Solids may touch or overlap, because rays from outside never see
the faces between them. Lengths in metres, z up.
"""

from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

Curve = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""Heights [m] above positions along x [m], elementwise."""


class Opening(NamedTuple):
    """Hole through a wall from x_left to x_right, between two curves cut into `slices` chords."""

    x_left: float
    x_right: float
    lower: Curve
    upper: Curve
    slices: int


class Parts:
    """Collector of triangles; `mesh()` returns them as one mesh."""

    def __init__(self) -> None:
        self._vertices: list[NDArray[np.float64]] = []
        self._faces: list[NDArray[np.int64]] = []
        self._count = 0

    def add(self, vertices: ArrayLike, faces: ArrayLike) -> None:
        """Add triangles: vertices (n, 3) [m], faces (m, 3) indices into them."""
        corners = np.asarray(vertices, np.float64)
        self._vertices.append(corners)
        self._faces.append(np.asarray(faces, np.int64) + self._count)
        self._count += len(corners)

    def prism(self, outline: ArrayLike, y_low: float, y_high: float) -> None:
        """Add a convex outline (n, 2) in x and z, extruded along y."""
        flat = np.asarray(outline, np.float64)
        n = len(flat)
        front = np.column_stack([flat[:, 0], np.full(n, y_low), flat[:, 1]])
        back = np.column_stack([flat[:, 0], np.full(n, y_high), flat[:, 1]])
        fan = [(0, i, i + 1) for i in range(1, n - 1)]
        caps = fan + [(n, n + j, n + i) for _, i, j in fan]
        sides = [t for i in range(n) for j in [(i + 1) % n] for t in ((i, n + i, n + j), (i, n + j, j))]
        self.add(np.concatenate([front, back]), caps + sides)

    def box(self, x: tuple[float, float], y: tuple[float, float], z: tuple[float, float]) -> None:
        """Add a box from three intervals."""
        self.prism([(x[0], z[0]), (x[1], z[0]), (x[1], z[1]), (x[0], z[1])], *y)

    def cylinder(self, x: float, y: float, radius: float, z: tuple[float, float], sides: int = 96) -> None:
        """Add an upright round shaft, corners on the circle: 96 sides leave 0.2 mm at a radius of 0.35 m."""
        self.frustum(x, y, radius, radius, z, sides)

    def frustum(
        self,
        x: float,
        y: float,
        low: float,
        high: float,
        z: tuple[float, float],
        sides: int,
        turn: float = 0.0,
    ) -> None:
        """Add an upright frustum, radius `low` at the bottom, `high` at the top, corners turned by `turn`."""
        angle = turn + 2 * np.pi * np.arange(sides) / sides
        ring = np.column_stack([np.cos(angle), np.sin(angle)])
        bottom = np.column_stack([ring * low + (x, y), np.full(sides, z[0])])
        top = np.column_stack([ring * high + (x, y), np.full(sides, z[1])])
        centres = [(x, y, z[0]), (x, y, z[1])]
        i = np.arange(sides)
        j = (i + 1) % sides
        low_centre, high_centre = np.full(sides, 2 * sides), np.full(sides, 2 * sides + 1)
        quads = [np.column_stack(t) for t in ((i, j, sides + j), (i, sides + j, sides + i))]
        caps = [np.column_stack(t) for t in ((low_centre, j, i), (high_centre, sides + i, sides + j))]
        self.add(np.concatenate([bottom, top, centres]), np.concatenate(quads + caps))

    def ball(self, centre: ArrayLike, radius: float) -> None:
        """Add a small ball of 80 faces."""
        ball = trimesh.creation.icosphere(subdivisions=1, radius=radius)
        self.add(ball.vertices + np.asarray(centre, np.float64), ball.faces)

    def wall(
        self,
        x: tuple[float, float],
        y: tuple[float, float],
        bottom: float,
        top: Curve,
        openings: tuple[Opening, ...] = (),
        breaks: tuple[float, ...] = (),
    ) -> None:
        """Add a wall along x with holes: upright strips, each a stack of trapezia between the holes.

        breaks: further positions to cut at, where `top` bends.
        Jambs lie exactly at an opening's x_left and x_right. Openings may lie above one another but
        must not cross.
        """
        cuts = [np.array([*x, *breaks])]
        for hole in openings:
            # Cosine spacing: an arch is steepest at its springing.
            share = (1 - np.cos(np.linspace(0, np.pi, hole.slices + 1))) / 2
            inner = hole.x_left + share[1:-1] * (hole.x_right - hole.x_left)
            cuts += [inner, np.array([hole.x_left, hole.x_right])]
        edges = np.unique(np.concatenate(cuts))
        edges = edges[(edges >= x[0]) & (edges <= x[1])]
        edges = edges[np.concatenate([[True], np.diff(edges) > 1e-9])]
        for strip in pairwise(edges):
            at = np.array(strip)
            middle = at.mean()
            holes = [hole for hole in openings if hole.x_left < middle < hole.x_right]
            holes.sort(key=lambda hole: float(hole.lower(at).mean()))
            floor = np.full(2, bottom)
            for lower, upper in [*((hole.lower(at), hole.upper(at)) for hole in holes), (top(at), top(at))]:
                if (lower - floor).max() > 1e-6:
                    self.prism(
                        [(at[0], floor[0]), (at[1], floor[1]), (at[1], lower[1]), (at[0], lower[0])], *y
                    )
                floor = upper

    def mesh(self) -> trimesh.Trimesh:
        """Return all triangles as one mesh, without faces of zero area."""
        vertices, faces = np.concatenate(self._vertices), np.concatenate(self._faces)
        a, b, c = (vertices[faces[:, k]] for k in range(3))
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
        return trimesh.Trimesh(vertices, faces[area > 1e-10], process=False)


def level(height: float) -> Curve:
    """Return the curve of constant height."""
    return lambda x: np.full_like(x, height)


def arch(centre: float, half: float, springing: float, pointed: float = 2.0) -> Curve:
    """Return a pointed arch of two arcs of radius `pointed` * half: 2 is equilateral, 1 a semicircle."""
    radius = pointed * half

    def height(x: NDArray[np.float64]) -> NDArray[np.float64]:
        reach = np.minimum(np.abs(x - centre), half) + radius - half
        return springing + np.sqrt(np.maximum(radius * radius - reach * reach, 0))

    return height


def circle(centre: float, height: float, radius: float, side: int) -> Curve:
    """Return the upper (side +1) or lower (-1) half of a circle about (centre, height)."""
    return lambda x: height + side * np.sqrt(np.maximum(radius * radius - (x - centre) ** 2, 0))
