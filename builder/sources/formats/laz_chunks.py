"""Check of a LAZ file's chunks before lazrs reads them, and a view of a LAZ file from a later chunk on.

lazrs allocates the size that a chunk claims before it reads the chunk, and a failed allocation in
Rust aborts the process: two runs of random damage to a file of 2.5 kB both ended like this, at 3.6
and 4.3 GB. The layout is that of LASzip 3.4, which writes chunks of point formats 6 to 10 layer by
layer.
"""

import io
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO

from ....schemas.errors import ScanError
from ....schemas.runtime.interrupts import blocking_interrupts, check_interrupt
from ..common.scan import damaged_error, library_errors, scan_error

CHUNKED = 2  # the compressor of point formats 0 to 5
VARIABLE = 0xFFFFFFFF  # special value of points per chunk: each chunk has its own point count
LAYERED = 3  # the compressor of point formats 6 to 10: each chunk is split into layers

# Item type -> number of its layers in a layered chunk; each layer's size precedes the chunk's data.
# 10: point (9 layers); 11: colour; 12: colour and infrared; 13: wave packet; 14: extra bytes, one
# layer per byte.
LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}
EXTRA_BYTES = 14
# Most bytes that may be left of the last chunk once its points are decompressed. Nothing is left of
# those that LASzip and lazrs write; four bytes end the code of a chunk without points.
LEFT_BYTES = 4
READ_BYTES = 1 << 20


def check_chunks(
    file: BinaryIO,
    path: Path,
    *,
    laszip: bytes,
    start: int,
    record_bytes: int,
    points: int,
) -> int:
    """Check that a LAZ file's chunks and chunk table lie within the file and hold all its points.

    laszip: the LASzip record.
    start: offset of the point data.
    record_bytes, points: size and count of the uncompressed records, as declared.
    Reads a few bytes per chunk (usually 50,000 points). Returns -1, or the number of bytes behind
    the chunks if these do not tell how many points the last one has: see `check_chunk_end`. Raises
    ScanError.
    """
    size = file.seek(0, 2)
    items = _items(path, laszip)
    compressor, chunk_points = struct.unpack_from("<H10xI", laszip)
    if compressor not in (CHUNKED, LAYERED):
        raise scan_error(
            path,
            f"LASzip compressor {compressor}",
            f"{CHUNKED} or {LAYERED}",
            "convert it with a newer LASzip",
        )
    if sum(length for _, length in items) != record_bytes:
        raise damaged_error(path, f"compressed items {items} (type, bytes)", f"{record_bytes} bytes together")
    table, chunks = _chunk_table(file, path, start, size)
    if not chunks or (chunk_points != VARIABLE and not chunk_points):
        raise damaged_error(path, f"{chunks} chunks of {chunk_points} points", "at least one of each")
    if chunk_points != VARIABLE and points > chunks * chunk_points:
        raise damaged_error(
            path, f"{points} points in {chunks} chunks of {chunk_points}", "as many as they hold"
        )
    # lazrs allocates the whole table. Each chunk begins with one raw point; an empty chunk may
    # follow the last.
    if (chunks - 1) * record_bytes > table - start - 8:
        raise damaged_error(
            path, f"{chunks} chunks in {table - start - 8} bytes", f"a point of {record_bytes} bytes in each"
        )
    if compressor != LAYERED:
        return size - table
    at, seen, number = start + 8, 0, 0
    while seen < points and at < table:
        count, at = _chunk_head(file, items, record_bytes, at)
        if not count or at > table:
            raise damaged_error(
                path, f"chunk {number} that ends at byte {at}", f"its end before the table at {table}"
            )
        seen += count
        number += 1
    # Writers that end each chunk explicitly leave an empty chunk after the last.
    if seen != points or not number <= chunks <= number + 1:
        raise damaged_error(path, f"{seen} points in {number} chunks", f"{points} in {chunks} chunks")
    return -1


def check_chunk_end(decompressor: Any, path: Path, behind: int) -> None:
    """Check that a decompressor which has delivered all declared points is at the end of the chunks.

    behind: number of bytes that follow the chunks. Raises ScanError.
    """
    left = behind + LEFT_BYTES + 1
    try:
        while left:
            data = bytearray(min(left, READ_BYTES))
            with blocking_interrupts():
                decompressor.read_raw_bytes_into(data)
            left -= len(data)
    except Exception:
        check_interrupt()
        return  # the file ends before: as it should
    raise damaged_error(path, "further points in the last chunk", "as many as the header declares")


def chunk_bytes(file: BinaryIO, start: int, end: int) -> int:
    """Return how many bytes of chunks there are between the offsets `start` and `end`, at most.

    start: offset of the point data, which begin with the offset of the chunk table.
    """
    file.seek(start)
    raw = file.read(8)
    table = struct.unpack("<q", raw)[0] if len(raw) == 8 else -1
    return (table if start + 8 <= table <= end else end) - start - 8


class LazTail(io.RawIOBase):
    """Points of a LAZ file from one of its chunks on, presented to lazrs as a file that begins there.

    lazrs 0.8 cannot seek correctly where chunks differ in size (COPC): its `seek` takes the point's
    number modulo the size of its own chunk and delivers other points. This file object omits the
    earlier chunks. It consists of the offset of the chunk table, the remaining chunks, and a table
    of those.
    """

    def __init__(self, lazrs: Any, file: BinaryIO, start: int, laszip: bytes, point: int) -> None:
        """Find the chunk that holds a point.

        file: the open LAZ file; its position is used.
        start: offset of its point data.
        laszip: its LASzip record.
        point: number of the point whose chunk is the first here; `skip` is the number of points
        before it in that chunk, and `behind` the number of bytes after the chunks.
        """
        vlr = lazrs.LazVlr(laszip)
        file.seek(start)
        chunks = lazrs.read_chunk_table(file, vlr)
        at, self.skip, first = start + 8, point, 0
        for points, size in chunks:
            if self.skip < points:
                break
            at, self.skip, first = at + size, self.skip - points, first + 1
        if first == len(chunks):
            raise ValueError(f"point {point} lies after the last chunk")
        self._hold(lazrs, file, vlr, at, chunks[first:])
        self.behind = len(self._table)

    def _hold(
        self, lazrs: Any, file: BinaryIO, vlr: Any, at: int, chunks: Sequence[tuple[int, int]], gap: int = 0
    ) -> None:
        """Present chunks (points, bytes) from an offset of the file on, and a gap before their table."""
        table = io.BytesIO()
        lazrs.write_chunk_table(table, chunks, vlr)
        self._file, self._from = file, at
        self._past = 8 + sum(size for _, size in chunks)
        self._table, self._gap = table.getvalue(), gap
        self._at = 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = 0) -> int:
        self._at = offset + (0, self._at, self._past + self._gap + len(self._table))[whence]
        return self._at

    def readinto(self, buffer: Any) -> int:
        """Fill the buffer from one of the three parts, as far as it goes; return the number of bytes."""
        view = memoryview(buffer).cast("B")
        if 8 <= self._at < self._past:
            self._file.seek(self._from + self._at - 8)
            data = self._file.read(min(len(view), self._past - self._at))
        else:
            table = self._past + self._gap
            part, begin = (struct.pack("<q", table), 0) if self._at < 8 else (self._table, table)
            data = part[self._at - begin : self._at - begin + len(view)] if self._at >= begin else b""
        view[: len(data)] = data
        self._at += len(data)
        return len(data)


class _WholeChunks(LazTail):
    """Chunks of a damaged LAZ file, behind which the file ends for a reader."""

    def __init__(
        self, lazrs: Any, file: BinaryIO, laszip: bytes, at: int, chunks: Sequence[tuple[int, int]]
    ) -> None:
        self._hold(lazrs, file, lazrs.LazVlr(laszip), at, chunks, gap=1)


def readable_records(
    lazrs: Any, file: BinaryIO, path: Path, laszip: bytes, start: int, record_bytes: int
) -> Iterator[bytearray]:
    """Yield the records of a damaged LAZ file that can be decompressed, each overwritten by the next.

    Of layered chunks those that lie whole in the file are read, of others all up to the first
    fault. Parameters as for `check_chunks`. Raises ScanError.
    """
    items = _items(path, laszip)
    compressor, chunk_points = struct.unpack_from("<H10xI", laszip)
    if compressor not in (CHUNKED, LAYERED) or sum(length for _, length in items) != record_bytes:
        return
    at, end = start + 8, start + 8 + chunk_bytes(file, start, file.seek(0, 2))
    chunks = [(chunk_points, end - at)]
    if compressor == LAYERED:
        chunks, past = [], at
        while past < end:
            begin = past
            count, past = _chunk_head(file, items, record_bytes, begin)
            if not count or past > end:
                break
            chunks.append((count, past - begin))
    points = sum(count for count, _ in chunks) if compressor == LAYERED else 1 << 62
    record, seen = bytearray(record_bytes), 0
    with library_errors(path):
        tail = _WholeChunks(lazrs, file, laszip, at, chunks)
        decompressor = lazrs.LasZipDecompressor(tail, laszip) if chunks else None
    while seen < points and decompressor is not None:
        try:
            with library_errors(path), blocking_interrupts():
                decompressor.decompress_many(record)
        except ScanError:
            return
        yield record
        seen += 1


def _chunk_head(file: BinaryIO, items: list[tuple[int, int]], record_bytes: int, at: int) -> tuple[int, int]:
    """Return the number of points of the layered chunk at an offset, and the offset of its end.

    The number is 0 where the file ends.
    """
    layers = sum(LAYERS.get(kind, length if kind == EXTRA_BYTES else 0) for kind, length in items)
    sizes = struct.Struct(f"<{1 + layers}I")
    file.seek(at + record_bytes)
    raw = file.read(sizes.size)
    count, *layer_bytes = sizes.unpack(raw) if len(raw) == sizes.size else (0,)
    return count, at + record_bytes + sizes.size + sum(layer_bytes)


def _items(path: Path, laszip: bytes) -> list[tuple[int, int]]:
    """Return (type, bytes) of each item of a point that the LASzip record lists."""
    count = struct.unpack_from("<H", laszip, 32)[0] if len(laszip) >= 34 else 0
    if len(laszip) < 34 + 6 * count or not count:
        raise damaged_error(
            path, "no whole record 22204 of 'laszip encoded'", "this record before the points of a LAZ file"
        )
    return [struct.unpack_from("<HH", laszip, 34 + 6 * k) for k in range(count)]


def _chunk_table(file: BinaryIO, path: Path, start: int, size: int) -> tuple[int, int]:
    """Return the offset of the chunk table and the number of chunks. Raises ScanError.

    The point data begins with the offset of the table (int64). A writer that cannot know it yet
    writes -1 there, and the right value in the last 8 bytes of the file.
    """
    for place in (start, size - 8):
        file.seek(place)
        raw = file.read(8)
        table = struct.unpack("<q", raw)[0] if len(raw) == 8 else size
        if table != -1:
            break
    file.seek(max(0, min(table, size)))
    raw = file.read(8)
    chunks = struct.unpack("<II", raw)[1] if len(raw) == 8 else size
    # A chunk holds at least its first point, raw: there are fewer chunks than bytes.
    if table < start + 8 or chunks >= size:
        raise damaged_error(
            path, f"a chunk table at byte {table} of {size}", "a table after the points, within the file"
        )
    return table, chunks
