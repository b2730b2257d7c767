"""Order in which resident voxels are evicted: least recently used first, after [Fig12] section 4.

The class uses no threads, no clock and no voxel data: `VoxelCache` calls it under its lock, and
scripts/simulate_cache replays traces with it. It does not know about pins or prefetches: `victims`
yields every resident row, and the caller skips those that must stay. Another policy would be
another class with these four methods. Two were measured, and the order hardly matters once voxels
are prefetched (server/DESIGN.md, "Prefetching").
"""

from collections import OrderedDict
from collections.abc import Iterator

from ...schemas.errors import BadRequestError

POLICIES = ("lru", "lru+prefetch")

# Share of the budget that scans may fill while other requests need room. Scans are sweeps along a
# path, and requests right after a teleport. Without a limit, one sweep through the archive evicts
# the voxels around every user. Measured with
# `scripts/simulate_cache --sweeps 10 --kinds stroll`, ten sweeps in five minutes beside eight
# strolling users in a town of 4e7 points: these users miss 362 voxels, 440 if sweeps are not marked
# as scans, and 326 without sweeps.
SCAN_SHARE = 0.1


def prefetches(name: str) -> bool:
    """Return whether voxels are prefetched under this policy."""
    return name == "lru+prefetch"


class EvictionPolicy:
    """Least recently used first, with a bounded share for scans.

    Rows are index rows of voxels; a row is added at most once before it is removed. A row added by
    a scan is also in a separate queue until another request uses it. While that queue holds more
    than SCAN_SHARE of the budget, its oldest rows are evicted before all others; within that share
    its rows are treated like the rest.
    """

    def __init__(self, budget_bytes: int, name: str = "lru") -> None:
        """Begin without rows. Raise BadRequestError for an unknown name."""
        if name not in POLICIES:
            raise BadRequestError(f"policy {name!r}: expected one of {', '.join(POLICIES)}")
        self.name = name
        # row -> bytes, of all rows; least recently used first
        self._order: OrderedDict[int, int] = OrderedDict()
        self._scans: OrderedDict[int, int] = OrderedDict()  # the same, of rows used by scans only
        self._scan_bytes = 0
        self._max_scan_bytes = int(budget_bytes * SCAN_SHARE)

    def added(self, row: int, size: int, *, scan: bool) -> None:
        """Record that `size` bytes were allocated to a row.

        scan: whether a scan requested the row; False for a prefetch.
        """
        self._order[row] = size
        if scan:
            self._scans[row] = size
            self._scan_bytes += size

    def used(self, row: int, *, scan: bool) -> None:
        """Record that a row that is resident or being loaded was requested."""
        self._order.move_to_end(row)
        if row in self._scans:
            if scan:
                self._scans.move_to_end(row)
            else:
                self._scan_bytes -= self._scans.pop(row)

    def removed(self, row: int) -> None:
        """Record that the bytes of a row were released: it was evicted, or was never loaded."""
        del self._order[row]
        self._scan_bytes -= self._scans.pop(row, 0)

    def victims(self) -> Iterator[int]:
        """Iterate over all rows with allocated bytes in order of eviction, each once.

        The order is computed during the iteration, which any other call invalidates.
        """
        over = self._scan_bytes - self._max_scan_bytes
        named: set[int] = set()
        if over > 0:
            for row, size in self._scans.items():
                named.add(row)
                yield row
                over -= size
                if over <= 0:
                    break
        for row in self._order:
            if row not in named:
                yield row
