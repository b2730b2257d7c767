"""Memory that the level of detail of an archive takes."""

from pathlib import Path

from solidcloud.server.residency.arena import ArenaBuffer
from solidcloud.server.scene import Scene


def level_bytes(folder: Path) -> int:
    """Return the bytes of all voxels of the level of an archive in memory."""
    with Scene.open(folder, level_bytes=1 << 26) as scene, scene.archives[0].take() as opened:
        level = opened.level
        assert level is not None and level.fits
        return sum(ArenaBuffer.rounded(int(size)) for size in level.store.sizes)
