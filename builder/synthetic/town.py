"""Town: façades in rows along streets, each with its own seed and its own door.

Every façade is scanned from its own five stations, in its own frame, together with its eight
neighbours. Only three rows of meshes are held in memory, however large the town.
"""

from collections.abc import Callable
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np
import trimesh

from .facade import Facade, build_facade
from .shapes import Parts
from .truth import FacadeTruth

# The density of the paper's voxel: a larger town has more façades, not more points per metre.
POINTS_PER_FACADE = 587_923
# A façade is 18.7 m by 28 m: this leaves a lane of 1.3 m between neighbours and a street of 4 m
# between rows.
PITCH_X, PITCH_Y = 20.0, 32.0
DOORS = (1.00, 1.20, 1.40, 1.60, 1.80, 2.00)


class Lot(NamedTuple):
    """One façade to scan: its truth, and a function that returns the mesh to cast rays at.

    Both are in the façade's own frame.
    """

    truth: FacadeTruth
    surroundings: Callable[[], trimesh.Trimesh]


def town_lots(points: int, seed: int) -> list[Lot]:
    """Return the lots of a town of `points` points, row by row.

    A town has at least two lots, in about as many rows as columns.
    """
    count = max(2, round(points / POINTS_PER_FACADE))
    columns = int(np.ceil(np.sqrt(count)))
    built = lru_cache(maxsize=3 * columns)(partial(_house, seed, columns))
    return [
        Lot(built(number).truth, partial(_surroundings, built, number, columns, count))
        for number in range(count)
    ]


def _house(seed: int, columns: int, number: int) -> Facade:
    """Build the façade of this number; the town's seed determines its seed and its door's width."""
    rng = np.random.default_rng([seed, 0x707, number])
    row, column = divmod(number, columns)
    origin = (column * PITCH_X, row * PITCH_Y, 0.0)
    return build_facade(int(rng.integers(1 << 31)), DOORS[int(rng.integers(len(DOORS)))], origin)


def _surroundings(built: Callable[[int], Facade], number: int, columns: int, count: int) -> trimesh.Trimesh:
    """Return a façade and its up to eight neighbours as one mesh, in the frame of the façade."""
    row, column = divmod(number, columns)
    parts = Parts()
    for down in (-1, 0, 1):
        for right in (-1, 0, 1):
            other = (row + down) * columns + column + right
            if row + down >= 0 and 0 <= column + right < columns and other < count:
                mesh = built(other).mesh
                parts.add(np.add(mesh.vertices, (right * PITCH_X, down * PITCH_Y, 0.0)), mesh.faces)
    return parts.mesh()
