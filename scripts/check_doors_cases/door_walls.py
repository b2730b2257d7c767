"""Points of walls with a door, as a scan has them, and the segments of their ideal plan."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

# Spacing of the scan's points [m]; its spheres have half of it as their radius.
SPACING = 0.01
# Half the length of a wall, height of wall and door, half the depth of the floor [m].
WALL, HEIGHT, DOOR_HEIGHT, FLOOR = 1.3, 1.6, 1.4, 1.4


class DoorWall(NamedTuple):
    """A wall along x with a door, its near face at y = 0.

    width: of the door, centred at x = 0 [m].  depth: of the wall [m]; 0: one sheet of points.
    noise: standard deviation of the points' coordinates [m].
    free: whether the wall has one jamb only, at x > 0, without a lintel.
    """

    width: float
    depth: float = 0.0
    noise: float = 0.0
    free: bool = False

    def points(self, rng: np.random.Generator) -> Floats:
        """Return the points (n, 3) of wall and floor [m]."""
        jamb = self.width / 2
        x, z = _grid((jamb, WALL), (SPACING, HEIGHT))
        parts = [_face(x, y, z) for y in sorted({0.0, self.depth})]
        if self.depth > 0.0:
            y, z = _grid((SPACING, self.depth - SPACING), (SPACING, DOOR_HEIGHT))
            parts.append(np.column_stack([np.full(y.size, jamb), y, z]))
        if not self.free:
            parts += [part * [-1.0, 1.0, 1.0] for part in parts]
            x, z = _grid((-jamb, jamb), (DOOR_HEIGHT, HEIGHT))
            parts += [_face(x, y, z) for y in sorted({0.0, self.depth})]
        x, y = _grid((-WALL, WALL), (-FLOOR, FLOOR))
        parts.append(np.column_stack([x, y, np.zeros(x.size)]))
        points = np.concatenate(parts)
        return points + rng.normal(scale=self.noise, size=points.shape) if self.noise else points

    def separation(self, place: Floats) -> float:
        """Return the distance of a place (2,) from the plan [m]."""
        low, along = self.segments()[:, 0], np.diff(self.segments(), axis=1)[:, 0]
        share = np.clip(((place - low) * along).sum(axis=1) / (along**2).sum(axis=1), 0.0, 1.0)
        return float(np.linalg.norm(place - low - share[:, None] * along, axis=1).min())

    def segments(self) -> Floats:
        """Return the plan of the wall as segments (s, 2, 2) in x and y [m]."""
        jamb = self.width / 2
        found = [[[jamb, y], [WALL, y]] for y in sorted({0.0, self.depth})]
        if self.depth > 0.0:
            found.append([[jamb, 0.0], [jamb, self.depth]])
        if not self.free:
            found += [[[-x, y] for x, y in segment] for segment in found]
        return np.array(found)


def _grid(across: tuple[float, float], up: tuple[float, float]) -> tuple[Floats, Floats]:
    """Return the coordinates (n,) of points in a rectangle, both ends included."""
    sides = [np.linspace(a, b, round((b - a) / SPACING) + 1) for a, b in (across, up)]
    first, second = np.meshgrid(*sides, indexing="ij")
    return first.ravel(), second.ravel()


def _face(x: Floats, y: float, z: Floats) -> Floats:
    return np.column_stack([x, np.full(x.size, y), z])


def cylinder(radius: float, height: float, sphere: float, spacing: float) -> Floats:
    """Return the centres (n, 3) of spheres that cover an upright cylinder without gaps [m].

    radius, height: of the cylinder, spheres included.  sphere: radius of the spheres.
    """
    ring = radius - sphere
    count = int(np.ceil(2 * np.pi * ring / spacing))
    angles = 2 * np.pi * np.arange(count) / count
    heights = np.linspace(sphere, height - sphere, int(np.ceil((height - 2 * sphere) / spacing)) + 1)
    side = np.stack(
        [np.cos(angles)[:, None] * ring, np.sin(angles)[:, None] * ring, np.zeros((count, 1))], axis=-1
    )
    side = side + np.stack([0 * heights, 0 * heights, heights], axis=-1)
    x, y = _grid((-ring, ring), (-ring, ring))
    inside = np.hypot(x, y) < ring - spacing / 2
    ends = [np.column_stack([x, y, np.full(x.size, z)])[inside] for z in (sphere, height - sphere)]
    return np.concatenate([side.reshape(-1, 3), *ends])
