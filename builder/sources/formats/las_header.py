"""Header of a LAS, LAZ or COPC file, and the records around its points: read and checked.

The header is read here: laspy 2.7, given a file of 14 kB that claims 10^9 variable length records,
creates an object for each of them and never returns.

A header may declare fewer points than the file has: a writer that was interrupted, or that cannot
go back, leaves a count of 0. Such a file counts as damaged; otherwise the places of its points
would count as free.
"""

import struct
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.scan import BLOCK_POINTS, SourceLattice, checked_bounds, scan_error
from .las_crs import WKT
from .laz_chunks import chunk_bytes

# Sizes of the public header of LAS 1.0 to 1.2, with the place of the waveforms (1.3), and with
# 64-bit counts (1.4) [LAS 1.4 R15, table 3].
HEADER_BYTES, WAVEFORM_HEADER_BYTES, LONG_HEADER_BYTES = 227, 235, 375
# Sizes of the point record formats 0 to 10 [LAS 1.4 R15, tables 7 to 17]; extra bytes may follow
# each.
RECORD_BYTES = (20, 28, 26, 34, 57, 63, 30, 36, 38, 59, 67)
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


class LasHeader(NamedTuple):
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

    def flattened_axes(self) -> list[tuple[str, float]]:
        """Return the axes of scale 0 whose bounds are not the offset alone, with that offset."""
        return [
            (name, self.offset[axis])
            for axis, name in enumerate("xyz")
            if self.scale[axis] == 0
            and (self.bounds is None or (self.bounds[:, axis] != self.offset[axis]).any())
        ]


def read_header(file: BinaryIO, path: Path) -> LasHeader:
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
    return LasHeader(
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


def check_header(header: LasHeader, path: Path, size: int) -> None:
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


def check_count(file: BinaryIO, path: Path, header: LasHeader, size: int) -> None:
    """Check that there are no points behind those that the header declares. Raises ScanError.

    Waveforms, records and bytes of other kinds may follow the points. Behind a number of points
    other than 0, only records that lie within the bounds count as points.
    """
    start, points = header.offset_to_points, header.points
    end = points_end(header, size)
    if header.compressed:
        more = 0 if points else chunk_bytes(file, start, end) // header.record_bytes
    else:
        start += points * header.record_bytes
        more = max(0, end - start) // header.record_bytes
        if points and more:
            behind = read_points(file, header, start, min(more, RECORDS_BEHIND))
            blank = (behind == header.offset).all(axis=1)  # bytes of 0 that fill a block
            found = header.holds(behind) & ~blank
            # Other bounds than those of the declared points say nothing about what is behind.
            more = more if found.any() or ((~blank).any() and not _fills_bounds(file, header)) else 0
    if more:
        raise scan_error(
            path,
            f"{points} points declared, and {end - start} bytes of points behind them",
            "the number of all points",
            "the header is damaged, or was not finished: repair or export the file again",
        )


def _fills_bounds(file: BinaryIO, header: LasHeader) -> bool:
    """Return whether the bounds are those of the declared points, up to a step."""
    low, high, at, left = np.full(3, np.inf), np.full(3, -np.inf), header.offset_to_points, header.points
    while left and len(xyz := read_points(file, header, at, min(left, BLOCK_POINTS))):
        low, high = np.minimum(low, xyz.min(axis=0)), np.maximum(high, xyz.max(axis=0))
        at, left = at + len(xyz) * header.record_bytes, left - len(xyz)
    return header.bounds is not None and bool(
        (np.abs(np.stack([low, high]) - header.bounds) <= np.abs(header.scale)).all()
    )


def points_end(header: LasHeader, size: int) -> int:
    """Return where the points end at the latest: at waveforms, at records, or with the file."""
    ends = [header.waveforms, header.evlrs[0] if header.evlrs[1] else 0]
    return min([size, *(at for at in ends if at >= header.offset_to_points)])


def read_points(file: BinaryIO, header: LasHeader, at: int, count: int) -> NDArray[np.float64]:
    """Return the coordinates (n, 3) of up to `count` whole point records from offset `at` on."""
    file.seek(at)
    data = file.read(count * header.record_bytes)
    return header.xyz(np.frombuffer(data, header.layout(), len(data) // header.record_bytes))


def projection_records(
    file: BinaryIO, header: LasHeader, records: dict[tuple[bytes, int], bytes], size: int
) -> dict[int, bytes]:
    """Return the projection records of a file by their numbers.

    records: those before the points; without WKT there, the ones after the points count too.
    """
    at, count = header.evlrs
    if (PROJECTION, WKT) not in records and count:
        records = {**find_records(file, at, size, EVLR, count), **records}
    return {number: data for (user, number), data in records.items() if user == PROJECTION}


def find_records(
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
