"""Level of detail of an archive: an archive of representatives of its points, in a folder of its own.

Every point of the archive lies within a known distance, the *cover radius*, of a representative,
which is a point of the same voxel of the archive. A sphere of that radius around each
representative therefore contains all points, and a contact with a representative is a contact with
the archive. A level holds about a thirtieth of the points: one for each leaf node. Its spheres and
slabs enclose all points of the archive that the representatives below stand for. Its records are
those of any archive, and can be read and checked without those of the archive that it describes.

FORMAT.md, "Level of detail", documents the same; change both together.
"""

import hashlib
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from ..errors import FormatError
from .archive import Archive
from .index import INDEX_NAME, Header
from .radius_model import RADIUS_CLASSES
from .units import UNITS_PER_METRE
from .voxel_grid import Lattice, voxel_keys

# Folder of the level, inside the folder of its archive.
LEVEL_FOLDER = "level"
# Columns of the points that representatives keep, if the archive has them: what a viewer shows.
LEVEL_COLUMNS = ("intensity", "rgb", "classification")
# Cover radius of each class [micrometres]: 8 mm times powers of the square root of 2, so that
# rounding up adds at most 41 %, in the same table for every archive. No representative stands for
# points farther away than the last.
COVER_RADII = (
    5657, 8000, 11314, 16000, 22628, 32000, 45255, 64000, 90510, 128000, 181020, 256000, 362039, 512000, 724078,
    1024000
)  # fmt: skip
# Class of nodes in memory: they enclose all points below them, without a cover.
NODE_CLASS = len(COVER_RADII)


def level_id(header: Header) -> bytes:
    """Return the `archive_id` that the level of an archive must have: 16 bytes.

    It differs from that of every other archive and generation, so that a level is never taken for
    that of an archive whose points have changed since.
    """
    generation = header.generation.to_bytes(4, "little")
    return hashlib.sha256(b"solidcloud level" + header.archive_id + generation).digest()[:16]


def squared_covers(step: float) -> NDArray[np.int64]:
    """Return the greatest squared distance (16,) within each cover radius, in squared steps.

    step: of the lattice [m], taken as the decimal number that it prints as, as are the radii.
    """
    exact = Fraction(repr(step))
    return np.array([int((Fraction(radius, 1_000_000) / exact) ** 2) for radius in COVER_RADII], np.int64)


def cover_units() -> NDArray[np.int64]:
    """Return the cover radius (RADIUS_CLASSES,) of each class in exact units, rounded up.

    It includes the rounding of both points to exact units, less than a unit each. The classes from
    NODE_CLASS on have none.
    """
    units = np.zeros(RADIUS_CLASSES, np.int64)
    units[:NODE_CLASS] = [-(-radius * int(UNITS_PER_METRE) // 1_000_000) + 2 for radius in COVER_RADII]
    return units


def open_level(archive: Archive) -> Archive | None:
    """Open the level of an archive; return None if there is none, or only that of other points.

    Raises FormatError or CorruptError, naming the file, for a level that cannot be read, or that
    does not describe the voxels of the archive.
    """
    folder = archive.folder / LEVEL_FOLDER
    if not (folder / INDEX_NAME).is_file():
        return None
    level = Archive(folder)
    header, described = level.header, archive.header
    if header.archive_id != level_id(described):
        level.close()
        return None
    same = (
        header.is_level
        and all(getattr(header, name) == getattr(described, name) for name in LEVEL_COLUMNS)
        and _covers_voxels(level, archive)
        and np.array_equal(header.unknown, described.unknown)
        and header.unknown_everywhere == described.unknown_everywhere
    )
    if not same:
        level.close()
        raise FormatError(
            f"{folder}: does not describe the voxels of its archive, expected the same lattice, voxels, columns and "
            "unknown regions: delete this folder, which is not needed"
        )
    return level


def halvings_between(level: Lattice, archive: Lattice) -> int:
    """Return how often the edge of an archive's voxels is halved for those of its level."""
    return (archive.voxel_steps // level.voxel_steps).bit_length() - 1


def _covers_voxels(level: Archive, archive: Archive) -> bool:
    """Return whether the voxels of a level divide those of its archive, and leave none of them out."""
    ours, theirs = level.header.lattice, archive.header.lattice
    halvings = halvings_between(ours, theirs)
    if ours.voxel_steps << max(halvings, 0) != theirs.voxel_steps or ours[:2] != theirs[:2]:
        return False
    described = np.unique(voxel_keys(level.coordinates >> halvings))
    return np.array_equal(described, archive.voxels["key"])
