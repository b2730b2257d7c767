"""Tiles of a scene: the methods of `Scene` that viewers draw with."""

from collections.abc import Sequence
from contextlib import ExitStack

from numpy.typing import ArrayLike

from ...schemas.errors import BadRequestError, CorruptError
from ...schemas.wire.overview_messages import OverviewAnswer, OverviewRequest
from ...schemas.wire.tile_messages import TileAnswer, VoxelsAnswer, tile_request, voxels_request
from ..archives.placed_archive import PlacedArchive
from ..tiles.scene_overview import read_overview
from ..tiles.voxel_list import list_voxels
from ..tiles.voxel_tile import read_tile
from .residency_watch import ResidencyWatch


class SceneTiles:
    """Voxels and tiles of placed archives. Thread-safe."""

    archives: list[PlacedArchive]

    def overview(self, limit: int = 100_000) -> OverviewAnswer:
        """Return a sample of the points of all archives; see `OverviewAnswer`.

        It is that of the archives' previews: how long it takes does not depend on the number of
        points.
        """
        request = OverviewRequest(limit)
        with ExitStack() as stack:
            opened = [stack.enter_context(archive.take()).store for archive in self.archives]
            return read_overview(request, self.archives, opened)

    def voxels(self, place: ArrayLike, reach: float | None = None, limit: int = 4096) -> VoxelsAnswer:
        """Return the voxels near a place (3,) [m], nearest first; see `VoxelsRequest`."""
        request = voxels_request(place, reach, limit)
        with ExitStack() as stack:
            opened = [stack.enter_context(archive.take()) for archive in self.archives]
            return list_voxels(request, self.archives, opened)

    def residency_changes(self) -> ResidencyWatch:
        """Return the changes of what is resident from now on, for a `with`; see `ResidencyChanges`."""
        return ResidencyWatch(self.archives)

    def tile(
        self, archive: int, voxel: Sequence[int], detail: int = 0, level: int | None = None
    ) -> TileAnswer:
        """Return points or spheres of a voxel; see `TileRequest`. Raise BadRequestError, CorruptError.

        The record is read from the archive's file, and not added to the voxels in memory.
        """
        request = tile_request(archive, voxel, detail, level)
        if request.archive >= len(self.archives):
            raise BadRequestError(f"archive {archive}: expected below {len(self.archives)}")
        placed = self.archives[request.archive]
        with placed.take() as opened:
            try:
                return read_tile(request, placed, opened.store, opened.level_archive)
            except OSError as error:
                raise CorruptError(
                    f"voxel {request.voxel}: cannot be read ({error}): check the disk"
                ) from error
