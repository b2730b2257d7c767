"""LAS, LAZ and COPC reader; lazrs decompresses the latter two.

COPC is LAZ with an index, which is not needed to read every point. The header is read here: laspy
2.7, given a file of 14 kB that claims 10^9 variable length records, creates an object for each of
them and never returns. Only the coordinates and the intensity of a point are read, which come first
in every point record format; and its colour and its class if they are wanted.

The standard has 16 bits in each channel of a colour, but many files hold 8-bit values there. A file
none of whose channels exceeds 255 is taken for one of these, as other programs do (colours.py).
"""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.process.interrupts import blocking_interrupts
from ..common.colours import CLASSIFICATION, INTENSITY, RGB
from ..common.scan import (
    BLOCK_BYTES,
    Scan,
    ScanBlock,
    SeekableScan,
    SourceLattice,
    checked_bounds,
    library_errors,
    read_records,
    reader_library,
    scan_error,
)
from .laz_chunks import VLR_HEADER_BYTES, LazTail, check_chunks

# Size of the public header of LAS 1.0 to 1.2; later versions append fields [LAS 1.4 R15, table 3].
HEADER_BYTES = 227
# Sizes of the point record formats 0 to 10 [LAS 1.4 R15, tables 7 to 17]; extra bytes may follow
# each.
RECORD_BYTES = (20, 28, 26, 34, 57, 63, 30, 36, 38, 59, 67)
# Offset of red, green and blue in the formats that have them, and of the class: its low five bits
# up to format 5, a byte of its own from 6 on.
RGB_OFFSETS = {2: 20, 3: 28, 5: 28, 7: 30, 8: 30, 10: 30}
CLASS_OFFSETS, CLASS_BITS = (15, 16), 0x1F
FIRST_WHOLE_CLASS = 6
# Maximum bytes before the points. Real files have kilobytes there (a coordinate system, names of
# extra bytes); waveform tables, the largest known content, stay below 16 KiB.
LONGEST_PREAMBLE = 16 << 20

# Coordinate reference system: user and numbers of the variable length records that name it.
PROJECTION = b"LASF_Projection"
WKT, GEO_KEYS, GEO_TEXTS = 2112, 34735, 34737
# Maximum bytes of a text, several times longer than any real one; a longer one is truncated.
LONGEST_CRS = 1 << 16

# GeoTIFF keys that identify the system [OGC 19-008r4, 7]; other keys refine it.
KEY_NAMES = {
    1024: "model",
    1026: "citation",
    2048: "geodetic EPSG",
    2049: "geodetic citation",
    3072: "projected EPSG",
    3073: "projected citation",
    3076: "linear units EPSG",
    4096: "vertical EPSG",
    4097: "vertical citation",
    4099: "vertical units EPSG",
}


class _Header(NamedTuple):
    """Fields of a LAS header that locate the points and describe their encoding."""

    header_size: int
    offset_to_points: int
    vlr_count: int
    point_format: int  # 0 to 10, compression bits removed
    compressed: bool
    record_bytes: int
    points: int
    lattice: SourceLattice
    bounds: NDArray[np.float64] | None
    evlrs: tuple[int, int]  # offset of the first record after the points, and the number of such records


class LasScan(SeekableScan):
    """One LAS or LAZ file."""

    def __init__(self, path: Path, header: _Header, laszip: bytes) -> None:
        """Create the scan.

        laszip: the LASzip record that lazrs needs, for a compressed file with points.
        """
        super().__init__(
            path,
            "laz" if header.compressed else "las",
            declared_count=header.points,
            lattice=header.lattice,
            bounds=header.bounds,
        )
        self._start = header.offset_to_points
        self._laszip = laszip
        self._point_format, self._record_bytes = header.point_format, header.record_bytes
        has_rgb = header.point_format in RGB_OFFSETS
        self.columns = frozenset([INTENSITY, CLASSIFICATION] + [RGB] * has_rgb)

    @property
    def _record(self) -> np.dtype[np.void]:
        """Return the layout of a record, with the fields that are read."""
        fields = [("x", "<i4", 0), ("y", "<i4", 4), ("z", "<i4", 8), ("intensity", "<u2", 12)]
        if self.delivers(CLASSIFICATION):
            fields.append((CLASSIFICATION, "u1", CLASS_OFFSETS[self._point_format >= FIRST_WHOLE_CLASS]))
        if self.delivers(RGB):
            fields.append((RGB, "(3,)<u2", RGB_OFFSETS[self._point_format]))
        names, formats, offsets = (list(column) for column in zip(*fields, strict=True))
        return np.dtype(
            {"names": names, "formats": formats, "offsets": offsets, "itemsize": self._record_bytes}  # type: ignore[call-overload]  # a layout
        )

    def _read_between(self, block_points: int, start: int, stop: int) -> Iterator[ScanBlock]:
        with self.path.open("rb") as file:
            file.seek(self._start)
            if self.format == "laz":
                records = self._decompressed(file, block_points, start, stop)
            else:
                file.seek(start * self._record.itemsize, 1)
                records = read_records(file, self.path, self._record, stop - start, block_points, "points")
            for record in records:
                yield self._block(record)

    def _decompressed(
        self, file: BinaryIO, block_points: int, start: int, stop: int
    ) -> Iterator[NDArray[np.void]]:
        """Yield the records [start, stop) of a LAZ file, (n,); the next block overwrites them."""
        lazrs = reader_library("lazrs", self.path)
        # Skip unused layers (formats 6 to 10): times, angles.
        layers = (
            lazrs.SELECTIVE_DECOMPRESS_XY_RETURNS_CHANNEL
            | lazrs.SELECTIVE_DECOMPRESS_Z
            | lazrs.SELECTIVE_DECOMPRESS_INTENSITY
        )
        if self.delivers(RGB):
            layers |= lazrs.SELECTIVE_DECOMPRESS_RGB
        if self.delivers(CLASSIFICATION):
            layers |= lazrs.SELECTIVE_DECOMPRESS_CLASSIFICATION
        wanted = lazrs.DecompressionSelection(layers)
        with blocking_interrupts():
            source: Any = LazTail(lazrs, file, self._start, self._laszip, start) if start else file
            # Decompress serially: the builder already runs one process per core.
            decompressor = lazrs.LasZipDecompressor(source, self._laszip, wanted)
        step = max(1, min(block_points, BLOCK_BYTES // self._record.itemsize))
        buffer = np.empty(step, self._record)
        raw = buffer.view(np.uint8)
        # Discard the points of the first chunk before `start`, usually at most 50,000.
        before = source.skip if start else 0
        while before:
            count = min(step, before)
            with blocking_interrupts():  # lazrs calls back into Python to read
                decompressor.decompress_many(raw[: count * self._record.itemsize])
            before -= count
        for seen in range(start, stop, step):
            count = min(step, stop - seen)
            with blocking_interrupts():
                decompressor.decompress_many(raw[: count * self._record.itemsize])
            yield buffer[:count]

    def _block(self, record: NDArray[np.void]) -> ScanBlock:
        """Build a block from point records.

        Coordinates are raw * scale + offset, in that order, as laspy and others compute them.
        """
        lattice = self.lattice
        assert lattice is not None
        xyz = np.empty((len(record), 3))
        with np.errstate(over="ignore"):  # a scale of 1e300 gives infinities; the caller counts them
            # Axis by axis, from the records directly to the result: 2.7 ns a point against 8.4 for
            # a copy that is multiplied and added to as a whole (2^18 records of 20 bytes, one
            # core).
            for axis, name in enumerate("xyz"):
                column = xyz[:, axis]
                np.multiply(record[name], lattice.scale[axis], out=column)
                column += lattice.offset[axis]
        classes = record[CLASSIFICATION].copy() if self.delivers(CLASSIFICATION) else None
        if classes is not None and self._point_format < FIRST_WHOLE_CLASS:
            classes &= CLASS_BITS
        return ScanBlock(
            xyz,
            record["intensity"].astype(np.float32),
            record[RGB].copy() if self.delivers(RGB) else None,
            classes,
        )


def open_las(path: Path) -> list[Scan]:
    """Return the one scan of a LAS, LAZ or COPC file; reads its header only. Raises ScanError."""
    with library_errors(path), path.open("rb") as file:
        header = _read_header(file, path)
        _check_header(header, path, path.stat().st_size)
        laszip = b""
        if header.compressed and header.points:
            laszip = check_chunks(
                file,
                path,
                header_size=header.header_size,
                vlr_count=header.vlr_count,
                start=header.offset_to_points,
                record_bytes=header.record_bytes,
                points=header.points,
            )
        scan = LasScan(path, header, laszip)
        start = header.offset_to_points
        scan.crs = _crs_text(file, header.header_size, header.vlr_count, start, header.evlrs)
        return [scan]


def las_bounds(path: Path) -> NDArray[np.float64] | None:
    """Return the bounds that the header of a possibly truncated LAS file declares, (2, 3) [m].

    May raise any exception. An inconsistent header is rejected: if a skipped scan were recorded at
    a wrong place, queries would report its real place as clear.
    """
    with path.open("rb") as file:
        header = _read_header(file, path)
    _check_header(header, path, size=1 << 62)  # every check but the one against the file's size
    return header.bounds


def _read_header(file: BinaryIO, path: Path) -> _Header:
    """Read the fields of the public header block; check only what reading them requires."""
    start = file.read(375)
    if start[:4] != b"LASF" or len(start) < HEADER_BYTES:
        raise scan_error(
            path,
            f"a file of {len(start)} bytes or more that begins with {start[:4]!r}",
            f"b'LASF' and a header of {HEADER_BYTES} bytes",
            "check that this is a LAS or LAZ file, and that it is complete",
        )
    major, minor = start[24], start[25]
    header_size, offset_to_points, vlr_count = struct.unpack_from("<HII", start, 94)
    point_format, record_bytes, count = struct.unpack_from("<BHI", start, 104)
    scale = struct.unpack_from("<3d", start, 131)
    offset = struct.unpack_from("<3d", start, 155)
    least_header = HEADER_BYTES if minor < 3 else 235 if minor == 3 else 375
    if major != 1 or minor > 5 or header_size < least_header or len(start) < least_header:
        raise scan_error(
            path,
            f"LAS version {major}.{minor} with a header of {min(header_size, len(start))} bytes",
            f"1.0 to 1.5 and at least {least_header} bytes",
            "check that this is a LAS or LAZ file, and that it is complete",
        )
    if minor >= 4:
        (count,) = struct.unpack_from("<Q", start, 247)
    # LASzip marks a compressed file in bit 7 of the format; older versions set bit 6 as well.
    return _Header(
        header_size,
        offset_to_points,
        vlr_count,
        point_format & 0x3F,
        bool(point_format & 0xC0),
        record_bytes,
        count,
        SourceLattice(scale, offset),
        _bounds_of(start) if count else None,
        struct.unpack_from("<QI", start, 235) if minor >= 4 else (0, 0),
    )


def _bounds_of(start: bytes) -> NDArray[np.float64] | None:
    """Return the bounds in the header (max x, min x, max y, ...), or None if they form no box."""
    bounds = np.array(struct.unpack_from("<6d", start, 179)).reshape(3, 2).T[::-1].copy()
    return checked_bounds(bounds)


def _check_header(header: _Header, path: Path, size: int) -> None:
    """Check all header values against the file's size and against each other. Raises ScanError."""

    def refuse(found: str, expected: str) -> None:
        raise scan_error(path, found, expected, "fetch the file again, it is truncated or damaged")

    preamble = header.offset_to_points
    if not header.header_size <= preamble <= min(size, LONGEST_PREAMBLE):
        refuse(
            f"points that begin at byte {preamble} of {size}",
            f"an offset from {header.header_size} on, within the file and its first {LONGEST_PREAMBLE} bytes",
        )
    room = (preamble - header.header_size) // VLR_HEADER_BYTES
    if header.vlr_count > room:
        refuse(
            f"{header.vlr_count} variable length records", f"at most the {room} that fit before the points"
        )
    if header.point_format >= len(RECORD_BYTES):
        refuse(f"point record format {header.point_format}", "0 to 10")
    if header.record_bytes < RECORD_BYTES[header.point_format]:
        refuse(
            f"records of {header.record_bytes} bytes",
            f"at least the {RECORD_BYTES[header.point_format]} of format {header.point_format}",
        )
    if (
        not all(np.isfinite(s) and s > 0 for s in header.lattice.scale)
        or not np.isfinite(header.lattice.offset).all()
    ):
        refuse(f"scale {header.lattice.scale}, offset {header.lattice.offset}", "positive, finite numbers")
    held = (size - preamble) // header.record_bytes
    if not header.compressed and header.points > held:
        refuse(
            f"{header.points} points declared", f"at most the {held} that the file of {size} bytes can hold"
        )


def _crs_text(file: BinaryIO, header_size: int, vlr_count: int, start: int, evlrs: tuple[int, int]) -> str:
    """Return the coordinate reference system that a LAS file names, as text: WKT or GeoTIFF keys.

    start: offset of the points, where the records before them end.
    evlrs: (offset, number) of the records after the points.
    Never raises: returns "" where the file names none or its records are broken.
    """
    try:
        found = _projection_records(file, header_size, vlr_count, start, "<2x16sHH32x")
        if WKT not in found:
            at, count = evlrs
            found = {**_projection_records(file, at, count, 1 << 62, "<2x16sHQ32x"), **found}
        if found.get(WKT, b"").strip(b"\0 "):
            return found[WKT].split(b"\0")[0].decode("utf-8", "replace").strip()
        return _geo_text(found[GEO_KEYS], found.get(GEO_TEXTS, b"")) if GEO_KEYS in found else ""
    except (OSError, ValueError, struct.error, OverflowError):
        return ""


def _projection_records(file: BinaryIO, at: int, count: int, end: int, form: str) -> dict[int, bytes]:
    """Return the projection records among `count` from offset `at`, truncated to LONGEST_CRS."""
    head = struct.Struct(form)
    found: dict[int, bytes] = {}
    file.seek(at)
    for _ in range(count):
        raw = file.read(head.size)
        if len(raw) < head.size or file.tell() > end:
            break
        user, number, length = head.unpack(raw)
        behind = file.tell() + length
        if user.rstrip(b"\0") == PROJECTION and number not in found:
            found[number] = file.read(min(length, LONGEST_CRS, end - file.tell()))
        file.seek(behind)
    return found


def _geo_text(keys: bytes, texts: bytes) -> str:
    """Format the identifying keys: "projected EPSG 26915; citation NAD83 / UTM zone 15N"."""
    words = struct.unpack(f"<{len(keys) // 2}H", keys[: len(keys) // 2 * 2])
    parts = []
    for k in range(1, 1 + min(words[3] if len(words) > 3 else 0, len(words) // 4 - 1)):
        key, place, count, value = words[4 * k : 4 * k + 4]
        if key not in KEY_NAMES:
            continue
        if place == GEO_TEXTS:
            text = texts[value : value + count].decode("ascii", "replace").strip("|\0 ")
        else:
            text = str(value) if place == 0 else ""
        if text:
            parts.append(f"{KEY_NAMES[key]} {text}")
    return "; ".join(parts)
