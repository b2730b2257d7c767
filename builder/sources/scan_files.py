"""Registry of scan formats by file suffix, and functions that find and open scan files."""

import math
import os
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...schemas.errors import BadRequestError
from ...schemas.process.interrupts import check
from .common.scan import Scan, library_errors, scan_error
from .formats.e57 import e57_bounds, open_e57
from .formats.glb import open_glb
from .formats.las import las_bounds, open_las
from .formats.mesh import open_obj, open_stl
from .formats.pcd import open_pcd
from .formats.ply import open_ply
from .formats.pts import open_pts
from .formats.ptx import open_ptx
from .formats.surface import SurfaceSamples
from .formats.text import open_text

# Reader by suffix, in lower case. A COPC file ends in ".copc.laz" and is a LAZ file.
READERS: dict[str, Callable[[Path], list[Scan]]] = {
    ".las": open_las,
    ".laz": open_las,
    ".e57": open_e57,
    ".ply": open_ply,
    ".pcd": open_pcd,
    ".xyz": open_text,
    ".pts": open_pts,
    ".ptx": open_ptx,
    ".txt": open_text,
    ".csv": open_text,
    ".obj": open_obj,
    ".stl": open_stl,
    ".glb": open_glb,
}
# Suffixes collected from a folder. A text file of any other kind may hold notes, which would stop a
# build; it is read only when named.
IN_FOLDERS = frozenset(READERS) - {".txt", ".csv"}
# Suffixes of scan formats without a reader. In a folder they are reported as errors, like broken
# scans, and not skipped silently.
UNREAD = frozenset(
    [
        ".fls",
        ".fws",
        ".gltf",
        ".lsproj",
        ".pod",
        ".ptb",
        ".ptg",
        ".ptz",
        ".rcp",
        ".rcs",
        ".rdbx",
        ".rxp",
        ".x3a",
        ".zfs",
        ".zlas",
    ]
)
MESHES = frozenset({".obj", ".stl", ".ply", ".glb"})


def open_scans(path: Path, *, spacing: float | None = None) -> list[Scan]:
    """Open the scans of one file: read and check the headers, but no points.

    spacing: sample the surface of a mesh (OBJ, STL, PLY, GLB) with about this distance between
    points [m] instead of returning its vertices; other formats ignore it.
    An E57, PTX or PTS file may hold many scans; an E57 file may hold none. A valid file without
    points gives a scan without blocks.
    Raises ScanError for a file that is missing, empty, of unknown format, truncated or
    inconsistent, and BadRequestError for a spacing that is not a positive number.
    """
    path = Path(path)
    if spacing is not None and not (math.isfinite(spacing) and spacing > 0):
        raise BadRequestError(f"spacing {spacing}, expected a positive number of metres: correct --spacing")
    _check_exists(path)
    if not path.is_file():
        raise scan_error(
            path, "a folder or a device", "a file", "name its files, or pass it through scan_files()"
        )
    suffix = path.suffix.lower()
    if suffix not in READERS:
        raise scan_error(
            path, f"the suffix {suffix!r}", f"one of {' '.join(READERS)}", "convert the scan to one of these"
        )
    with library_errors(path):
        if path.stat().st_size == 0:
            raise scan_error(path, "an empty file", "a scan", "fetch the file again, or leave it out")
        scans = READERS[suffix](path)
        # The vertex reader has checked the header by now; trimesh never sees a broken one.
        return [SurfaceSamples(scans[0], spacing)] if spacing is not None and suffix in MESHES else scans


def scan_files(paths: Iterable[Path]) -> list[Path]:
    """Expand paths to scan files: files stay as they are, folders are searched at any depth.

    A folder's files are sorted by path; the order does not depend on the file system. They include
    files of formats that open_scans() refuses. Files given by name keep their position, whatever
    their suffix. Links to folders below a folder are not followed.
    Raises ScanError for a path that does not exist and for a folder without scan files.
    """
    files: list[Path] = []
    for path in map(Path, paths):
        _check_exists(path)
        if not path.is_dir():
            files.append(path)
            continue
        below = sorted(
            Path(folder, name)
            for folder, _, names in os.walk(path)
            for name in names
            if Path(name).suffix.lower() in IN_FOLDERS | UNREAD
        )
        if not below:
            raise scan_error(
                path,
                "a folder without scans",
                f"files ending in {' '.join(sorted(IN_FOLDERS))}",
                "check the folder's name, or name its files",
            )
        files += below
    return files


def header_bounds(path: Path) -> NDArray[np.float64] | None:
    """Return the bounds that the header of an unreadable scan file declares.

    Returns (2, 3) world frame [m], low and high corner, or None where they are unknown; only LAS,
    LAZ and E57 declare bounds. Never raises, and reads no more than the header, whatever it claims.
    """
    readers = {".las": las_bounds, ".laz": las_bounds, ".e57": e57_bounds}
    try:
        reader = readers.get(Path(path).suffix.lower())
        return reader(Path(path)) if reader else None
    except Exception:
        check()
        # Best effort on a file known to be broken; open_scans() or blocks() has already raised its
        # error.
        return None


def _check_exists(path: Path) -> None:
    with library_errors(path):
        exists = path.exists()
    if not exists:
        raise scan_error(path, "no such file or folder", "a scan", "check the path for a misspelling")
