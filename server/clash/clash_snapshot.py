"""A picture of points from a viewpoint, without a browser or a graphics library.

Points are squares of their size in the world; the nearest at a pixel is seen. Pixels that lie behind
their neighbours are darker, as in the viewer (Boucheny 2009).
"""

import struct
import zlib
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .clash_viewpoint import FIELD_OF_VIEW, Viewpoint

Floats = NDArray[np.float64]
Colours = NDArray[np.uint8]

SIZE = (960, 540)
_GROUND = (10, 14, 21)
# Nearer points hide too much [m].
_NEAR = 0.6
# Largest half width of a point [pixels].
_LARGEST = 8
_SHADE = 2.5
# Pixels of a point around its middle: squared distance, columns, rows; nearest first.
_OFFSETS = sorted(
    (dx * dx + dy * dy, dx, dy)
    for dx in range(-_LARGEST, _LARGEST + 1)
    for dy in range(-_LARGEST, _LARGEST + 1)
)


class Cloud(NamedTuple):
    """Points to draw.

    points: (n, 3), world [m].  colours: (n, 3).  radius: of the points [m].
    over: whether they are drawn over everything else.
    """

    points: Floats
    colours: Colours
    radius: float
    over: bool = False


def draw(view: Viewpoint, clouds: list[Cloud], size: tuple[int, int] = SIZE) -> Colours:
    """Return a picture (height, width, 3) of points from a viewpoint. size: width, height."""
    width, height = size
    depth = np.full(width * height, np.inf)
    colour = np.empty((width * height, 3), np.uint8)
    colour[:] = _GROUND
    for cloud in sorted(clouds, key=lambda each: each.over):
        if cloud.over:
            depth = _shaded(depth, colour, size)
        _paint(view, cloud, size, depth, colour)
    _shaded(depth, colour, size)
    return colour.reshape(height, width, 3)


def _paint(view: Viewpoint, cloud: Cloud, size: tuple[int, int], depth: Floats, colour: Colours) -> None:
    """Draw a cloud into `depth` and `colour`, one entry per pixel."""
    width, height = size
    ahead = view.direction
    right = np.cross(ahead, view.up)
    right /= np.linalg.norm(right)
    seen = (cloud.points - view.eye) @ np.stack([right, np.cross(right, ahead), ahead]).T
    scale = height / (2 * np.tan(np.radians(FIELD_OF_VIEW) / 2))
    order = np.flatnonzero(seen[:, 2] > _NEAR)
    # Farthest first: of several points on a pixel, numpy stores the last.
    order = order[np.argsort(-seen[order, 2], kind="stable")]
    x, y, z = seen[order].T
    column = np.round(width / 2 + scale * x / z).astype(np.int64)
    row = np.round(height / 2 - scale * y / z).astype(np.int64)
    # Points that no pixel shows are left out before anything else is computed.
    seen_row = (row >= -_LARGEST) & (row < height + _LARGEST)
    kept = np.flatnonzero(seen_row & (column >= -_LARGEST) & (column < width + _LARGEST))
    order, column, row, z = order[kept], column[kept], row[kept], z[kept]
    square = np.clip(scale * cloud.radius / z, 0.5, _LARGEST) ** 2 + 0.01
    wide = np.arange(len(z))
    for reach, dx, dy in _OFFSETS:
        # The offsets are in ascending order: each is for fewer points than the one before.
        wide = wide[square[wide] >= reach]
        if not len(wide):
            break
        across, down = column[wide] + dx, row[wide] + dy
        inside = (across >= 0) & (across < width) & (down >= 0) & (down < height)
        drawn, pixel = wide[inside], (down * width + across)[inside]
        nearer = z[drawn] < depth[pixel]
        drawn, pixel = drawn[nearer], pixel[nearer]
        depth[pixel] = z[drawn]
        colour[pixel] = cloud.colours[order[drawn]]


def _shaded(depth: Floats, colour: Colours, size: tuple[int, int]) -> Floats:
    """Darken pixels that lie behind their neighbours; return depths without what was drawn."""
    width, height = size
    away = np.log2(np.where(np.isfinite(depth), depth, 1e3)).reshape(height, width)
    padded = np.pad(away, 1, mode="edge")
    behind = sum(
        np.maximum(0.0, away - other)
        for other in (padded[1:-1, 2:], padded[1:-1, :-2], padded[2:, 1:-1], padded[:-2, 1:-1])
    )
    drawn = np.isfinite(depth)
    shade = np.exp(-_SHADE * np.asarray(behind).ravel()[drawn])[:, None]
    colour[drawn] = np.round(colour[drawn] * np.maximum(shade, 0.15)).astype(np.uint8)
    return np.full(len(depth), np.inf)


def png_bytes(picture: Colours) -> bytes:
    """Return a picture (height, width, 3) as a PNG file."""
    height, width, _ = picture.shape
    rows = np.zeros((height, 1 + 3 * width), np.uint8)
    rows[:, 1:] = picture.reshape(height, -1)

    def chunk(kind: bytes, content: bytes) -> bytes:
        check = zlib.crc32(kind + content)
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", check)

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    body = zlib.compress(rows.tobytes(), 6)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", body) + chunk(b"IEND", b"")
