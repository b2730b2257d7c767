"""The person who walks: an upright cylinder, or the generated figure."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from solidcloud.builder.synthetic.figure import figure_points

Floats = NDArray[np.float64]

# Cylinder: radius and height, spheres included, radius of its spheres and their spacing [m]. The
# spheres cover it without gaps, and are fewer than 8,192: with more, a frame leaves the server's fast
# path.
RADIUS, HEIGHT, SPHERE, APART = 0.25, 1.70, 0.02, 0.027
PERSONS = ("cylinder", "figure")


class Person(NamedTuple):
    """The spheres of a person who stands at the origin; z is up, and the face looks to y.

    points: (n, 3) centres [m].  radius: of each sphere [m]; None: measured by the scene.
    half_width: largest horizontal distance from the axis, spheres excluded [m].
    """

    points: Floats
    radius: float | None
    half_width: float


def make_person(name: str) -> Person:
    """Return the person of one of the names in PERSONS."""
    points, radius = (cylinder(), SPHERE) if name == "cylinder" else (figure_points(), None)
    return Person(points, radius, float(np.hypot(points[:, 0], points[:, 1]).max()))


def cylinder() -> Floats:
    """Return the centres (n, 3) of the spheres that cover the side and both ends of the cylinder [m]."""
    ring = RADIUS - SPHERE
    angles = 2 * np.pi * np.arange(np.ceil(2 * np.pi * ring / APART)) / np.ceil(2 * np.pi * ring / APART)
    heights = _spaced(SPHERE, HEIGHT - SPHERE)
    angle, z = (each.ravel() for each in np.meshgrid(angles, heights))
    side = np.column_stack([ring * np.cos(angle), ring * np.sin(angle), z])
    x, y = (each.ravel() for each in np.meshgrid(_spaced(-ring, ring), _spaced(-ring, ring)))
    inside = np.hypot(x, y) < ring - APART / 2
    ends = [np.column_stack([x, y, np.full(x.size, z)])[inside] for z in (heights[0], heights[-1])]
    return np.concatenate([side, *ends])


def _spaced(low: float, high: float) -> Floats:
    return np.linspace(low, high, int(np.ceil((high - low) / APART)) + 1)
