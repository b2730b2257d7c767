"""Paths of people in a generated town, from its truth: forecourts, doors, naves, streets and lanes.

Frame: the world's, metres, z up. A visit of a façade and the connections between visits are corners
of a path, without turns much above a right angle: rounding them leaves no cusp
(walking_motion.py). The path through the main door is straight from before the portal until behind
the wall.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .....builder.synthetic.facade import FORECOURT_Y, NAVE_X, NAVE_Y
from .....builder.synthetic.town import PITCH_X, PITCH_Y
from .....builder.synthetic.truth import FacadeTruth, SceneTruth
from .....builder.synthetic.walk import floor_height

Floats = NDArray[np.float64]
Cell = tuple[int, int]  # column, row of a façade in the town

# In a façade's own frame: the middle of the street before its forecourt, and where a visit leaves
# and rejoins it.
STREET_Y = FORECOURT_Y - 2.0
SIDE_X = 6.5
# Maximum random offset of a path's corners [m].
LOOSE = 0.5


class Town(NamedTuple):
    """Façades of a generated scene by column and row; a single façade is a town too."""

    facades: dict[Cell, FacadeTruth]

    @property
    def cells(self) -> list[Cell]:
        """Return all cells, row by row."""
        return sorted(self.facades, key=lambda cell: (cell[1], cell[0]))

    def bounds(self) -> Floats:
        """Return (2, 2): least and greatest x and y of all paths, lanes and streets included."""
        cells = np.array(self.cells, np.float64)
        low, high = cells.min(axis=0), cells.max(axis=0)
        return np.array(
            [
                [(low[0] - 0.5) * PITCH_X - LOOSE, low[1] * PITCH_Y + STREET_Y - 2 * LOOSE],
                [(high[0] + 0.5) * PITCH_X + LOOSE, high[1] * PITCH_Y + NAVE_Y],
            ]
        )

    def only(self, cell: Cell) -> "Town":
        """Return the town of only one of its façades."""
        return Town({cell: self.facades[cell]})

    def spots(self, count: int, rng: np.random.Generator) -> Floats:
        """Return places to stand; see `Ground`."""
        return spots(self, count, rng)

    def wander(self, length: float, inside: float, rng: np.random.Generator, hurried: bool) -> Floats:
        """Return the corners of a walk; see `Ground`."""
        return wander(self, length, inside, rng, hurried)

    def tour(self, rng: np.random.Generator) -> Floats:
        """Return the corners of a loop; see `Ground`."""
        return tour(self, rng)

    def crowded(self) -> "Town":
        """Return the façade in the middle, through whose door a crowd goes."""
        return self.only(self.cells[len(self.cells) // 2])

    def floor(self, xy: Floats) -> Floats:
        """Return the height of the floor [m] (k,) below positions (k, 2).

        The floor is the forecourt, the steps or the nave; 0 in streets and lanes.
        """
        column = np.rint(xy[:, 0] / PITCH_X).astype(np.int64)
        # The range from the middle of the street before a façade to the middle of the street behind
        # it.
        row = np.floor((xy[:, 1] - STREET_Y) / PITCH_Y).astype(np.int64)
        height = np.zeros(len(xy))
        for cell in {(int(c), int(r)) for c, r in zip(column, row, strict=True)} & self.facades.keys():
            truth = self.facades[cell]
            own = (column == cell[0]) & (row == cell[1])
            local = xy[own] - np.asarray(truth.origin[:2])
            built = (np.abs(local[:, 0]) <= NAVE_X) & (local[:, 1] <= NAVE_Y)
            height[own] = np.where(built, floor_height(truth, local), 0.0) + truth.origin[2]
        return height


def make_town_of(truth: SceneTruth) -> Town:
    """Return the town of this truth."""
    return Town({(round(f.origin[0] / PITCH_X), round(f.origin[1] / PITCH_Y)): f for f in truth.facades})


def spots(town: Town, count: int, rng: np.random.Generator) -> Floats:
    """Return places to stand (count, 2), drawn evenly over façades, forecourts and naves."""
    cells = town.cells
    origins = np.array([town.facades[cell].origin[:2] for cell in cells])[
        rng.integers(len(cells), size=count)
    ]
    inside = rng.random(count) < 0.5
    outer = np.column_stack([rng.uniform(-8.0, 8.0, count), rng.uniform(-16.0, -2.0, count)])
    inner = np.column_stack([rng.uniform(-3.0, 3.0, count), rng.uniform(2.0, 10.0, count)])
    return np.where(inside[:, None], inner, outer) + origins


def visit(
    truth: FacadeTruth, side: int, inside: bool, rng: np.random.Generator, hurried: bool = False
) -> Floats:
    """Return corners (k, 2) from the street over the forecourt to the portal and back to the street.

    side: +1: arrives at the left and leaves at the right, -1: the reverse.
    inside: through the main door, around the nave and out again.
    hurried: else only across the forecourt, in one wide turn.
    """
    if hurried and not inside:
        across = np.array(
            [(-SIDE_X, STREET_Y), (-SIDE_X, -12.0), (0.0, -7.0), (SIDE_X, -12.0), (SIDE_X, STREET_Y)]
        )
        across += rng.uniform(-LOOSE, LOOSE, across.shape)
        return across * (side, 1.0) + np.asarray(truth.origin[:2])
    way = [(-SIDE_X, STREET_Y), (-SIDE_X, -14.0), (-SIDE_X, -9.0), (-2.6, -8.0)]
    back = [(2.6, -8.0), (SIDE_X, -9.0), (SIDE_X, -14.0), (SIDE_X, STREET_Y)]
    middle = [(-1.2, -4.2), (1.2, -4.2)]
    if inside:
        middle = [
            (0.0, -5.5),
            (0.0, 3.4),
            (1.7, 4.8),
            (1.9, 8.2),
            (-1.9, 8.6),
            (-1.7, 4.8),
            (0.0, 3.4),
            (0.0, -5.5),
        ]
    corners = np.array([*way, *middle, *back])
    loose = rng.uniform(-LOOSE, LOOSE, corners.shape)
    if inside:
        # Straight through the door both ways, each with a small offset from its centre.
        free = max(0.0, truth.door("main").width / 2 - 0.4)
        at = len(way)
        for first, second in ((at, at + 1), (at + 6, at + 7)):
            loose[first] = loose[second] = (rng.uniform(-free, free), 0.0)
    corners = (corners + loose) * (side, 1.0)
    return corners + np.asarray(truth.origin[:2])


def next_visit(
    town: Town,
    way: Floats,
    cell: Cell,
    to: Cell,
    side: int,
    inside: bool,
    rng: np.random.Generator,
    hurried: bool = False,
) -> tuple[Floats, int]:
    """Return corners (k, 2) from the end of a path to the end of a visit of `to`, and its side.

    way: (n, 2), the path so far; it ends on the street of `cell`.
    side: of the visit that ends it.
    """
    start, between = way[-1], np.empty((0, 2))
    street = to[1] * PITCH_Y + STREET_Y
    if cell[1] != to[1]:
        # Over the lane beside the façade, on the side where the path left it.
        lane = (cell[0] + (0.5 if start[0] > cell[0] * PITCH_X else -0.5)) * PITCH_X + rng.uniform(-0.3, 0.3)
        between = np.array([(lane, start[1]), (lane, street + rng.uniform(-LOOSE, LOOSE))])
        start = between[-1]
    if to != cell:
        side = 1 if start[0] < to[0] * PITCH_X else -1
    return np.concatenate([between, visit(town.facades[to], side, inside, rng, hurried)]), side


def wander(
    town: Town, length: float, inside: float, rng: np.random.Generator, hurried: bool = False
) -> Floats:
    """Return corners (k, 2) of a path from façade to neighbouring façade, of at least `length` metres.

    inside: share of the visits that pass the door.
    hurried: the others cross the forecourt in one wide turn.
    """
    cells = town.cells
    cell = cells[int(rng.integers(len(cells)))]
    side = int(rng.choice((-1, 1)))
    parts = [visit(town.facades[cell], side, bool(rng.random() < inside), rng, hurried)]
    walked = path_length(parts[0])
    while walked < length:
        near = [c for c in cells if abs(c[0] - cell[0]) + abs(c[1] - cell[1]) == 1] or [cell]
        to = near[int(rng.integers(len(near)))]
        enter = bool(rng.random() < inside)
        part, side = next_visit(town, parts[-1], cell, to, side, enter, rng, hurried)
        walked += path_length(np.concatenate([parts[-1][-1:], part]))
        parts.append(part)
        cell = to
    return np.concatenate(parts)


def tour(town: Town, rng: np.random.Generator) -> Floats:
    """Return corners (k, 2) of a closed loop through every façade, row by row."""
    rows = sorted({row for _, row in town.cells})
    order = [
        cell
        for k, row in enumerate(rows)
        for cell in sorted((c for c in town.cells if c[1] == row), reverse=k % 2 == 1)
    ]
    side, cell = 1, order[0]
    parts = [visit(town.facades[cell], side, True, rng)]
    for to in order[1:]:
        part, side = next_visit(town, parts[-1], cell, to, side, True, rng)
        parts.append(part)
        cell = to
    last, first = parts[-1][-1], parts[0][0]
    if cell[1] != order[0][1]:
        # Back over the leftmost lane, beside which no façade stands.
        lane = (min(column for column, _ in order) - 0.5) * PITCH_X
        parts.append(np.array([(lane, last[1]), (lane, first[1])]))
    parts.append(first[None])
    return np.concatenate(parts)


def path_length(corners: Floats) -> float:
    """Return the length of the path through corners (k, 2) [m]."""
    return float(np.linalg.norm(np.diff(corners, axis=0), axis=1).sum())
