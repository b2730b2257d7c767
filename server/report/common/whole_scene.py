"""Scene whose cache holds a whole archive."""

from pathlib import Path

from ...residency.arena import ArenaBuffer
from ...residency.voxel_store import VoxelStore
from ...scene import Scene


def open_whole(folder: Path) -> Scene:
    """Open an archive with a cache for all its voxels: answers are timed, not loads."""
    store = VoxelStore(folder)
    try:
        budget = sum(ArenaBuffer.rounded(int(size)) for size in store.sizes)
    finally:
        store.close()
    return Scene.open(folder, budget_bytes=budget)
