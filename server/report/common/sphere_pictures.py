"""Figure 8 of [Fig12]: the bounding spheres of one level of every partition's hierarchy."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.archive.archive import Archive
from ....schemas.errors import BadRequestError, SolidcloudError

# Direction of view: from the front and above, slightly from the left, towards a façade's front.
AZIMUTH, ELEVATION = np.deg2rad(-17.0), np.deg2rad(17.0)
LIGHT = np.array([-0.45, 0.55, 0.70])
WIDTH = 1800


class LevelSpheres(NamedTuple):
    """The s spheres of one level.

    center: (s, 3) float64, world frame [m].  radius: (s,) float64 [m], including the radius of the
    points.
    partition: (s,) int64, the leaf cell, numbered over all voxels.
    ended: (s,) bool, the sphere is a leaf node of a tree that ends above the level, and is drawn
    instead.
    """

    center: NDArray[np.float64]
    radius: NDArray[np.float64]
    partition: NDArray[np.int64]
    ended: NDArray[np.bool_]


def level_spheres(folder: Path, level: int) -> LevelSpheres:
    """Return the spheres of one level of every leaf cell's BSH (the paper's partition).

    A tree that ends earlier contributes its leaf nodes. The top BSH, over the cells, is not
    included.
    level: 1 is the root.
    """
    if level < 1:
        raise BadRequestError(f"level {level}: expected 1 (the root of every partition) or more")
    parts, cells = [], 0
    with Archive(folder) as archive:
        lattice, radius = archive.header.lattice, archive.header.radius
        for row, coordinate in enumerate(archive.coordinates):
            voxel, links = archive.read_voxel(row)
            # The roots of the cells' trees follow the top BSH, in cell order
            # (schemas/archive/voxel.py).
            count = voxel.nodes.count.astype(np.int64)
            top = len(count) - int(voxel.cells.nodes.sum(dtype=np.int64))
            chosen, at = np.arange(top, top + len(voxel.cells.nodes)), 1
            ended = np.empty(0, np.int64)
            while at < level and len(chosen):
                leaf = links.is_leaf[chosen]
                ended = np.concatenate([ended, chosen[leaf]])
                chosen = chosen[~leaf]
                first = np.repeat(links.first[chosen], count[chosen])
                begin = np.repeat(np.cumsum(count[chosen]) - count[chosen], count[chosen])
                chosen = first + np.arange(len(first)) - begin
                at += 1
            rows = np.concatenate([ended, chosen])
            low = voxel.cells.low[links.cell[rows]] + coordinate * lattice.voxel_steps
            parts.append(
                LevelSpheres(
                    lattice.to_world(voxel.nodes.center[rows] + low),
                    voxel.nodes.radius[rows] * lattice.step + radius,
                    links.cell[rows] + cells,
                    np.arange(len(rows)) < len(ended),
                )
            )
            cells += len(voxel.cells.nodes)
    return LevelSpheres(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _view() -> NDArray[np.float64]:
    """Return unit vectors (3, 3) in the world frame: right, up and towards the eye; z is up."""
    toward = np.array(
        [np.sin(AZIMUTH) * np.cos(ELEVATION), -np.cos(AZIMUTH) * np.cos(ELEVATION), np.sin(ELEVATION)]
    )
    right = np.cross([0.0, 0.0, 1.0], toward)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(toward, right), toward])


def _colours(partition: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return colours (s, 3) by partition: shades of stone that distinguish neighbours."""
    turn = np.arange(partition.max() + 1) * 0.6180339887498949 % 1.0
    shade = np.arange(partition.max() + 1) * 0.7548776662466927 % 1.0
    warm = np.array([0.97, 0.78, 0.50]) * (1 - turn[:, None]) + np.array([0.50, 0.72, 0.93]) * turn[:, None]
    colours: NDArray[np.float64] = (warm * (0.72 + 0.28 * shade[:, None]))[partition]
    return colours


def render_spheres(spheres: LevelSpheres, width: int = WIDTH) -> NDArray[np.float64]:
    """Render the spheres as lit balls in parallel projection to an image (h, width, 3).

    Each pixel shows the nearest sphere.
    """
    seen = spheres.center @ _view().T
    low = (seen - spheres.radius[:, None]).min(axis=0)[:2]
    high = (seen + spheres.radius[:, None]).max(axis=0)[:2]
    margin = 0.02 * (high - low).max()
    scale = width / (high[0] - low[0] + 2 * margin)
    height = int(np.ceil((high[1] - low[1] + 2 * margin) * scale))
    x = (seen[:, 0] - low[0] + margin) * scale
    y = (high[1] + margin - seen[:, 1]) * scale
    depth, radius = seen[:, 2] * scale, np.maximum(spheres.radius * scale, 0.75)
    nearness = (depth - depth.min()) / max(float(np.ptp(depth)), 1e-9)
    colours = _colours(spheres.partition) * (0.62 + 0.38 * nearness[:, None])
    image, nearest = np.ones((height, width, 3)), np.full((height, width), -np.inf)
    light = LIGHT / np.linalg.norm(LIGHT)
    for i in range(len(x)):
        left, right = max(0, int(x[i] - radius[i])), min(width, int(x[i] + radius[i]) + 2)
        above, below = max(0, int(y[i] - radius[i])), min(height, int(y[i] + radius[i]) + 2)
        nx = (np.arange(left, right) + 0.5 - x[i])[None, :] / radius[i]
        ny = -(np.arange(above, below) + 0.5 - y[i])[:, None] / radius[i]
        square = nx * nx + ny * ny
        nz = np.sqrt(np.maximum(1 - square, 0))
        window = nearest[above:below, left:right]
        wins = (square <= 1) & (depth[i] + radius[i] * nz > window)
        window[wins] = (depth[i] + radius[i] * nz)[wins]
        lit = 0.45 + 0.70 * np.maximum(nx * light[0] + ny * light[1] + nz * light[2], 0)
        # The rim is darkened to separate balls of one partition.
        lit *= np.where(square > 0.82, 0.55, 1.0)
        image[above:below, left:right][wins] = np.clip(lit[wins][:, None] * colours[i], 0, 1)
    return image


def draw_spheres(spheres: LevelSpheres, title: str, target: Path) -> None:
    """Write the picture of the spheres as PNG. Raises SolidcloudError if matplotlib is missing."""
    pyplot = load_pyplot()
    image = render_spheres(spheres)
    size = (12.0, 12.0 * image.shape[0] / image.shape[1] + 0.6)
    figure = pyplot.figure(figsize=size, dpi=150)
    axes = figure.add_axes((0, 0, 1, 1 - 0.6 / size[1]))
    axes.imshow(image, interpolation="antialiased")
    axes.set_axis_off()
    figure.suptitle(title, fontsize=13, y=1 - 0.18 / size[1], va="top")
    figure.savefig(target)
    pyplot.close(figure)


def load_pyplot() -> Any:
    """Return matplotlib's pyplot for drawing to files. Raises SolidcloudError if it is missing."""
    try:
        import matplotlib

        matplotlib.use("Agg")
        import matplotlib.pyplot
    except ImportError as error:
        raise SolidcloudError(
            "matplotlib is not installed, expected it for the pictures: pip install 'solidcloud[report]'"
        ) from error
    return matplotlib.pyplot
