"""Messages with what the page draws: overview, tiles, voxels. Tiles are kept for all browsers, within a budget."""

import threading
from collections import OrderedDict
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ....schemas.wire.overview_messages import OverviewAnswer
from ....schemas.wire.tile_messages import MAX_DETAIL, TileAnswer, VoxelsAnswer
from ..page.page_messages import Place, TileKey, binary_message
from ..page.view_frame import ViewFrame
from .scene_link import OpenScene

# Memory for tiles that a browser may ask for again [bytes].
TILE_BYTES = 192 << 20
# Most voxels of a list, and points of an overview.
_MAX_VOXELS, _OVERVIEW_POINTS = 4096, 120_000
# Columns of points.
_COLUMNS = ("rgb", "intensity", "classification", "scan")


class TileSource:
    """Tiles and lists of voxels of the scene, as messages for the page. Thread-safe.

    A tile that two browsers want at once may be read twice.
    """

    def __init__(self, scene: Callable[[], OpenScene | None], budget: int = TILE_BYTES) -> None:
        """Make a source. scene: returns the scene that is shown.  budget: for tiles [bytes]."""
        self._scene, self._budget = scene, budget
        self._kept: OrderedDict[tuple[int, TileKey], bytes] = OrderedDict()
        self._bytes = 0
        self._overview: tuple[int, bytes] | None = None  # generation, message
        self._lock = threading.Lock()

    def tile(self, key: TileKey) -> bytes | None:
        """Return the message of a tile; None without a scene. Raise the server's errors."""
        scene = self._scene()
        if scene is None:
            return None
        name = (scene.info.generation, key)
        with self._lock:
            if name in self._kept:
                self._kept.move_to_end(name)
                return self._kept[name]
        archive, i, j, k, detail = key
        message = tile_message(key, scene.reader.tile(archive, (i, j, k), detail), scene.frame)
        with self._lock:
            self._bytes += len(message) - len(self._kept.pop(name, b""))
            self._kept[name] = message
            while self._bytes > self._budget and len(self._kept) > 1:
                _, dropped = self._kept.popitem(last=False)
                self._bytes -= len(dropped)
        return message

    def overview(self, scene: OpenScene) -> bytes:
        """Return the message of a sample of the scene's points."""
        with self._lock:
            kept = self._overview
        if kept is None or kept[0] != scene.info.generation:
            message = overview_message(scene.reader.overview(_OVERVIEW_POINTS), scene.frame)
            kept = (scene.info.generation, message)
            with self._lock:
                self._overview = kept
        return kept[1]

    def voxels(self, place: Place) -> bytes | None:
        """Return the message of the voxels near a place of the page's frame; None without a scene."""
        scene = self._scene()
        if scene is None:
            return None
        answer = scene.reader.voxels(scene.frame.to_world(place), limit=_MAX_VOXELS)
        return voxels_message(answer, scene.frame)


def tile_message(key: TileKey, tile: TileAnswer, frame: ViewFrame) -> bytes:
    """Return a tile as a message.

    The points are ordered so that a coarser detail is the beginning of the message's arrays: a page
    that has all points draws fewer of them without asking again.
    """
    order = coarse_first(len(tile.points))
    arrays: dict[str, NDArray] = {"points": tile.points[order]}
    arrays |= {name: column[order] for name, column in _columns(tile).items()}
    return binary_message(
        "tile",
        arrays,
        key=list(key[:4]),
        detail=key[4],
        matrix=frame.pose(tile.pose[0]).tolist(),
        step=tile.step,
        total=tile.total,
        radius=tile.radius,
    )


def _columns(answer: TileAnswer | OverviewAnswer) -> dict[str, NDArray]:
    """Return the columns that an answer has. Colours that are all black were in no scan."""
    found = {name: getattr(answer, name) for name in _COLUMNS}
    return {name: column for name, column in found.items() if len(column) and (name != "rgb" or column.any())}


def overview_message(answer: OverviewAnswer, frame: ViewFrame) -> bytes:
    """Return an overview as a message. Points are in the page's frame [m]."""
    points = np.empty((len(answer.points), 3), np.float32)
    for number, pose in enumerate(answer.poses):
        own = slice(int(answer.starts[number]), int(answer.starts[number + 1]))
        local = answer.points[own].astype(np.float64) + answer.low[number]
        points[own] = frame.points(local @ pose[:3, :3].T + pose[:3, 3])
    arrays = {"points": points, **_columns(answer)}
    return binary_message(
        "overview", arrays, total=answer.total, radius=answer.radius, intensities=answer.intensities
    )


def coarse_first(count: int) -> NDArray[np.int64]:
    """Return an order of items 0 .. count in which those divisible by higher powers of 4 come first."""
    items = np.arange(count)
    level = np.zeros(count, np.int8)
    for power in range(1, MAX_DETAIL + 1):
        level[:: 4**power] = power
    return items[np.argsort(-level, kind="stable")]


def voxels_message(answer: VoxelsAnswer, frame: ViewFrame) -> bytes:
    """Return a list of voxels as a message. Boxes are in the page's frame [m]."""
    low, high = frame.boxes(answer.poses[answer.archive], answer.low, answer.high)
    keys = np.column_stack([answer.archive.astype(np.int32), answer.voxel])
    return binary_message(
        "voxels",
        {
            "key": keys.astype(np.int32),
            "low": low.astype(np.float32),
            "high": high.astype(np.float32),
            "points": answer.points.astype(np.uint32),
            "resident": answer.resident.astype(np.uint8),
        },
        total=answer.total,
    )
