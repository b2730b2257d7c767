"""Figures of an archive that matter to its maker, as `build` and `info` print them last.

The area of the surfaces is estimated from the points of a few voxels; all other figures are in the
index and in the sizes of the files.
"""

from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.archive import Archive
from ...schemas.archive.level import LEVEL_FOLDER
from ...schemas.archive.vtkhdf import PREVIEW_NAME
from ...schemas.errors import CorruptError
from ..config import DEFAULT_VOXEL
from ..sources.scan_warnings import SPARSE, length_text, radius_warning
from ..voxel.record_points import iter_points
from .cell_summary import CellSummary, summarize_cells

# Most voxels, and about the most points, that are read for the area.
AREA_VOXELS, AREA_POINTS = 16, 2_000_000
# Edges [m] of the cubes that measure area: the least with which a cube holds this many points.
FIRST_EDGE, LAST_EDGE, POINTS_A_CUBE = 1 / 32, 4.0, 8
# With fewer points in a voxel, overhead prevails; with more, one load keeps a user waiting.
FEW_POINTS, MANY_POINTS = 300, 5_000_000
# This many voxels do not matter, however few points they hold.
FEW_VOXELS = 64


class Area(NamedTuple):
    """Estimated area of surfaces [m²]. edge: of the cubes [m].  voxels: number that were read."""

    square_metres: float
    edge: float
    voxels: int


@dataclass(frozen=True, slots=True, kw_only=True)
class ArchiveSummary:
    """Figures of an archive.

    area: of its surfaces [m²], None if it could not be estimated; area_from: how.
    spacing: distance between neighbouring points [m], None if not known; spacing_from: how.
    radius: of the points' spheres [m]; radius_from: how it was chosen.
    voxel: edge of a voxel [m]; voxel_from: how it was chosen.
    voxels, points_a_voxel, densest: their number, points of one in the mean and at most.
    bytes_a_point: of index and shards.
    cells: figures of the leaf cells.
    look_at: what to look at if the archive looks wrong, one line each; the most likely first.
    """

    points: int
    area: float | None
    area_from: str
    spacing: float | None
    spacing_from: str
    radius: float
    radius_from: str
    voxel: float
    voxel_from: str
    voxels: int
    points_a_voxel: float
    densest: int
    bytes_a_point: float
    cells: CellSummary
    look_at: tuple[str, ...]

    def as_json(self) -> dict[str, Any]:
        """Return a JSON value."""
        return {**asdict(self), "look_at": list(self.look_at)}


def summarize_archive(archive: Archive) -> ArchiveSummary:
    """Return the figures of an open archive.

    Reads at most AREA_VOXELS voxels, and the hierarchies of all voxels if cells are balanced.
    """
    header = archive.header
    counts = archive.voxels["rows"][:, 2].astype(np.int64)
    derived = (PREVIEW_NAME, LEVEL_FOLDER)
    files = [
        path
        for path in archive.folder.rglob("*")
        if path.is_file() and path.relative_to(archive.folder).parts[0] not in derived
    ]
    try:
        area = surface_area(archive)
        area_from = f"cubes of {length_text(area.edge)} that hold points, in {area.voxels:,} of {len(counts):,} voxels"
    except (CorruptError, OSError) as error:
        area, area_from = None, f"not estimated: {error}"
    spacing, spacing_from = _spacing(archive, area)
    voxel = header.lattice.voxel_size
    return ArchiveSummary(
        points=header.points,
        area=area.square_metres if area else None,
        area_from=area_from,
        spacing=spacing,
        spacing_from=spacing_from,
        radius=header.radius,
        radius_from="half the mean spacing" if header.radius_model == "mean" else "--radius",
        voxel=voxel,
        voxel_from="the default" if voxel == DEFAULT_VOXEL else "--voxel",
        voxels=len(counts),
        points_a_voxel=header.points / max(1, len(counts)),
        densest=int(counts.max(initial=0)),
        bytes_a_point=sum(path.stat().st_size for path in files) / max(1, header.points),
        cells=summarize_cells(archive),
        look_at=tuple(_look_at(archive, spacing, counts)),
    )


def surface_area(archive: Archive) -> Area:
    """Estimate the area of an archive's surfaces from cubes that hold points, in evenly chosen voxels.

    A surface that lies askew crosses up to 1.7 times as many cubes. Raise CorruptError, OSError.
    """
    number = len(archive.voxels)
    if not number:
        return Area(0.0, FIRST_EDGE, 0)
    lattice = archive.header.lattice
    mean = archive.header.points / number
    read = int(np.clip(AREA_POINTS / max(1.0, mean), 1, min(AREA_VOXELS, number)))
    cubes, points = [], 0
    # Whole cubes in a voxel: parts of cubes at its borders would count as whole ones.
    halvings = int(np.clip(np.log2(lattice.voxel_size / FIRST_EDGE), 0, np.log2(lattice.voxel_steps)))
    for row in ((np.arange(read) + 0.5) * number / read).astype(np.int64).tolist():
        record = archive.open_voxel(row, columns=())
        held = [np.empty((0, 3), np.int64)]
        for block in iter_points(record, np.zeros(3, np.int64)):
            held.append(_distinct((block.xyz.astype(np.int64) << halvings) // lattice.voxel_steps))
            points += len(block.xyz)
        cubes.append(_distinct(np.concatenate(held)))
    edge = lattice.voxel_size / 2**halvings
    while points < POINTS_A_CUBE * sum(map(len, cubes)) and halvings and edge < LAST_EDGE:
        halvings, edge = halvings - 1, edge * 2
        cubes = [_distinct(each >> 1) for each in cubes]
    occupied = sum(map(len, cubes))
    return Area(occupied * edge**2 * number / read, edge, read)


def _distinct(cubes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the distinct rows of coordinates (n, 3), which are not negative."""
    keys = np.unique((cubes[:, 0] << 42) | (cubes[:, 1] << 21) | cubes[:, 2])
    mask = (1 << 21) - 1
    return np.stack([keys >> 42, (keys >> 21) & mask, keys & mask], axis=1)


def _spacing(archive: Archive, area: Area | None) -> tuple[float | None, str]:
    """Return the distance between neighbouring points [m], and how it is known."""
    header = archive.header
    if header.radius_model == "mean":
        now = header.radius_now
        return 2 * (now.radius if now else header.radius), "mean distance to the closest point"
    if area is None or not header.points:
        return None, "not measured, because --radius was given"
    return float(np.sqrt(area.square_metres / header.points)), "from points and area"


def _look_at(archive: Archive, spacing: float | None, counts: NDArray[np.int64]) -> list[str]:
    """Return what to look at if the archive looks wrong; what the figures suggest comes first."""
    header, found = archive.header, []
    if spacing is not None and spacing >= SPARSE:
        found.append(
            f"points {length_text(spacing)} apart: the unit of the scans (`solidcloud inspect`, units in its list)"
        )
    if header.radius_model != "mean" and spacing and (text := radius_warning(header.radius, spacing)):
        found.append(text)
    most = int(counts.max(initial=0))
    if len(counts) > FEW_VOXELS and header.points < FEW_POINTS * len(counts):
        found.append("few points in a voxel: a larger --voxel, or the unit of the scans")
    if most > MANY_POINTS:
        found.append(f"{most:,} points in a voxel: a smaller --voxel, so that loading one takes less time")
    if header.unknown_everywhere or len(header.unknown):
        found.append("scans that were left out: queries in their region answer unknown")
    preview = archive.folder / PREVIEW_NAME
    found.append(
        f"place and size: {f'{preview} in ParaView, ' if preview.exists() else ''}poses and units in the list of "
        "`solidcloud inspect`"
    )
    found.append("walls that leak or doors too narrow: --radius, which `solidcloud accuracy` compares")
    return found
