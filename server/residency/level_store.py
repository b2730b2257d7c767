"""Level of detail of an archive in memory: its store, its cache, and how it is filled.

schemas/archive/level.py says what a level is. Its voxels are small, a thirtieth of the archive's,
and lie in a cache of their own, so that voxels of the archive do not displace them.
"""

from collections.abc import Iterator
from typing import NamedTuple

from ...schemas.archive.level import open_level
from ...schemas.errors import BadRequestError
from .arena import ArenaBuffer
from .voxel_cache import VoxelCache
from .voxel_store import VoxelStore

# Share of the budget for the level, by default.
BUDGET_SHARE = 1 / 16


class LevelStore(NamedTuple):
    """Opened level. store: of its archive.  residency: its cache.  fits: whether it holds all voxels."""

    store: VoxelStore
    residency: VoxelCache
    fits: bool


def open_level_store(store: VoxelStore, budget_bytes: int, level_bytes: int | None) -> LevelStore | None:
    """Open the level of an archive within a budget.

    Return None if there is no level, or if it gets too little memory for its largest voxel.
    budget_bytes: of archive and level together.  level_bytes: of it for the level, 0: open none;
    None: a sixteenth, or enough for the largest voxel of the level, if the largest of the archive
    still fits. Less is taken if the level is smaller. Raise FormatError or CorruptError for a level
    that cannot be read, BadRequestError for a negative or too large number of bytes.
    """
    if level_bytes is not None and not 0 <= level_bytes <= budget_bytes:
        raise BadRequestError(
            f"{level_bytes} bytes for the level of detail: expected 0 to {budget_bytes}, of which they are a part: "
            "give a smaller --level-bytes or a larger --cache"
        )
    level = open_level(store.archive) if level_bytes != 0 and store.is_as_stored else None
    if level is None:
        return None
    found = VoxelStore(level.folder, lambda _: level)
    largest = ArenaBuffer.rounded(int(found.sizes.max(initial=0)))
    most = max(largest, int(budget_bytes * BUDGET_SHARE)) if level_bytes is None else level_bytes
    every = sum(ArenaBuffer.rounded(size) for size in found.sizes.tolist())
    most = min(most, every)
    left = ArenaBuffer.rounded(int(store.sizes.max(initial=0))) if level_bytes is None else 0
    if most < largest or budget_bytes - most < left:
        found.close()
        return None
    return LevelStore(found, VoxelCache(found, most), every <= most)


def fill_level(level: LevelStore) -> Iterator[None]:
    """Load all voxels of a level that fits, one at a step."""
    for row in range(len(level.store.sizes)):
        # An unreadable voxel is reported by the request that loads it.
        level.residency.load_in_background(row, lambda _: False)
        yield
