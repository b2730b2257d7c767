"""Sheet without thickness with a door in it: a surface of known spacing that ends at the jambs.

The façade's doors are set in a wall 1.2 m deep: their jambs are planes, and points in the middle of
a jamb are not on a rim. This sheet has rims only, which separates the effect of a radius model on
rims from its effect on planes. The noise and the clear width are known too.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas.errors import BadRequestError
from .figure import write_figure
from .places import WallPlaces
from .scanner import JITTER, LATTICE
from .truth import DoorTruth, FacadeTruth, WallTruth

# The sheet stands on z = 0 in the plane y = 0, symmetric about the door's centre [m].
HALF_WIDTH, HEIGHT = 3.0, 3.0
DOOR = 1.0
# Superposed grids of three stations: each one's spacing relative to the sheet's, and its cells'
# ratio of width to height, which grows as the station is farther away and sees the sheet at a
# smaller angle. Together they give 0.95 points per square of the spacing.
GRIDS = ((1.46, 1.0), (1.95, 1.6), (2.14, 2.2))
# Noise along the normal [m]: that of 2 mm in range at 40 degrees.
NOISE = 0.0015
# Distance of probes from the rim and from the other edges [m]: a probe of 5 cm cannot pass around
# them.
MARGIN = 0.10
THINNEST, WIDEST = 0.005, 0.2


class Sheet(NamedTuple):
    """Written sheet.

    truth: its door `main` and the wall on either side.
    places: probe places, spread evenly.
    """

    path: Path
    truth: FacadeTruth
    places: WallPlaces


def make_sheet(
    path: Path, *, spacing: float = 0.03, places: int = 2000, seed: int = 2012, door: float = DOOR
) -> Sheet:
    """Write the points of a sheet as OBJ or ASCII PLY. The same arguments give the same coordinates.

    spacing: 1 over the square root of the points per square metre [m].
    places: number of probe places.
    door: its clear width [m].
    Raises BadRequestError for a spacing outside 0.5 to 20 cm and for a door of half the sheet's
    width or more.
    """
    if not 0.0 < door < HALF_WIDTH:
        raise BadRequestError(f"door of {door} m: expected more than 0 and less than {HALF_WIDTH} m")
    if not THINNEST <= spacing <= WIDEST:
        raise BadRequestError(
            f"spacing {spacing} m: expected {THINNEST} to {WIDEST} m: choose a spacing between"
        )
    rng = np.random.default_rng([seed, 0x5EE7])
    flat = np.concatenate([_grid(spacing * wider, aspect, rng) for wider, aspect in GRIDS])
    flat = flat[np.abs(flat[:, 0]) > door / 2]
    points = np.column_stack([flat[:, 0], rng.normal(0.0, NOISE, len(flat)), flat[:, 1]])
    write_figure(path, np.rint(points / LATTICE) * LATTICE)
    half = door / 2
    walls = tuple(
        WallTruth(name, "y", 0.0, -1, low, high, 0.0, HEIGHT)
        for name, low, high in (("left", -HALF_WIDTH, -half), ("right", half, HALF_WIDTH))
    )
    opening = DoorTruth("main", -half, half, 0.0, 0.0, 0.0, HEIGHT, HEIGHT)
    truth = FacadeTruth(seed, (0.0, 0.0, 0.0), 0.0, (opening,), (), (), walls)
    side = np.where(rng.uniform(size=places) < 0.5, -1.0, 1.0)
    at = np.zeros((places, 3))
    at[:, 0] = side * rng.uniform(half + MARGIN, HALF_WIDTH - MARGIN, places)
    at[:, 2] = rng.uniform(MARGIN, HEIGHT - MARGIN, places)
    return Sheet(
        path, truth, WallPlaces(at, np.tile([0.0, -1.0, 0.0], (places, 1)), np.full(places, spacing))
    )


def _grid(spacing: float, aspect: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return one station's points (n, 2) on the sheet, x and z [m]: a jittered, randomly offset grid."""
    wide, high = spacing * aspect**0.5, spacing / aspect**0.5
    x, z = np.meshgrid(
        np.arange(-HALF_WIDTH, HALF_WIDTH, wide) + rng.uniform(0, wide),
        np.arange(0.0, HEIGHT, high) + rng.uniform(0, high),
        indexing="ij",
    )
    x += JITTER * wide * rng.uniform(-1, 1, x.shape)
    z += JITTER * high * rng.uniform(-1, 1, z.shape)
    return np.column_stack([x.ravel(), z.ravel()])
