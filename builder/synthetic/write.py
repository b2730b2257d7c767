"""Writers of simulated scans, station by station: LAZ or LAS, E57, or a folder of LAZ files.

Memory: one station.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from datetime import date
from pathlib import Path

import laspy
import numpy as np
import pye57

from ...schemas.errors import BadRequestError
from ...schemas.runtime.new_file import new_path
from .scanner import LATTICE, SimulatedScan

SUFFIXES = (".laz", ".las", ".e57")
# A fixed date, the year of [Fig12]: the same seed gives the same file.
SCANNED_ON = date(2012, 1, 1)


class LasFile:
    """One LAZ or LAS file of any number of stations; point_source_id is the station's number, from 1."""

    def __init__(self, path: Path, compressed: bool) -> None:
        header = laspy.LasHeader(point_format=0, version="1.2")
        header.scales = np.full(3, LATTICE)
        header.offsets = np.zeros(3)
        header.creation_date = SCANNED_ON
        header.system_identifier = "ray-cast scanner"
        header.generating_software = "solidcloud make"
        self._writer = laspy.open(
            path.open("wb"), mode="w", header=header, do_compress=compressed, closefd=True
        )

    def write(self, number: int, scan: SimulatedScan) -> None:
        """Append one station."""
        header = self._writer.header
        record = laspy.ScaleAwarePointRecord.zeros(len(scan.xyz), header=header)
        for name, column in zip("XYZ", np.rint(scan.xyz / LATTICE).astype(np.int32).T, strict=True):
            record[name] = column
        record["intensity"] = scan.intensity
        for name, value in (("point_source_id", number), ("return_number", 1), ("number_of_returns", 1)):
            record[name] = np.full(len(scan.xyz), value, np.uint16)
        self._writer.write_points(record)

    def close(self) -> None:
        """Finish the file."""
        self._writer.close()


class LasFolder:
    """Folder with one LAZ file per station."""

    def __init__(self, path: Path) -> None:
        path.mkdir()
        self._path = path

    def write(self, number: int, scan: SimulatedScan) -> None:
        """Write one station as its own file."""
        file = LasFile(self._path / station_name(number), compressed=True)
        try:
            file.write(number, scan)
        finally:
            file.close()

    def close(self) -> None:
        """Do nothing; no file is open."""


class E57File:
    """One E57 file with one posed scan per station, coordinates in the scanner's own frame.

    pye57 stores them as float32, which moves a point by at most 1 um at 16 m, 1/100 of the lattice.
    """

    def __init__(self, path: Path) -> None:
        self._file = pye57.E57(str(path), mode="w")

    def write(self, number: int, scan: SimulatedScan) -> None:
        """Append one station; world = rotation about z by the yaw, then the scanner's position."""
        c, s = np.cos(scan.place.yaw), np.sin(scan.place.yaw)
        x, y, z = (scan.xyz - np.asarray(scan.place.position)).T
        data = {
            "cartesianX": c * x + s * y,
            "cartesianY": -s * x + c * y,
            "cartesianZ": np.ascontiguousarray(z),
            "intensity": scan.intensity.astype(np.float32),
        }
        half = scan.place.yaw / 2
        self._file.write_scan_raw(
            data,
            name=f"station {number}",
            rotation=np.array([np.cos(half), 0.0, 0.0, np.sin(half)]),
            translation=np.asarray(scan.place.position),
        )

    def close(self) -> None:
        """Finish the file."""
        self._file.close()


def station_name(number: int) -> str:
    """Return the file name of a station in a folder."""
    return f"station_{number:04d}.laz"


def check_target(out: Path) -> None:
    """Check the output path.

    Raises BadRequestError for an unknown suffix and for a folder that is not empty.
    """
    suffix = out.suffix.lower()
    if suffix and suffix not in SUFFIXES:
        raise BadRequestError(
            f"{out}: cannot write {suffix!r}: expected {', '.join(SUFFIXES)}, or no suffix for a folder: "
            "rename the output"
        )
    if not suffix and out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise BadRequestError(
            f"{out}: already exists: expected a new or an empty folder: remove it or choose another name"
        )
    if suffix and out.is_dir():
        raise BadRequestError(f"{out}: is a folder: expected a file name: choose another name")


@contextmanager
def open_target(out: Path) -> Iterator[LasFile | LasFolder | E57File]:
    """Yield a writer for `out`, which gets its name when it is complete; a failure leaves nothing."""
    check_target(out)
    out.parent.mkdir(parents=True, exist_ok=True)
    suffix = out.suffix.lower()
    writer: LasFile | LasFolder | E57File
    with new_path(out) as temporary:
        if suffix == ".e57":
            writer = E57File(temporary)
        elif suffix:
            writer = LasFile(temporary, compressed=suffix == ".laz")
        else:
            writer = LasFolder(temporary)
        try:
            yield writer
        finally:
            writer.close()
