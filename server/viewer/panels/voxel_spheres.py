"""Bounding spheres of one level of the hierarchy, in the voxels where a user stands.

This is figure 8 of [Fig12] in the scene itself: each voxel holds a hierarchy of bounding spheres, and
a query descends it level by level.
"""

import numpy as np
from numpy.typing import NDArray

from ....schemas.wire.tile_messages import MAX_SPHERE_LEVEL, TileAnswer, VoxelsAnswer
from ..feeds.scene_link import OpenScene
from ..page.page_messages import Place, binary_message
from ..page.view_frame import ViewFrame

# Voxels whose boxes are within this distance of the user's middle belong to where it stands [m], at
# most this many, nearest first.
_REACH, _MOST_VOXELS = 1.0, 8
# Spheres that a page is sent, nearest first: a picture of more would take seconds without a graphics
# processor, and none of them would be seen among the others.
MOST_SPHERES = 6000
# Share of the spheres that have the colour of the smallest ones.
_TINY = 0.05
# Voxels whose depth is kept.
_MOST_DEPTHS = 4096


class SphereSource:
    """Spheres near users, as messages for the page. Thread-safe."""

    def __init__(self) -> None:
        """Begin without known depths."""
        self._depths: dict[tuple[int, int, int, int, int], int] = {}  # by generation and voxel

    def message(self, scene: OpenScene, place: Place, level: int) -> bytes:
        """Return the spheres of a level near a place of the page's frame [m] as a message.

        level: 0 for the root of each voxel's hierarchy; leaf nodes above the level are included.
        """
        world = scene.frame.to_world(place)
        listed = scene.reader.voxels(world, reach=_REACH, limit=_MOST_VOXELS)
        if not len(listed.voxel):
            listed = scene.reader.voxels(world, limit=1)
        keys = [
            (int(archive), *voxel.tolist())
            for archive, voxel in zip(listed.archive, listed.voxel, strict=True)
        ]
        tiles = [scene.reader.tile(archive, voxel, level=level) for archive, *voxel in keys]
        depth = max((self._depth(scene, key) for key in keys), default=0)
        return spheres_message(listed, tiles, scene.frame, np.asarray(place), level, depth)

    def _depth(self, scene: OpenScene, key: tuple[int, int, int, int]) -> int:
        """Return the deepest level of a voxel's hierarchy: from it on, the spheres are its leaves'."""
        name = (scene.info.generation, *key)
        depth = self._depths.get(name)
        if depth is None:
            archive, *voxel = key
            leaves = len(scene.reader.tile(archive, voxel, level=MAX_SPHERE_LEVEL).spheres)
            depth = next(
                level
                for level in range(MAX_SPHERE_LEVEL + 1)
                if len(scene.reader.tile(archive, voxel, level=level).spheres) == leaves
            )
            if len(self._depths) >= _MOST_DEPTHS:
                self._depths.clear()
            self._depths[name] = depth
        return depth


def spheres_message(
    listed: VoxelsAnswer,
    tiles: list[TileAnswer],
    frame: ViewFrame,
    place: NDArray[np.float64],
    level: int,
    depth: int,
) -> bytes:
    """Return the spheres of tiles as a message; `listed` are their voxels."""
    centers, radii = placed_spheres(tiles, frame)
    kept = nearest(centers, radii, place, MOST_SPHERES)
    # A leaf node of one point has radius 0: it is drawn with the radius of a point.
    drawn = np.maximum(radii[kept], max((tile.radius for tile in tiles), default=0.0))
    low, high = frame.boxes(listed.poses[listed.archive], listed.low, listed.high)
    return binary_message(
        "spheres",
        {
            "center": centers[kept].astype(np.float32),
            "radius": drawn.astype(np.float32),
            "low": low.astype(np.float32),
            "high": high.astype(np.float32),
        },
        level=level,
        depth=depth,
        total=len(radii),
        points=sum(tile.total for tile in tiles),
        radii=[float(radii.min()), float(radii.max())] if len(radii) else None,
        # A few tiny leaf nodes would otherwise take most of the range of colours.
        shades=np.quantile(drawn, [_TINY, 1.0]).tolist() if len(drawn) else None,
    )


def placed_spheres(
    tiles: list[TileAnswer], frame: ViewFrame
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return centres (n, 3) in the page's frame and radii (n,) of the spheres of tiles [m]."""
    centers: list[NDArray[np.float64]] = [np.empty((0, 3))]
    radii: list[NDArray[np.float64]] = [np.empty(0)]
    for tile in tiles:
        pose = frame.pose(tile.pose[0])
        local = tile.points.astype(np.float64) * tile.step
        centers.append(local @ pose[:3, :3].T + pose[:3, 3])
        radii.append(tile.spheres.astype(np.float64) * tile.step)
    return np.concatenate(centers), np.concatenate(radii)


def nearest(
    centers: NDArray[np.float64], radii: NDArray[np.float64], place: NDArray[np.float64], most: int
) -> NDArray[np.int64]:
    """Return the numbers of the spheres whose surfaces are nearest to a place, large ones first.

    Large spheres first: where they are drawn, the small ones inside are drawn over them.
    """
    kept = np.arange(len(radii))
    if len(radii) > most:
        away = np.linalg.norm(centers - place, axis=1) - radii
        kept = np.argpartition(away, most)[:most]
    return kept[np.argsort(-radii[kept], kind="stable")]
