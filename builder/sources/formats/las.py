"""LAS, LAZ and COPC reader; lazrs decompresses the latter two.

COPC is LAZ with an index, which is not needed to read every point. The header is read here: laspy
2.7, given a file of 14 kB that claims 10^9 variable length records, creates an object for each of
them and never returns. Only the coordinates, the intensity and the flags of a point are read; and
its colour and its class if they are wanted. Points flagged as withheld are left out: the standard
calls them deleted [LAS 1.4 R15, table 8].

A header may declare fewer points than the file has: a writer that was interrupted, or that cannot
go back, leaves a count of 0. Such a file is damaged. Otherwise the places of its points would
count as free.

The standard has 16 bits in each channel of a colour, but many files hold 8-bit values there. A file
none of whose channels exceeds 255 is taken for one of these, as other programs do (colours.py).
"""

import copy
import struct
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.process.interrupts import blocking_interrupts, check_interrupt
from ..common.colours import CLASSIFICATION, INTENSITY, RGB
from ..common.scan import (
    BLOCK_BYTES,
    BLOCK_POINTS,
    SYNTHETIC,
    WITHHELD,
    Scan,
    ScanBlock,
    SeekableScan,
    SourceLattice,
    checked_bounds,
    class_counts,
    library_errors,
    read_records,
    reader_library,
    scan_error,
)
from ..placed_scan import axis_metres
from .las_crs import WKT, crs_text, stated_units
from .laz_chunks import LazTail, check_chunk_end, check_chunks, chunk_bytes

# Sizes of the public header of LAS 1.0 to 1.2, with the place of the waveforms (1.3), and with
# 64-bit counts (1.4) [LAS 1.4 R15, table 3].
HEADER_BYTES, WAVEFORM_HEADER_BYTES, LONG_HEADER_BYTES = 227, 235, 375
# Sizes of the point record formats 0 to 10 [LAS 1.4 R15, tables 7 to 17]; extra bytes may follow
# each.
RECORD_BYTES = (20, 28, 26, 34, 57, 63, 30, 36, 38, 59, 67)
# Offset of red, green and blue in the formats that have them, and of the class: its low five bits
# up to format 5, a byte of its own from 6 on.
RGB_OFFSETS = {2: 20, 3: 28, 5: 28, 7: 30, 8: 30, 10: 30}
CLASS_OFFSETS, CLASS_BITS = (15, 16), 0x1F
FIRST_WHOLE_CLASS = 6
# Flags of a point in byte 15, up to format 5 and from 6 on.
FLAGS_OFFSET = 15
FLAG_BITS = {WITHHELD: (0x80, 0x04), SYNTHETIC: (0x20, 0x01)}

# Variable length records, before the points and after them: reserved bytes, user, number, length,
# description [LAS 1.4 R15, tables 7 and 18].
VLR, EVLR = struct.Struct("<2x16sHH32x"), struct.Struct("<2x16sHQ32x")
PROJECTION, LASZIP = b"LASF_Projection", b"laszip encoded"
LASZIP_RECORD = 22204
# Most records that are looked through: some 100 bytes each in the densest real files.
MOST_RECORDS = 1 << 20
# Maximum bytes of a record, several times longer than any real one; a longer one is truncated.
LONGEST_RECORD = 1 << 16
# Records behind the declared points that are compared with the bounds.
RECORDS_BEHIND = 1 << 10


class _Header(NamedTuple):
    """Fields of a LAS header that locate the points and describe their encoding."""

    header_size: int
    offset_to_points: int
    point_format: int  # 0 to 10, compression bits removed
    compressed: bool
    record_bytes: int
    points: int
    scale: tuple[float, float, float]
    offset: tuple[float, float, float]
    bounds: NDArray[np.float64] | None
    waveforms: int  # their offset, 0 if there are none
    evlrs: tuple[int, int]  # offset of the first record after the points, and the number of such records

    def xyz(self, records: NDArray[np.void]) -> NDArray[np.float64]:
        """Return the coordinates (n, 3) of point records with fields x, y and z.

        They are raw * scale + offset, in that order, as laspy and others compute them.
        """
        xyz = np.empty((len(records), 3))
        with np.errstate(over="ignore"):  # a scale of 1e300 gives infinities; the caller counts them
            # Axis by axis, from the records directly to the result: 2.7 ns a point against 8.4 for
            # a copy that is multiplied and added to as a whole (2^18 records of 20 bytes, one
            # core).
            for axis, name in enumerate("xyz"):
                column = xyz[:, axis]
                np.multiply(records[name], self.scale[axis], out=column)
                column += self.offset[axis]
        return xyz

    def layout(self, *more: tuple[str, str, int]) -> np.dtype[np.void]:
        """Return the layout of a record: x, y, z, and further fields (name, format, offset)."""
        fields = [("x", "<i4", 0), ("y", "<i4", 4), ("z", "<i4", 8), *more]
        names, formats, offsets = (list(column) for column in zip(*fields, strict=True))
        return np.dtype(
            {"names": names, "formats": formats, "offsets": offsets, "itemsize": self.record_bytes}  # type: ignore[call-overload]  # a layout
        )

    def holds(self, xyz: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which of points (n, 3) lie in the bounds, up to a step; all without bounds."""
        if self.bounds is None:
            return np.ones(len(xyz), bool)
        step = np.abs(self.scale)
        within: NDArray[np.bool_] = ((xyz >= self.bounds[0] - step) & (xyz <= self.bounds[1] + step)).all(
            axis=1
        )
        return within

    def lattice(self) -> SourceLattice | None:
        """Return the grid of the coordinates, with positive scales; None if all are 0.

        On an axis of scale 0 all points have the offset, which lies on any grid from there.
        """
        scale = np.abs(self.scale)
        x, y, z = np.where(scale == 0, scale.max(), scale).tolist()
        return SourceLattice((x, y, z), self.offset) if x else None

    def lost_axes(self) -> list[str]:
        """Return the axes of scale 0 on which the header does not bound all points by the offset."""
        return [
            name
            for axis, name in enumerate("xyz")
            if self.scale[axis] == 0
            and (self.bounds is None or (self.bounds[:, axis] != self.offset[axis]).any())
        ]


class LasScan(SeekableScan):
    """One LAS or LAZ file."""

    def __init__(self, path: Path, header: _Header, laszip: bytes, behind: int) -> None:
        """Create the scan.

        laszip: the LASzip record that lazrs needs, for a compressed file with points.
        behind: bytes from the end of the chunks to that of the file, if `check_chunks` could not
        check the number of points; else -1.
        """
        super().__init__(
            path,
            "laz" if header.compressed else "las",
            declared_count=header.points,
            lattice=header.lattice(),
            bounds=header.bounds if header.points else None,
        )
        self._header, self._laszip, self._behind = header, laszip, behind
        self._is_new = header.point_format >= FIRST_WHOLE_CLASS
        has_rgb = header.point_format in RGB_OFFSETS
        self.columns = frozenset([INTENSITY, CLASSIFICATION] + [RGB] * has_rgb)

    @property
    def _record(self) -> np.dtype[np.void]:
        """Return the layout of a record, with the fields that are read."""
        fields = [("intensity", "<u2", 12), ("flags", "u1", FLAGS_OFFSET)]
        if self.delivers(CLASSIFICATION):
            fields.append((CLASSIFICATION, "u1", CLASS_OFFSETS[self._is_new]))
        if self.delivers(RGB):
            fields.append((RGB, "(3,)<u2", RGB_OFFSETS[self._header.point_format]))
        return self._header.layout(*fields)

    def _read_between(self, block_points: int, start: int, stop: int) -> Iterator[ScanBlock]:
        return (self._block(records) for records in self._records(block_points, start, stop))

    def count_classes(self, start: int = 0, stop: int | None = None) -> Counter[str]:
        scan, found = copy.copy(self), Counter[str]()
        scan.wanted = frozenset({CLASSIFICATION})
        stop = self.declared_count or 0 if stop is None else stop
        with library_errors(self.path):
            for records in scan._records(BLOCK_POINTS, start, stop):
                check_interrupt()
                found += class_counts(scan._classes(records))
                for reason, bits in FLAG_BITS.items():
                    found[reason] += int(np.count_nonzero(records["flags"] & bits[self._is_new]))
        return found

    def _records(self, block_points: int, start: int, stop: int) -> Iterator[NDArray[np.void]]:
        """Yield the records [start, stop), (n,); the next block overwrites them."""
        with self.path.open("rb") as file:
            file.seek(self._header.offset_to_points)
            if self.format == "laz":
                yield from self._decompressed(file, block_points, start, stop)
            else:
                file.seek(start * self._record.itemsize, 1)
                yield from read_records(file, self.path, self._record, stop - start, block_points, "points")

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
            | lazrs.SELECTIVE_DECOMPRESS_FLAGS
        )
        if self.delivers(RGB):
            layers |= lazrs.SELECTIVE_DECOMPRESS_RGB
        if self.delivers(CLASSIFICATION):
            layers |= lazrs.SELECTIVE_DECOMPRESS_CLASSIFICATION
        wanted = lazrs.DecompressionSelection(layers)
        with blocking_interrupts():
            tail = LazTail(lazrs, file, self._header.offset_to_points, self._laszip, start) if start else None
            source: Any = tail or file
            # Decompress serially: the builder already runs one process per core.
            decompressor = lazrs.LasZipDecompressor(source, self._laszip, wanted)
        step = max(1, min(block_points, BLOCK_BYTES // self._record.itemsize))
        buffer = np.empty(step, self._record)
        raw = buffer.view(np.uint8)
        # Discard the points of the first chunk before `start`, usually at most 50,000.
        before = tail.skip if tail else 0
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

        if stop == self.declared_count and self._behind >= 0:
            check_chunk_end(decompressor, self.path, tail.behind if tail else self._behind)

    def _block(self, records: NDArray[np.void]) -> ScanBlock:
        """Build a block from point records, without those that their flags leave out."""
        for reason, bits in FLAG_BITS.items():
            flag = bits[self._is_new]
            # Most blocks have none of these points. A reduction takes 0.2 ns a point, a mask 1.7.
            if (reason == WITHHELD or reason in self.drop_classes) and np.bitwise_or.reduce(
                records["flags"]
            ) & flag:
                chosen = (records["flags"] & flag) != 0
                self.dropped[reason] = self.dropped.get(reason, 0) + int(np.count_nonzero(chosen))
                records = records[~chosen]
        for name in self._header.lost_axes():
            if records[name].any():
                raise scan_error(
                    self.path,
                    f"a scale of 0 for {name}, and points whose raw {name} is not 0",
                    "the scale with which the file was written",
                    "the places of the points are lost: export the scan again",
                )
        return ScanBlock(
            self._header.xyz(records),
            records["intensity"].astype(np.float32),
            records[RGB].copy() if self.delivers(RGB) else None,
            self._classes(records) if self.delivers(CLASSIFICATION) else None,
        )

    def _classes(self, records: NDArray[np.void]) -> NDArray[np.uint8]:
        """Return the classes (n,) of records, without the flags beside them."""
        classes: NDArray[np.uint8] = records[CLASSIFICATION]
        return classes.copy() if self._is_new else classes & np.uint8(CLASS_BITS)


def open_las(path: Path) -> list[Scan]:
    """Return the one scan of a LAS, LAZ or COPC file; reads no points. Raises ScanError."""
    with library_errors(path), path.open("rb") as file:
        header, size = _read_header(file, path), path.stat().st_size
        _check_header(header, path, size)
        records = _find_records(file, header.header_size, header.offset_to_points, VLR)
        laszip, behind = records.get((LASZIP, LASZIP_RECORD), b""), -1
        _check_count(file, path, header, size)
        if header.compressed and header.points:
            behind = check_chunks(
                file,
                path,
                laszip=laszip,
                start=header.offset_to_points,
                record_bytes=header.record_bytes,
                points=header.points,
            )
        scan = LasScan(path, header, laszip, behind)
        projection = _projection(file, header, records, size)
        scan.crs = crs_text(projection)
        units = stated_units(projection)
        if units and header.points:
            scan.units, scan.units_note = units
        return [scan]


def las_bounds(path: Path, units: str = "") -> NDArray[np.float64] | None:
    """Return the bounds that the header of a damaged LAS file declares, (2, 3) [m].

    units: see `axis_metres`; "": what the file states.
    May raise any exception. An inconsistent header is rejected, as are bounds that do not hold the
    first points, and those in a unit that is not known: if a skipped scan were recorded at a wrong
    place, queries would report its real place as clear.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        header = _read_header(file, path)
        _check_header(header, path, size=1 << 62)  # every check but those against the file's size
        # The first point of a compressed file is raw, behind the place of the chunk table.
        start = header.offset_to_points + 8 * header.compressed
        first = _read_points(file, header, start, 1 if header.compressed else RECORDS_BEHIND)
        records = _find_records(file, header.header_size, header.offset_to_points, VLR)
        projection = _projection(file, header, records, size)
    stated = stated_units(projection)
    metres = axis_metres(units or (stated.name if stated else "m"))
    # The record that states the unit may be lost.
    cut_off = not units and (header.offset_to_points > size or (header.evlrs[1] and not projection))
    if header.bounds is None or metres is None or cut_off or not header.holds(first).all():
        return None
    return header.bounds * metres


def _read_header(file: BinaryIO, path: Path) -> _Header:
    """Read the fields of the public header block; check only what reading them requires."""
    start = file.read(LONG_HEADER_BYTES)
    if start[:4] != b"LASF" or len(start) < HEADER_BYTES:
        raise scan_error(
            path,
            f"a file of {len(start)} bytes or more that begins with {start[:4]!r}",
            f"b'LASF' and a header of {HEADER_BYTES} bytes",
            "check that this is a LAS or LAZ file, and that it is complete",
        )
    major, minor = start[24], start[25]
    header_size, offset_to_points = struct.unpack_from("<HI", start, 94)
    point_format, record_bytes, count = struct.unpack_from("<BHI", start, 104)
    scale = struct.unpack_from("<3d", start, 131)
    if major != 1 or minor > 5 or header_size < HEADER_BYTES:
        raise scan_error(
            path,
            f"LAS version {major}.{minor} with a header of {header_size} bytes",
            f"1.0 to 1.5 and at least {HEADER_BYTES} bytes",
            "check that this is a LAS or LAZ file, or fetch it again: its header is damaged",
        )
    # Some files of versions 1.3 and 1.4 have the header of an older version. Its size decides, as
    # in LAStools; but not one that the points contradict.
    held = min(header_size, len(start))
    long = minor >= 4 and held >= LONG_HEADER_BYTES
    if header_size > offset_to_points:
        header_size = LONG_HEADER_BYTES if long else HEADER_BYTES
    # A writer that keeps to the older counts leaves 0 here.
    count = (struct.unpack_from("<Q", start, 247)[0] or count) if long else count
    # LASzip marks a compressed file in bit 7 of the format; older versions set bit 6 as well.
    return _Header(
        header_size,
        offset_to_points,
        point_format & 0x3F,
        bool(point_format & 0xC0),
        record_bytes,
        count,
        scale,
        struct.unpack_from("<3d", start, 155),
        _bounds_of(start, scale),
        struct.unpack_from("<Q", start, 227)[0] if minor >= 3 and held >= WAVEFORM_HEADER_BYTES else 0,
        struct.unpack_from("<QI", start, 235) if long else (0, 0),
    )


def _bounds_of(start: bytes, scale: tuple[float, ...]) -> NDArray[np.float64] | None:
    """Return the bounds in the header (max x, min x, max y, ...), or None if they form no box.

    On an axis of negative scale some writers exchange them.
    """
    bounds = np.array(struct.unpack_from("<6d", start, 179)).reshape(3, 2).T[::-1].copy()
    negative = np.array(scale) < 0
    bounds[:, negative] = np.sort(bounds[:, negative], axis=0)
    return checked_bounds(bounds)


def _check_header(header: _Header, path: Path, size: int) -> None:
    """Check all header values against the file's size and against each other. Raises ScanError."""

    def refuse(
        found: str, expected: str, what_to_do: str = "fetch the file again, its header is damaged"
    ) -> None:
        raise scan_error(path, found, expected, what_to_do)

    preamble = header.offset_to_points
    if not header.header_size <= preamble <= size:
        refuse(
            f"points that begin at byte {preamble} of {size}",
            f"an offset from {header.header_size} on, within the file",
            "fetch the file again, it is truncated or its header is damaged",
        )
    if header.point_format >= len(RECORD_BYTES):
        refuse(f"point record format {header.point_format}", "0 to 10")
    if header.record_bytes < RECORD_BYTES[header.point_format]:
        refuse(
            f"records of {header.record_bytes} bytes",
            f"at least the {RECORD_BYTES[header.point_format]} of format {header.point_format}",
        )
    if not np.isfinite([*header.scale, *header.offset]).all():
        refuse(f"scale {header.scale}, offset {header.offset}", "finite numbers")
    held = (size - preamble) // header.record_bytes
    if not header.compressed and header.points > held:
        refuse(
            f"{header.points} points declared",
            f"at most the {held} that the file of {size} bytes can hold",
            "fetch the file again, it is truncated or its header is damaged",
        )


def _check_count(file: BinaryIO, path: Path, header: _Header, size: int) -> None:
    """Check that there are no points behind those that the header declares. Raises ScanError.

    Waveforms, records and bytes of other kinds may follow the points. Behind a number of points
    other than 0, only records that lie within the bounds count as points.
    """
    start, points = header.offset_to_points, header.points
    ends = [at for at in (header.waveforms, header.evlrs[0] if header.evlrs[1] else 0) if at >= start]
    end = min([size, *ends])
    if header.compressed:
        more = 0 if points else chunk_bytes(file, start, end) // header.record_bytes
    else:
        start += points * header.record_bytes
        more = max(0, end - start) // header.record_bytes
        if points and more:
            behind = _read_points(file, header, start, min(more, RECORDS_BEHIND))
            blank = (behind == header.offset).all(axis=1)  # bytes of 0 that fill a block
            more = more if (header.holds(behind) & ~blank).any() else 0
    if more:
        raise scan_error(
            path,
            f"{points} points declared, and {end - start} bytes of points behind them",
            "the number of all points",
            "the header is damaged, or was not finished: repair or export the file again",
        )


def _read_points(file: BinaryIO, header: _Header, at: int, count: int) -> NDArray[np.float64]:
    """Return the coordinates (n, 3) of up to `count` whole point records from offset `at` on."""
    file.seek(at)
    data = file.read(count * header.record_bytes)
    return header.xyz(np.frombuffer(data, header.layout(), len(data) // header.record_bytes))


def _projection(
    file: BinaryIO, header: _Header, records: dict[tuple[bytes, int], bytes], size: int
) -> dict[int, bytes]:
    """Return the projection records of a file by their numbers.

    records: those before the points; without WKT there, the ones after the points count too.
    """
    at, count = header.evlrs
    if (PROJECTION, WKT) not in records and count:
        records = {**_find_records(file, at, size, EVLR, count), **records}
    return {number: data for (user, number), data in records.items() if user == PROJECTION}


def _find_records(
    file: BinaryIO, at: int, end: int, head: struct.Struct, count: int = MOST_RECORDS
) -> dict[tuple[bytes, int], bytes]:
    """Return the records that describe projection and compression, (user, number) -> data.

    at, end: offsets of the first record and of the end of the last. Those before the points are not
    counted: writers state wrong numbers of them. A record that ends beyond is cut off.
    """
    found: dict[tuple[bytes, int], bytes] = {}
    for _ in range(min(count, MOST_RECORDS)):
        if at + head.size > end:
            break
        file.seek(at)
        user, number, length = head.unpack(file.read(head.size))
        at += head.size
        key = user.split(b"\0")[0], number
        if key[0] in (PROJECTION, LASZIP) and key not in found:
            found[key] = file.read(min(length, LONGEST_RECORD, end - at))
        at += length
    return found
