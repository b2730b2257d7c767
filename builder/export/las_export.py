"""Export to LAS and LAZ, version 1.4, point format 6, with colours 7.

Coordinates are integers of the lattice step. A reader computes X * scale + offset. With the step as
scale and the origin as offset, this is how the world coordinates of an archive are computed, exact
to the last bit. If 32 bits do not hold the lattice coordinates, the offset is shifted by whole
steps. A coordinate may then differ in its last bits, but it still rounds to the same lattice point.

LAS has 16 bits in each channel of a colour. A channel c is written as 257 c, so that 255 is white
for readers that follow the standard, and so that the high byte is c.
"""

import re
from collections.abc import Sequence
from pathlib import Path

import laspy
import numpy as np
from laspy.vlrs.known import WktCoordinateSystemVlr
from numpy.typing import NDArray

from ...schemas.archive.index import Source
from ...schemas.archive.voxel_grid import Lattice
from ...schemas.errors import BadRequestError
from .export_contents import Contents

# Keywords that begin well-known text, in both of its versions [OGC 01-009, 18-010r7].
_WKT = re.compile(
    r"\s*(PROJ|GEOG|GEOC|GEOD|COMPD?|COMPOUND|BOUND|LOCAL|ENG|VERT|FITTED)\w*\s*[\[(]", re.IGNORECASE
)
# Longest payload of a variable-length record before the points, including a terminating zero.
_LONGEST_WKT = 65534
# Extra field for intensities that 16 bits do not hold.
EXACT_INTENSITY = "intensity_float"


class LasWriter:
    """LAS or LAZ file being written; a context manager. notes: facts that a reader should know."""

    def __init__(
        self, path: Path, lattice: Lattice, contents: Contents, crs: str, *, compressed: bool
    ) -> None:
        """Open the file. crs: well-known text, or "".

        Raise BadRequestError if 32 bits cannot hold the coordinates.
        """
        self.notes: list[str] = []
        self._lattice, self._first = lattice, _first_steps(lattice, contents)
        header = laspy.LasHeader(point_format=7 if "rgb" in contents.columns else 6, version="1.4")
        header.scales = np.full(3, lattice.step)
        header.offsets = lattice.to_world(self._first[None])[0]
        header.generating_software = "solidcloud export"
        header.system_identifier = "EXTRACTION"  # [LAS 1.4 R15, table 3]
        header.global_encoding.wkt = True  # required for point formats from 6 on, with or without text
        if crs:
            header.vlrs.append(WktCoordinateSystemVlr(crs))
        self._float = "intensity" in contents.columns and not contents.whole_intensity
        if self._float:
            header.add_extra_dim(laspy.ExtraBytesParams(EXACT_INTENSITY, "float32"))
            self.notes.append(
                f"intensities are not all whole numbers up to 65535: they are in the field {EXACT_INTENSITY}"
            )
        self._writer = laspy.open(
            path.open("wb"), mode="w", header=header, do_compress=compressed, closefd=True
        )

    def __enter__(self) -> "LasWriter":
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.close()

    def append(
        self, lattice: NDArray[np.int64], world: NDArray[np.float64], columns: dict[str, NDArray]
    ) -> None:
        """Append points to the file."""
        record = laspy.ScaleAwarePointRecord.zeros(len(lattice), header=self._writer.header)
        for name, column in zip("XYZ", (lattice - self._first).T, strict=True):
            record[name] = column.astype(np.int32)
        for name in ("return_number", "number_of_returns"):
            record[name] = np.ones(len(lattice), np.uint8)
        if "scan" in columns:
            record["point_source_id"] = columns["scan"]
        if self._float:
            record[EXACT_INTENSITY] = columns["intensity"]
        elif "intensity" in columns:
            record["intensity"] = columns["intensity"].astype(np.uint16)
        if "rgb" in columns:
            for name, channel in zip(("red", "green", "blue"), columns["rgb"].T, strict=True):
                record[name] = channel.astype(np.uint16) * 257
        if "classification" in columns:
            record["classification"] = columns["classification"]
        self._writer.write_points(record)


def wkt_of(sources: Sequence[Source]) -> tuple[str, str]:
    """Return the well-known text of the coordinate system of all scans, or "", and a note, or "".

    The text applies only to scans in metres with z up: scans in other units or axes were converted,
    so their text no longer describes the points.
    """
    held = [s for s in sources if s.count]
    texts = {s.crs for s in held}
    if texts <= {""}:
        return "", ""
    (text, *others) = sorted(texts)
    if others:
        return "", "the scans name different coordinate systems, or some name none: the file has none"
    if not _WKT.match(text) or len(text.encode()) > _LONGEST_WKT:
        return (
            "",
            f"the scans' coordinate system is not given as well-known text ({text[:60]}): the file has none",
        )
    if any((s.units, s.up) != ("m", "z") for s in held):
        return "", "the scans' coordinate system is not in metres with z up: the file has none"
    return text, ""


def _first_steps(lattice: Lattice, contents: Contents) -> NDArray[np.int64]:
    """Return the lattice coordinates (3,) of the offset: 0 on axes where 32 bits suffice."""
    least, most = -(1 << 31), (1 << 31) - 1
    far = (contents.low < least) | (contents.high > most)
    middle = (contents.low + contents.high) // 2
    first = np.where(far, middle, 0)
    if (contents.high - contents.low > most - least).any():
        extent = float((contents.high - contents.low).max()) * lattice.step
        raise BadRequestError(
            f"points {extent:g} m apart in steps of {lattice.step:g} m: more than the 32 bits of LAS hold: "
            "export a smaller --box, or --format ply"
        )
    # The offset is rounded. Lattice points must remain distinct, and must convert back to
    # themselves.
    ends = np.stack([contents.low, contents.high])
    world = (ends - first) * lattice.step + lattice.to_world(first[None])[0]
    if not np.array_equal(lattice.to_lattice(world), ends):
        raise BadRequestError(
            f"coordinates of {np.abs(world).max():g} m are not reproduced by LAS in steps of {lattice.step:g} m: "
            "export --format ply"
        )
    return first
