"""Construction of the cell of a heap: more points at one lattice position than fit in memory.

The points of a heap form one cell and differ only in their columns, whose order is canonical. The
columns are merged from the runs, each of which has that order, a few rows of each run at a time.
"""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.voxel import Nodes
from ...schemas.kernels.morton import morton_decode
from ..config import BuildConfig
from ..kernels.trees.pack_tree import max_nodes, node_counts
from ..spool.point_order import packed_look
from ..spool.run_files import ranks
from .voxel_octree import CellTrees, build_trees

# Greater than every key.
_END = (1 << 64, 0)


def heap_place(code: int) -> NDArray[np.int32]:
    """Return the position (1, 3) of all points with the Morton code `code` [voxel steps]."""
    return morton_decode(np.array([code], np.uint64)).astype(np.int32)


def heap_trees(code: int, points: int, config: BuildConfig) -> CellTrees:
    """Make the cell that `build_trees` makes of `points` points with one Morton code.

    The points themselves are not needed, and the result lacks `xyz` and `rank`. Memory holds only
    the nodes.
    """
    one = build_trees(
        np.repeat(heap_place(code), 3, axis=0), np.zeros(1, np.int64), np.zeros(1, np.uint8), config
    )
    most = max_nodes(points, config.leaf)
    count, held = np.empty(most, np.uint8), np.empty(most, np.int64)
    total = node_counts(points, config.leaf, config.degree, count, held)
    nodes = Nodes._make(np.repeat(column[:1], total, axis=0) for column in one.nodes)
    nodes.normal[held[:total] < 3] = 0  # as in `stored_direction`
    spreads = one.spreads.copy()
    spreads[0, 0] = points
    return one._replace(
        starts=np.array([0, points]),
        rows=np.array([0, total]),
        nodes=nodes._replace(count=count[:total]),
        spreads=spreads,
        xyz=np.empty((3, 0), np.uint16),
        rank=np.empty(0, np.int32),
    )


class _Run:
    """State of a run during the merge.

    rows: its rows in memory, in order; None at its end.  keys: (n, 2) uint64, see `_order_keys`.
    """

    def __init__(self, windows: Iterator[NDArray]) -> None:
        """Read the first window."""
        self._windows = windows
        self._read()

    def _read(self) -> None:
        rows = next(self._windows, None)
        self.rows = rows
        self.keys = np.empty((0, 2), np.uint64) if rows is None else _order_keys(rows)

    def key(self, at: int) -> tuple[int, int]:
        """Return the key of the first (0) or last (-1) row in memory; _END at the run's end."""
        return (int(self.keys[at, 0]), int(self.keys[at, 1])) if len(self.keys) else _END

    def take(self, bound: tuple[int, int]) -> tuple[NDArray, NDArray[np.uint64]]:
        """Return the rows in memory whose key is at most `bound`, and their keys.

        Then advance past them.
        """
        assert self.rows is not None
        high, low = np.uint64(bound[0]), np.uint64(bound[1])
        begin, end = (int(np.searchsorted(self.keys[:, 0], high, side)) for side in ("left", "right"))
        cut = begin + int(np.searchsorted(self.keys[begin:end, 1], low, "right"))
        taken = self.rows[:cut], self.keys[:cut]
        if cut == len(self.keys):
            self._read()
        else:
            self.rows, self.keys = self.rows[cut:], self.keys[cut:]
        return taken


def merge_runs(runs: Sequence[Iterator[NDArray]]) -> Iterator[NDArray]:
    """Yield the spool rows of one lattice position in canonical order, some at a time.

    runs: the rows of each run in order, a window at a time. Memory holds at most two windows of
    each.
    """
    held = [_Run(windows) for windows in runs]
    first, last = ([run.key(at) for run in held] for at in (0, -1))
    # No unread row precedes the least of the last rows in memory.
    while (bound := min(last)) != _END:
        parts = []
        for i in [i for i, key in enumerate(first) if key <= bound]:
            parts.append(held[i].take(bound))
            first[i], last[i] = held[i].key(0), held[i].key(-1)
        keys = np.concatenate([keys for _, keys in parts])
        # Rows with equal keys are identical.
        yield np.concatenate([rows for rows, _ in parts])[np.lexsort((keys[:, 1], keys[:, 0]))]


def _order_keys(rows: NDArray) -> NDArray[np.uint64]:
    """Return pairs of integers (n, 2) that sort as the rows of one lattice position do.

    The order is that of `canonical_columns` (run_files.py).
    """
    keys, names = np.zeros((len(rows), 2), np.uint64), rows.dtype.names or ()
    if "scan_index" in names:
        keys[:, 0] |= rows["scan_index"].astype(np.uint64) << np.uint64(32)
    if "intensity" in names:
        keys[:, 0] |= ranks(np.ascontiguousarray(rows["intensity"]).view(np.uint32)).astype(np.uint64)
    looks = [rows[name] if name in names else None for name in ("rgb", "classification")]
    if any(look is not None for look in looks):
        keys[:, 1] = packed_look(*looks)
    return keys
