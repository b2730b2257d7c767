"""Procedural Gothic façade: its mesh and its ground truth.

After the scenario of [Fig12], section 3: a monastery's façade with an open door to walk through,
walls to walk alongside and columns to walk around, a forecourt before it and the first bays of a
nave behind it. It measures 18.7 m by 28 m by about 15.5 m and fits the paper's single voxel (32 m
here). The frame is that of `truth.py`. The seed and the door's width determine the result.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
import trimesh
from numpy.typing import NDArray

from ...schemas.errors import BadRequestError
from .shapes import Opening, Parts, arch, circle, level
from .truth import ColumnTruth, DoorTruth, FacadeTruth, StepTruth, WallTruth

# The narrowest door is narrower than the generated figure: a door that the figure cannot pass is
# possible.
NARROWEST_DOOR, WIDEST_DOOR = 0.50, 2.40
SILL = 0.45
RISER = SILL / 3
TREAD = 0.35
THICKNESS = 1.2
FORECOURT_Y = -17.0
NAVE_Y = 11.0
NAVE_X = 7.5
HALF_WIDTH = 9.0
ORDERS = 4
ORDER_DEPTH = 0.25
ORDER_STEP = 0.20
PORTAL_HALF = 2.9


class Facade(NamedTuple):
    """Façade: the triangle mesh [m] and the figures it was built from."""

    mesh: trimesh.Trimesh
    truth: FacadeTruth


def build_facade(
    seed: int = 2012, door: float = 1.60, origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> Facade:
    """Build the façade of this seed, in its own frame.

    door: clear width of the main door [m]; the side doors are 0.90 and 0.70 m wide.
    origin: stored in the truth only; it does not move the mesh.
    Raises BadRequestError for a door width outside NARROWEST_DOOR to WIDEST_DOOR.
    """
    if not NARROWEST_DOOR <= door <= WIDEST_DOOR:
        raise BadRequestError(
            f"door of {door} m: expected {NARROWEST_DOOR} to {WIDEST_DOOR} m, the widths that fit the portal: "
            "choose a width in this range"
        )
    rng = np.random.default_rng([seed, 0xFACADE])
    doors = (
        _door("main", 0.0, door, 2.6),
        _door("left", -6.35, 0.90, 2.1),
        _door("right", 6.35, 0.70, 2.1),
    )
    parts = Parts()
    # The stairs end before the lane between the façade and its forecourt columns.
    steps = (
        *_stair("main", 0.0, 3.2, -ORDERS * ORDER_DEPTH - 0.4),
        *_stair("left", -6.35, 1.0, -0.5),
        *_stair("right", 6.35, 1.0, -0.5),
    )
    parts.box((-9.3, 9.3), (FORECOURT_Y, 0.0), (-0.2, 0.0))
    for step in steps:
        parts.box((step.x_left, step.x_right), (step.y_front, 0.0), (-0.1, step.z))
    _front(parts, doors)
    _portal(parts, doors[0], rng)
    _rose(parts, rng)
    _buttresses(parts, rng)
    _nave(parts)
    columns = _columns(parts)
    parts.box((-9.3, -9.0), (-16.0, -1.6), (-0.1, 2.6))
    parts.box((-9.36, -8.94), (-16.0, -1.6), (2.6, 2.75))
    walls = (
        WallTruth("cloister", "x", -9.0, 1, -16.0, -1.6, 0.0, 2.6),
        WallTruth("nave left", "x", -NAVE_X, 1, THICKNESS, NAVE_Y, SILL, 4.5),
        WallTruth("nave right", "x", NAVE_X, -1, THICKNESS, NAVE_Y, SILL, 4.5),
        WallTruth("inner", "y", THICKNESS, 1, 1.9, 5.6, SILL, 4.2),
        WallTruth("front", "y", 0.0, -1, 7.4, 8.2, SILL, 3.8),
    )
    return Facade(parts.mesh(), FacadeTruth(seed, origin, SILL, doors, steps, columns, walls))


def _door(name: str, centre: float, width: float, height: float) -> DoorTruth:
    """Return a door's figures.

    The arch is equilateral: its apex is sqrt(3) half widths above the springing.
    """
    half = width / 2
    springing = SILL + height
    apex = springing + 3**0.5 * half
    return DoorTruth(name, centre - half, centre + half, 0.0, THICKNESS, SILL, springing, apex)


def _stair(name: str, centre: float, half: float, y_landing: float) -> tuple[StepTruth, ...]:
    """Return three steps up to the sill, lowest first; the last tread extends to the wall at y = 0."""
    fronts = (y_landing - 2 * TREAD, y_landing - TREAD, y_landing)
    backs = (*fronts[1:], 0.0)
    return tuple(
        StepTruth(name, centre - half, centre + half, front, back, RISER * (k + 1))
        for k, (front, back) in enumerate(zip(fronts, backs, strict=True))
    )


def _front(parts: Parts, doors: tuple[DoorTruth, ...]) -> None:
    """Add the front wall: an outer layer with all openings, an inner layer with the through openings."""
    through = [
        Opening(
            d.x_left,
            d.x_right,
            level(d.sill),
            arch((d.x_left + d.x_right) / 2, d.width / 2, d.springing),
            24,
        )
        for d in doors
    ]
    through += [_lancet(x, 0.45, 4.6, 6.1) for x in (-6.35, 6.35)]
    blind = [_lancet(x + side, 0.38, 4.6, 5.7) for x in (-6.35, 6.35) for side in (-1.1, 1.1)]
    blind += [_lancet(x, 0.28, 9.2, 10.6) for x in (-2.8, 2.8)]
    blind += [_lancet(x, 0.35, 8.0, 8.9) for x in (-5.5, -7.0, 5.5, 7.0)]
    blind.append(Opening(-1.6, 1.6, circle(0, 11.4, 1.6, -1), circle(0, 11.4, 1.6, 1), 32))
    for y, openings in (((0.0, 0.35), (*through, *blind)), ((0.35, THICKNESS), tuple(through))):
        parts.wall((-4.1, 4.1), y, 0.0, lambda x: 15.2 - 0.45 * np.abs(x), openings, (0.0,))
        for side in ((-HALF_WIDTH, -4.1), (4.1, HALF_WIDTH)):
            parts.wall(side, y, 0.0, lambda x: 11.6 - 0.3 * (np.abs(x) - 4.1), openings)
    # String courses: mouldings along the wall between the buttresses.
    for z in (4.1, 7.6):
        for x in ((-8.2, -4.5), (4.5, 8.2)):
            parts.box(x, (-0.08, 0.0), (z, z + 0.16))


def _lancet(centre: float, half: float, low: float, springing: float) -> Opening:
    """Return a window opening with a pointed arch."""
    return Opening(centre - half, centre + half, level(low), arch(centre, half, springing), 16)


def _portal(parts: Parts, door: DoorTruth, rng: np.random.Generator) -> None:
    """Add the portal's recessed orders: each ORDER_DEPTH before the last and ORDER_STEP wider a side.

    Shafts stand in the corners of the jambs; bosses lie along the archivolts. None comes nearer to
    the door's axis than its own order, and the clear width remains that of the door.
    """

    def gable(x: NDArray[np.float64]) -> NDArray[np.float64]:
        height: NDArray[np.float64] = 6.5 + 2.7 * (1 - np.abs(x) / PORTAL_HALF)
        return height

    for order in range(1, ORDERS + 1):
        half = door.width / 2 + ORDER_STEP * order
        y = (-ORDER_DEPTH * order, -ORDER_DEPTH * (order - 1))
        curve = arch(0.0, half, door.springing)
        parts.wall(
            (-PORTAL_HALF, PORTAL_HALF),
            y,
            0.0,
            gable,
            (Opening(-half, half, level(SILL), curve, 32),),
            (0.0,),
        )
        for side in (-1, 1):
            x = side * (half - 0.07)
            parts.cylinder(x, y[1] - 0.07, 0.06, (SILL, door.springing), 24)
            parts.box((x - 0.09, x + 0.09), (y[1] - 0.16, y[1]), (door.springing - 0.2, door.springing))
        for angle in np.linspace(0.12, 1.0, 9):
            # A point of the right arc, whose centre is the left springing; the apex is at 60
            # degrees.
            turn = angle * np.pi / 3
            reach = 2 * half
            x, z = reach * np.cos(turn) - half, door.springing + reach * np.sin(turn)
            radius = rng.uniform(0.05, 0.08)
            for side in (-1, 1):
                parts.ball((side * (x + 0.10), y[0], z + 0.06), radius)
    for share in np.linspace(0.05, 0.95, 10):
        x = PORTAL_HALF * (1 - share)
        for side in (-1, 1):
            parts.ball((side * x, -0.9, 6.5 + 2.7 * share + 0.08), rng.uniform(0.09, 0.13))
    parts.frustum(0.0, -0.9, 0.16, 0.02, (9.2, 10.0), 8)


def _rose(parts: Parts, rng: np.random.Generator) -> None:
    """Add the rose window's tracery to the blind disc of `_front`: a raised ring, a hub and spokes."""
    spokes = int(rng.integers(5, 8)) * 2
    centre = np.array([0.0, 11.4])

    def ring(inner: float, outer: float, y: tuple[float, float], count: int = 48) -> None:
        turn = 2 * np.pi * np.arange(count + 1) / count
        unit = np.column_stack([np.cos(turn), np.sin(turn)])
        for a, b in pairwise(unit):
            parts.prism([centre + inner * a, centre + outer * a, centre + outer * b, centre + inner * b], *y)

    ring(1.6, 1.8, (-0.12, 0.0))
    ring(0.35, 0.45, (0.1, 0.35))
    ring(1.05, 1.13, (0.15, 0.35))
    for turn in 2 * np.pi * np.arange(spokes) / spokes:
        along, across = np.array([np.cos(turn), np.sin(turn)]), np.array([-np.sin(turn), np.cos(turn)]) * 0.05
        inner, outer = centre + 0.4 * along, centre + 1.6 * along
        parts.prism([inner - across, outer - across, outer + across, inner + across], 0.12, 0.35)
        x, z = centre + 1.33 * along
        parts.ball((x, 0.3, z), 0.12)


def _buttresses(parts: Parts, rng: np.random.Generator) -> None:
    """Add four stepped buttresses with two setbacks each and a pinnacle of seeded height."""
    for x in (-8.6, -4.1, 4.1, 8.6):
        tall = 12.6 if abs(x) < 5 else 10.6
        setbacks = ((0.0, 4.6, 1.5), (4.6, 8.6, 1.1), (8.6, tall, 0.7))
        for low, high, depth in setbacks:
            parts.box((x - 0.4, x + 0.4), (-depth, 0.2), (low, high))
            parts.box((x - 0.44, x + 0.44), (-depth - 0.05, 0.2), (high - 0.14, high))
        height = tall + rng.uniform(1.8, 2.6)
        parts.frustum(x, -0.25, 0.5, 0.03, (tall, height), 4, np.pi / 4)
        parts.ball((x, -0.25, height), 0.12)


def _nave(parts: Parts) -> None:
    """Add the first bays of a nave and its two aisles: one section, extruded along y up to NAVE_Y."""
    section = (
        Opening(-NAVE_X, -3.7, level(SILL), arch(-5.6, 1.9, 4.8, 1.3), 20),
        Opening(-3.7, -3.3, level(SILL), level(4.6), 1),
        Opening(-3.3, 3.3, level(SILL), arch(0.0, 3.3, 5.2, 1.3), 28),
        Opening(3.3, 3.7, level(SILL), level(4.6), 1),
        Opening(3.7, NAVE_X, level(SILL), arch(5.6, 1.9, 4.8, 1.3), 20),
    )
    parts.wall((-8.1, 8.1), (THICKNESS, NAVE_Y), 0.0, level(9.8), section)
    for x in (-NAVE_X, NAVE_X):
        for y in (2.6, 4.8, 7.6, 10.2):
            # Shafts on corbels, above head height: a visitor can slide along the wall below.
            parts.cylinder(x, y, 0.12, (2.6, 4.8), 24)
            parts.frustum(x, y, 0.03, 0.16, (2.3, 2.6), 12)


def _columns(parts: Parts) -> tuple[ColumnTruth, ...]:
    """Add six columns of the nave's arcades and two free-standing columns on the forecourt."""
    spots = [
        (f"nave {'left' if x < 0 else 'right'} {k}", x, y)
        for x in (-3.5, 3.5)
        for k, y in enumerate((3.4, 6.2, 9.0))
    ]
    columns = [ColumnTruth(name, x, y, 0.36, 0.04, SILL, 4.6) for name, x, y in spots]
    columns += [
        ColumnTruth(f"forecourt {name}", x, -5.4, 0.35, 0.04, 0.0, 4.4)
        for name, x in (("left", -4.6), ("right", 4.6))
    ]
    for c in columns:
        parts.cylinder(c.x, c.y, c.radius, (c.z_low - 0.1, c.z_high))
        parts.cylinder(c.x, c.y, c.radius + c.collar, (c.z_low - 0.1, c.z_low + 0.15))
        parts.frustum(c.x, c.y, c.radius + c.collar, c.radius + 0.12, (c.z_high - 0.3, c.z_high), 8)
        if c.z_low == 0.0:
            parts.ball((c.x, c.y, c.z_high + 0.3), 0.32)
    return tuple(columns)
