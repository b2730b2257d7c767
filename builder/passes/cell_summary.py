"""Figures of an archive's leaf cells, for its summary: their number, size and height."""

from collections import Counter
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from ...schemas.archive.archive import Archive
from ...schemas.archive.voxel import LeafCells, Links
from ...schemas.errors import CorruptError
from ..config import DEFAULT_CELL_POINTS
from ..voxel.balance_cells import tree_limits


@dataclass(frozen=True, slots=True, kw_only=True)
class CellSummary:
    """Leaf cells of an archive.

    cells: their number.  asked: the requested number (`--leaf-cells`), None if there was none.
    most: maximum number of points of a cell, except for points at one lattice position.
    kind: "octree" or "balanced".
    heights: levels of a cell's tree -> number of cells; None if the records were not read.
    fewest: least number of points of a packed tree of the common height; None in an octree.
    small: cells with fewer points than `fewest`, which could not be merged within their largest
    permitted cube. None in an octree, or if the records were not read.
    """

    cells: int
    asked: int | None
    most: int
    kind: str
    fewest: int | None = None
    heights: dict[int, int] | None = None
    small: int | None = None


def summarize_cells(archive: Archive, *, heights: bool = False) -> CellSummary:
    """Return the figures of the cells of an open archive.

    Reads the hierarchies of all voxels if the cells are balanced or with `heights`, otherwise the
    index alone. A record that cannot be read leaves these figures out.
    """
    header = archive.header
    options = header.options
    balanced = options.get("cells") == "balanced"
    most, fewest = int(options.get("cell_points", DEFAULT_CELL_POINTS)), None
    if balanced:
        fewest, most = tree_limits(most, header.leaf, header.degree)
    levels, small = None, None
    if balanced or heights:
        with suppress(CorruptError, OSError):
            levels, small = _count_heights(archive, fewest or 0)
    return CellSummary(
        cells=int(archive.voxels["rows"][:, 0].sum(dtype=np.int64)),
        asked=options.get("leaf_cells"),
        most=most,
        kind="balanced" if balanced else "octree",
        heights=levels,
        fewest=fewest,
        small=small if balanced else None,
    )


def _count_heights(archive: Archive, fewest: int) -> tuple[dict[int, int], int]:
    """Return the number of cells of each height, and of those with fewer than `fewest` points."""
    found, small = Counter[int](), 0
    for row in range(len(archive.voxels)):
        tree = archive.open_tree(row)
        found.update(tree_heights(tree.cells, tree.links))
        small += int(np.count_nonzero(tree.cells.points < fewest))
    return dict(sorted(found.items())), small


def tree_heights(cells: LeafCells, links: Links) -> list[int]:
    """Return the number of levels of the tree of every cell, in the order of the cells."""
    root = len(links.first) - int(cells.nodes.sum(dtype=np.int64))
    heights = []
    for node in range(root, root + len(cells.nodes)):
        levels = 1
        while not links.is_leaf[node]:
            node, levels = links.first[node], levels + 1
        heights.append(levels)
    return heights
