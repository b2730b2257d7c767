"""Cost of one request, summed over its holds: the fields of `Cost`."""

import time
from collections.abc import Sequence
from typing import Any

from ....schemas.wire.answers import Cost
from ...residency.held import Held
from .query_context import SceneData


class Spent:
    """Accumulated cost of a request. Not thread-safe."""

    __slots__ = ("begin", "faults", "hits", "late", "loaded", "misses", "waited")

    def __init__(self, begin: float) -> None:
        """Begin with zero cost. begin: start time on time.perf_counter()'s clock [s]."""
        self.begin = begin
        self.hits = self.misses = 0
        self.loaded = 0  # voxels the request itself has loaded for later holds: they are no hits
        self.waited = 0.0
        self.faults: dict[str, None] = {}
        self.late: dict[int, None] = {}

    def add(self, held: Held, again: int = 0) -> None:
        """Add a hold. again: number of its hits on voxels that the request has held before."""
        found = held.hits - again - self.loaded
        self.hits, self.loaded = self.hits + max(0, found), max(0, -found)
        self.misses += held.misses
        self.waited += held.waited
        self.faults.update(dict.fromkeys(held.faults))
        self.late.update(dict.fromkeys(held.late))

    def add_cost(self, cost: Cost, data: SceneData) -> None:
        """Add the cost of another query."""
        rows = [int(data.broad.keys.searchsorted(key)) for key in cost.late]
        self.add(Held(cost.hits, cost.misses, cost.faults, tuple(rows), cost.wait_seconds))

    def cost(self, data: SceneData) -> dict[str, Any]:
        """Return the fields of `Cost`; call it when the answer is complete."""
        residency = data.residency
        return {
            "engine_seconds": time.perf_counter() - self.begin,
            "hits": self.hits,
            "misses": self.misses,
            "resident": residency.resident,
            "resident_bytes": residency.resident_bytes,
            "faults": tuple(self.faults),
            "wait_seconds": self.waited,
            "late": _keys(data, tuple(self.late)),
        }


def _keys(data: SceneData, rows: Sequence[int]) -> tuple[int, ...]:
    """Return the keys of voxels, given their rows in the index."""
    return tuple(data.broad.keys[list(rows)].tolist()) if rows else ()
