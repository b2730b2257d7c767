"""Bytes per point of archives, and of LAZ of the same xyz on the same lattice."""

import os
import shutil
from pathlib import Path

import laspy
import numpy as np
from numpy.typing import NDArray
from solidcloud.builder.sources.scan_files import find_scan_files, open_scans
from solidcloud.schemas.archive.archive import Archive

# Real scans to build, in the folder that SOLIDCLOUD_SCANS names.
REAL_SCANS = (
    "indoor_atrium.laz", "pumpA.e57", "cupola_las", "octomap_hall.xyz", "campus_scan_a.ply", "lone_star.copc.laz",
)  # fmt: skip


def real_scans() -> list[Path]:
    """Return those of REAL_SCANS that exist here."""
    folder = os.environ.get("SOLIDCLOUD_SCANS")
    return [path for name in REAL_SCANS if folder and (path := Path(folder) / name).exists()]


def archive_bytes(folder: Path) -> int:
    """Return the size of an archive's index and shards [bytes]."""
    return sum(path.stat().st_size for path in folder.rglob("*.h5"))


def quantised(scans: Path, archive: Path) -> NDArray[np.int64]:
    """Return the points of a file or folder (n, 3) on an archive's lattice, in scan order.

    Raises ValueError when their number differs from the archive's.
    """
    with Archive(archive) as opened:
        lattice, expected = opened.header.lattice, opened.header.points
    blocks = [
        lattice.to_lattice(block.xyz[np.isfinite(block.xyz).all(axis=1)])
        for path in find_scan_files([scans])
        for scan in open_scans(path)
        for block in scan.blocks()
    ]
    found = np.concatenate(blocks)
    if len(found) != expected:
        raise ValueError(f"{scans}: {len(found)} points read, {expected} in the archive: not the same points")
    return found


def laz_bytes(points: NDArray[np.int64], folder: Path) -> int:
    """Return the size of a LAZ file of only these lattice integers (n, 3), header included.

    Point format 0 cannot omit intensity, returns, class and source; being all zero they compress to
    almost nothing.
    """
    low = points.min(axis=0)
    if int((points - low).max()) >= 1 << 31:
        raise ValueError(f"lattice integers up to {(points - low).max()}: LAZ holds 31 bits")
    header = laspy.LasHeader(point_format=0, version="1.2")
    header.scales = np.full(3, 1e-4)
    record = laspy.ScaleAwarePointRecord.zeros(len(points), header=header)
    for name, column in zip("XYZ", (points - low).T, strict=True):
        record[name] = column.astype(np.int32)
    path = folder / "xyz.laz"
    with laspy.open(path, "w", header=header, do_compress=True) as file:
        file.write_points(record)
    size = path.stat().st_size
    path.unlink()
    return size


def beside_laz(scans: Path, archive: Path, folder: Path) -> tuple[int, int]:
    """Return the bytes of an archive, and of LAZ of the same xyz in scan order."""
    folder.mkdir(parents=True, exist_ok=True)
    try:
        return archive_bytes(archive), laz_bytes(quantised(scans, archive), folder)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
