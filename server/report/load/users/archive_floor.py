"""Floor of any archive, found in its points, and the paths of users over it. z is up.

Users walk straight from one place with a floor to the next. They do not know walls: an avatar in a
wall is a query like any other. Heights between the places are interpolated.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .....builder.voxel.record_points import iter_points
from .....schemas.archive.archive import Archive
from .....schemas.errors import BadDataError
from ...common.floor_walk import floor_height

Floats = NDArray[np.float64]

# Most columns of voxels and about the most points that are read, spread evenly over the archive.
COLUMNS, READ_POINTS = 150, 3_000_000
# Edge of the squares whose floor is found [m], and the least points of one.
SQUARE, LEAST_POINTS = 1.0, 20
# Most squares of a column of voxels, and of the map of heights.
COLUMN_SQUARES, MAP_SQUARES = 64, 1 << 20
# Length of a stretch of a walk [m], and how sharply the next one may turn: the cosine.
SHORTEST, LONGEST, TURN = 4.0, 30.0, -0.2
# Places that a tour visits, and the width of the part where a crowd gathers [m].
TOUR_PLACES, CROWD_WIDTH = 60, 12.0


class ArchiveFloor(NamedTuple):
    """Places where a user can stand, and the heights around them; see `Ground`.

    places: (k, 2) [m].
    heights: (nx, ny) of the floor in squares of `edge` metres from `low` (2,) on.
    """

    places: Floats
    heights: Floats
    low: Floats
    edge: float

    def floor(self, xy: Floats) -> Floats:
        """Return the height of the floor [m] (k,) below positions (k, 2), interpolated."""
        most = np.array(self.heights.shape) - 1
        at = np.clip((xy - self.low) / self.edge - 0.5, 0, most)
        first = np.minimum(at.astype(np.int64), np.maximum(most - 1, 0))
        (x, y), (u, v) = first.T, (at - first).T
        beyond_x, beyond_y = np.minimum(x + 1, most[0]), np.minimum(y + 1, most[1])
        heights = self.heights
        lower = heights[x, y] * (1 - u) + heights[beyond_x, y] * u
        upper = heights[x, beyond_y] * (1 - u) + heights[beyond_x, beyond_y] * u
        found: Floats = lower * (1 - v) + upper * v
        return found

    def spots(self, count: int, rng: np.random.Generator) -> Floats:
        """Return places to stand (count, 2)."""
        spots = self.places[rng.integers(len(self.places), size=count)]
        return spots + rng.uniform(-SQUARE / 2, SQUARE / 2, (count, 2))

    def wander(self, length: float, inside: float, rng: np.random.Generator, hurried: bool) -> Floats:
        """Return corners (k, 2) of a path from place to place. There are no known doors."""
        corners = [self.spots(1, rng)[0]]
        walked, ahead = 0.0, np.zeros(2)
        while walked < length or len(corners) < 3:
            options = self.spots(24, rng)
            ways = options - corners[-1]
            lengths = np.linalg.norm(ways, axis=1)
            cosines = ways @ ahead / np.maximum(lengths, 1e-9)
            good = (lengths >= SHORTEST) & (lengths <= LONGEST) & (cosines >= TURN)
            # In a small place no stretch may be long enough: take the longest of the others.
            chosen = (
                int(np.flatnonzero(good)[0]) if good.any() else int(np.argmin(np.abs(lengths - SHORTEST)))
            )
            if lengths[chosen] < 1e-3:
                options[chosen] += SQUARE / 2
                lengths[chosen] = np.linalg.norm(options[chosen] - corners[-1])
            ahead = (options[chosen] - corners[-1]) / lengths[chosen]
            walked += float(lengths[chosen])
            corners.append(options[chosen])
        return np.array(corners)

    def tour(self, rng: np.random.Generator) -> Floats:
        """Return corners (k, 2) of a closed loop through places all over the archive, row by row."""
        chosen = self.places[
            np.linspace(0, len(self.places) - 1, min(TOUR_PLACES, len(self.places))).astype(int)
        ]
        low, high = chosen.min(axis=0), chosen.max(axis=0)
        rows = max(1, round(np.sqrt(len(chosen))))
        row = np.minimum(
            (chosen[:, 1] - low[1]) / max(float(high[1] - low[1]), 1e-9) * rows, rows - 1
        ).astype(int)
        along = np.where(row % 2 == 0, chosen[:, 0], -chosen[:, 0])
        corners = chosen[np.lexsort((along, row))]
        corners = corners + rng.uniform(-SQUARE / 4, SQUARE / 4, corners.shape)
        if len(corners) < 3:
            corners = corners[0] + 2.0 * np.array([(0, 0), (1, 0), (1, 1), (0, 1)], np.float64)
        return np.concatenate([corners, corners[:1]])

    def crowded(self) -> "ArchiveFloor":
        """Return the places around the middle one."""
        middle = self.places[np.linalg.norm(self.places - np.median(self.places, axis=0), axis=1).argmin()]
        near = (np.abs(self.places - middle) <= CROWD_WIDTH / 2).all(axis=1)
        return self._replace(places=self.places[near])


def read_floor(folder: Path, lift: float) -> ArchiveFloor:
    """Find the floor of an archive.

    lift: added to all heights [m]: the radii of the avatar and of the points, which else touch at
    every step.
    Raises BadDataError if no place has enough points.
    """
    with Archive(folder) as archive:
        found = [place for row in _chosen_voxels(archive) for place in _places(archive, row)]
    if not found:
        raise BadDataError(
            f"{folder}: no square metre of a floor with {LEAST_POINTS} points found, expected a place to walk in: "
            "give walks of your own with --walk"
        )
    places = np.array(found)
    return make_floor(places[:, :2], places[:, 2] + lift)


def make_floor(xy: Floats, z: Floats) -> ArchiveFloor:
    """Return the floor through places (k, 2) at heights (k,) [m]."""
    low, size = xy.min(axis=0) - SQUARE / 2, np.ptp(xy, axis=0) + SQUARE
    edge = max(SQUARE, float(np.sqrt(size.prod() / MAP_SQUARES)), float(size.max()) / MAP_SQUARES)
    shape = np.ceil(size / edge).astype(int)
    at = np.minimum(((xy - low) / edge).astype(int), shape - 1)
    # The least height where a square has several: the floor below a gallery.
    heights = np.full(shape, np.inf)
    np.minimum.at(heights, (at[:, 0], at[:, 1]), z)
    heights[np.isinf(heights)] = np.nan
    return ArchiveFloor(xy, _filled(heights), low, edge)


def _chosen_voxels(archive: Archive) -> list[int]:
    """Return index rows of the lowest voxel with points of evenly chosen columns."""
    coordinates, counts = archive.coordinates, archive.voxels["rows"][:, 2].astype(np.int64)
    rows = np.flatnonzero(counts >= LEAST_POINTS)
    rows = rows[np.lexsort((coordinates[rows, 2], coordinates[rows, 1], coordinates[rows, 0]))]
    if not len(rows):
        return []
    first = np.any(np.diff(coordinates[rows, :2], axis=0, prepend=coordinates[rows[:1], :2] - 1) != 0, axis=1)
    lowest = rows[first]
    most = max(1, min(COLUMNS, round(READ_POINTS / max(1.0, float(counts[lowest].mean())))))
    chosen: list[int] = lowest[np.linspace(0, len(lowest) - 1, min(most, len(lowest))).astype(int)].tolist()
    return chosen


def _places(archive: Archive, row: int) -> list[tuple[float, float, float]]:
    """Return the places (x, y, z) [m] of a voxel's floor, at most COLUMN_SQUARES."""
    lattice = archive.header.lattice
    base = archive.coordinates[row] * lattice.voxel_steps
    blocks = [block.xyz for block in iter_points(archive.open_voxel(row, columns=()), np.zeros(3, np.int64))]
    xyz = lattice.to_world(np.concatenate(blocks).astype(np.int64) + base)
    square = np.floor(xyz[:, :2] / SQUARE).astype(np.int64)
    order = np.lexsort((square[:, 1], square[:, 0]))
    starts = np.flatnonzero(
        np.any(np.diff(square[order], axis=0, prepend=square[order[:1]] - 1) != 0, axis=1)
    )
    ends = np.append(starts[1:], len(order))
    full = np.flatnonzero(ends - starts >= LEAST_POINTS)
    found = []
    for k in full[np.linspace(0, len(full) - 1, min(COLUMN_SQUARES, len(full))).astype(int)]:
        held = xyz[order[starts[k] : ends[k]]]
        x, y = (square[order[starts[k]]] + 0.5) * SQUARE
        found.append((float(x), float(y), floor_height(held[:, 2])))
    return found


def _filled(heights: Floats) -> Floats:
    """Fill unknown heights (nx, ny): interpolated along rows with known ones, then between rows."""
    known = np.flatnonzero(np.isfinite(heights).any(axis=1))
    columns = np.arange(heights.shape[1])
    lines = []
    for row in known:
        held = np.isfinite(heights[row])
        lines.append(np.interp(columns, columns[held], heights[row, held]))
    rows = np.arange(heights.shape[0])
    table = np.array(lines)
    return np.stack([np.interp(rows, known, table[:, column]) for column in columns], axis=1)
