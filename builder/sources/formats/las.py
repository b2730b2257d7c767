"""LAS, LAZ and COPC reader; lazrs decompresses the latter two.

COPC is LAZ with an index, which is not needed to read every point. Only the coordinates, the
intensity and the flags of a point are read; and its colour and its class if they are wanted. Points
flagged as withheld are left out: the standard calls them deleted [LAS 1.4 R15, table 8].

The standard has 16 bits in each channel of a colour, but many files hold 8-bit values there. A file
none of whose channels exceeds 255 is taken for one of these, as other programs do (colours.py).
"""

import copy
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ....schemas.runtime.interrupts import blocking_interrupts, check_interrupt
from ..common.colours import CLASSIFICATION, INTENSITY, RGB, SYNTHETIC, WITHHELD, class_counts
from ..common.records import read_records
from ..common.scan import (
    BLOCK_BYTES,
    BLOCK_POINTS,
    Scan,
    ScanBlock,
    SeekableScan,
    library_errors,
    reader_library,
)
from ..common.units import axis_metres
from .las_crs import crs_text, stated_units
from .las_header import (
    LASZIP,
    LASZIP_RECORD,
    VLR,
    LasHeader,
    check_count,
    check_header,
    find_records,
    points_end,
    projection_records,
    read_header,
    read_points,
)
from .laz_chunks import LazTail, check_chunk_end, check_chunks, readable_records

# Offset of red, green and blue in the formats that have them, and of the class: its low five bits
# up to format 5, a byte of its own from 6 on.
RGB_OFFSETS = {2: 20, 3: 28, 5: 28, 7: 30, 8: 30, 10: 30}
CLASS_OFFSETS, CLASS_BITS = (15, 16), 0x1F
FIRST_WHOLE_CLASS = 6
# Flags of a point in byte 15, up to format 5 and from 6 on.
FLAGS_OFFSET = 15
FLAG_BITS = {WITHHELD: (0x80, 0x04), SYNTHETIC: (0x20, 0x01)}


class LasScan(SeekableScan):
    """One LAS or LAZ file."""

    def __init__(self, path: Path, header: LasHeader, laszip: bytes, behind: int) -> None:
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

    def trusted_bounds(self) -> NDArray[np.float64] | None:
        with self.path.open("rb") as file:
            readable = _readable_points(file, self.path, self._header, self._laszip)
            return self.bounds if all(self._header.holds(xyz).all() for xyz in readable) else None

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
        header, size = read_header(file, path), path.stat().st_size
        check_header(header, path, size)
        records = find_records(file, header.header_size, header.offset_to_points, VLR)
        laszip, behind = records.get((LASZIP, LASZIP_RECORD), b""), -1
        check_count(file, path, header, size)
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
        projection = projection_records(file, header, records, size)
        scan.crs = crs_text(projection)
        scan.notes = tuple(
            f"{path}: a scale of 0 for {axis}, so all points lie at {axis} = {place:g}, although the header's "
            "bounds are wider: export the scan again if it is not flat"
            for axis, place in header.flattened_axes()
        )
        units = stated_units(projection)
        if units and header.points:
            scan.units, scan.units_note = units
        return [scan]


def las_bounds(path: Path, units: str = "") -> NDArray[np.float64] | None:
    """Return the bounds that the header of a damaged LAS file declares, (2, 3) [m].

    units: see `axis_metres`; "": what the file states.
    May raise any exception. An inconsistent header is rejected, as are bounds that do not hold
    every point that can be read, and those in a unit that is not known: if a skipped scan were
    recorded at a wrong place, queries would report its real place as clear.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        header = read_header(file, path)
        check_header(header, path, size=1 << 62)  # every check but those against the file's size
        records = find_records(file, header.header_size, header.offset_to_points, VLR)
        projection = projection_records(file, header, records, size)
    stated = stated_units(projection)
    metres = axis_metres(units or (stated.name if stated else "m"))
    # The record that states the unit may be lost.
    cut_off = not units and (header.offset_to_points > size or (header.evlrs[1] and not projection))
    if header.bounds is None or metres is None or cut_off:
        return None
    with path.open("rb") as file:
        readable = _readable_points(file, path, header, records.get((LASZIP, LASZIP_RECORD), b""))
        return header.bounds * metres if all(header.holds(xyz).all() for xyz in readable) else None


def _readable_points(
    file: BinaryIO, path: Path, header: LasHeader, laszip: bytes
) -> Iterator[NDArray[np.float64]]:
    """Yield the points (n, 3) of a damaged file that can be read, whatever number it declares."""
    at = header.offset_to_points
    if header.compressed:
        # The first point is raw, behind the place of the chunk table.
        yield read_points(file, header, at + 8, 1)
        lazrs = reader_library("lazrs", path)
        for record in readable_records(lazrs, file, path, laszip, at, header.record_bytes):
            yield header.xyz(np.frombuffer(record, header.layout()))
        return
    left = (points_end(header, path.stat().st_size) - at) // header.record_bytes
    while left > 0 and len(xyz := read_points(file, header, at, min(left, BLOCK_POINTS))):
        yield xyz[(xyz != header.offset).any(axis=1)]  # bytes of 0 that fill a block are no points
        at, left = at + len(xyz) * header.record_bytes, left - len(xyz)
