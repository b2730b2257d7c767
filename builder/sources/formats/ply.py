"""PLY reader: the vertices of one file, ASCII or binary of either byte order.

ply_header.py reads the header. This module reads the body in blocks, because plyfile reads faces
one by one and ASCII vertices into one array of the size that the header claims. Lists, in the
vertices or in elements before them, are skipped; in text, x, y, z and all columns in use come
before a list.
"""

from collections.abc import Iterator, Sequence
from functools import lru_cache
from io import BufferedReader
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ....schemas.runtime.interrupts import check_interrupt
from ..common.colours import CLASSIFICATION, RGB, stack_channels, whole_bytes
from ..common.records import check_end, read_records
from ..common.scan import (
    BLOCK_BYTES,
    BLOCK_POINTS,
    Scan,
    ScanBlock,
    SeekableScan,
    library_errors,
    scan_error,
)
from ..common.text_rows import LONGEST_LINE, number_rows, open_text_file
from .ply_header import PlyElement, PlyHeader, length_name, read_ply_header

# Bytes of elements with lists read at a time.
LISTS_BYTES = 1 << 16


class BinaryPly(SeekableScan):
    """Vertices of one binary PLY file."""

    def __init__(self, path: Path, header: PlyHeader) -> None:
        super().__init__(path, "ply", declared_count=header.points)
        self._header, self.columns = header, header.columns

    def _read_between(self, block_points: int, start: int, stop: int) -> Iterator[ScanBlock]:
        header = self._header
        with self.path.open("rb") as file:
            skip = sum(each.records * each.least_bytes for each in header.before)
            file.seek(header.start + skip + start * header.record.itemsize)
            for record in read_records(
                file, self.path, header.record, stop - start, block_points, "vertices"
            ):
                yield _block(self, record, header)


class ListPly(Scan):
    """Vertices of one binary PLY file with lists in or before its vertices, hence read from the start."""

    def __init__(self, path: Path, header: PlyHeader) -> None:
        super().__init__(path, "ply", declared_count=header.points)
        self._header, self.columns = header, header.columns

    def _read(self, block_points: int) -> Iterator[ScanBlock]:
        header = self._header
        with self.path.open("rb") as file:
            file.seek(header.start)
            _skip_elements(file, self.path, header.before)
            for record in _list_records(file, self.path, header.vertex, block_points):
                yield _block(self, record, header)
            _check_rest(file, self.path, header)


def _skip_elements(file: BufferedReader, path: Path, elements: Sequence[PlyElement]) -> None:
    """Advance a binary file past elements. Raises ScanError."""
    for element in elements:
        _skip_element(file, path, element)


def _list_records(
    file: BufferedReader, path: Path, element: PlyElement, block_points: int
) -> Iterator[NDArray[np.void]]:
    """Read the records of an element with lists from the current position, in blocks.

    Yields (n,), n > 0, records whose lists have the same lengths. Records are guessed to be like
    the one before them, twice as many each time; those after the first unlike one are read again.
    Raises ScanError.
    """
    seen, step = 0, 1
    names = [length_name(each.name) for each in element.properties if each.length is not None]
    record_of = lru_cache(maxsize=64)(element.record)
    while seen < element.records:
        check_interrupt()
        begin = file.tell()
        lengths = _list_lengths(file, path, element)
        record = record_of(lengths)
        file.seek(begin)
        most = min(step, element.records - seen, block_points, BLOCK_BYTES // record.itemsize)
        records = np.frombuffer(
            data := file.read(most * record.itemsize), record, len(data) // record.itemsize
        )
        if not len(records):
            raise _truncated(path, seen, element.records, f"{element.name} records")
        alike = np.ones(len(records), bool)
        for name, length in zip(names, lengths, strict=True):
            alike &= records[name] == length
        good = len(records) if alike.all() else int(alike.argmin())
        yield records[:good]
        file.seek(begin + good * record.itemsize)
        seen, step = seen + good, 2 * step if good == most else 1


def _list_lengths(file: BufferedReader, path: Path, element: PlyElement) -> tuple[int, ...]:
    """Return the lengths of the lists of the record at the file's position. Raises ScanError."""
    lengths: list[int] = []
    size = 0
    for _, kind, count in element.properties:
        if count is None:
            size += kind.itemsize
            file.seek(kind.itemsize, 1)
            continue
        length = int(np.frombuffer(file.read(count.itemsize).ljust(count.itemsize, b"\0"), count)[0])
        size += count.itemsize + length * kind.itemsize
        if length < 0 or size > BLOCK_BYTES:
            raise _bad_list(path, element, length)
        lengths.append(length)
        file.seek(length * kind.itemsize, 1)
    return tuple(lengths)


def _bad_list(path: Path, element: PlyElement, length: int) -> Exception:
    return scan_error(
        path,
        f"a list of {length} values in element {element.name!r}",
        f"0 or more, in a record of at most {BLOCK_BYTES} bytes",
        "fetch the file again, it is truncated, or a count in its header is damaged",
    )


def _skip_lines(file: BinaryIO, lines: int) -> None:
    """Read past lines of any length, in bounded memory; stops at the end of the file."""
    while lines and (piece := file.readline(LONGEST_LINE)):
        lines -= piece.endswith(b"\n")


class AsciiPly(Scan):
    """Vertices of one PLY file in text."""

    def __init__(self, path: Path, header: PlyHeader) -> None:
        super().__init__(path, "ply", declared_count=header.points)
        self._header, self.columns = header, header.columns

    def _read(self, block_points: int) -> Iterator[ScanBlock]:
        header = self._header
        # Rows become float64 records with the vertex's property names, like the records of a binary
        # file.
        names = header.record.names or ()
        row = np.dtype([(name, np.float64) for name in names])
        seen = 0
        skip = sum(each.records for each in header.before)
        with open_text_file(self.path) as file:
            file.seek(header.start)
            _skip_lines(file, skip)
            for rows in number_rows(
                file,
                self.path,
                columns=len(names),
                delimiter=None,
                first_line=header.lines + skip + 1,
                limit=header.points,
                more=header.vertex.has_lists,
                behind=sum(each.records for each in header.after),
            ):
                seen += len(rows)
                for start in range(0, len(rows), block_points):
                    yield _block(self, rows.view(row)[start : start + block_points, 0], header)
        if seen < header.points:
            raise _truncated(self.path, seen, header.points)


def _block(scan: Scan, record: NDArray[np.void], header: PlyHeader) -> ScanBlock:
    """Convert vertex records to a block."""
    xyz = np.empty((len(record), 3))
    for axis, name in enumerate("xyz"):
        xyz[:, axis] = record[name]
    rgb = classes = None
    if scan.delivers(RGB):
        # Numbers of a text have the types that the header declares.
        rgb = stack_channels([_as_declared(record[name], header.record[name]) for name in header.rgb])
    if scan.delivers(CLASSIFICATION):
        classes = whole_bytes(record[header.classification])
    intensity = record[header.intensity].astype(np.float32) if header.intensity else None
    return ScanBlock(xyz, intensity, rgb, classes)


def _as_declared(values: NDArray[Any], kind: np.dtype[Any]) -> NDArray[Any]:
    """Return numbers in the type that the header declares, limited to its range."""
    if kind.kind == "f" or values.dtype == kind:
        return values
    return np.clip(np.nan_to_num(values), np.iinfo(kind).min, np.iinfo(kind).max).astype(kind)


def open_ply(path: Path) -> list[Scan]:
    """Return the one scan of a PLY file; reads its header only. Raises ScanError."""
    with library_errors(path):
        header = read_ply_header(path)
        skip = 0 if header.ascii else sum(each.records * each.least_bytes for each in header.before)
        least = 2 * len(header.vertex.properties) if header.ascii else header.vertex.least_bytes
        left = path.stat().st_size - header.start - skip
        # The last ASCII row may lack its line end; allow one byte for it.
        if header.points * least > left + header.ascii:
            raise _truncated(path, max(0, left // least), header.points)
        if header.ascii:
            return [AsciiPly(path, header)]
        if header.vertex.has_lists or any(each.has_lists for each in header.before):
            return [ListPly(path, header)]
        with path.open("rb") as file:
            file.seek(header.start + skip + header.points * header.vertex.least_bytes)
            _check_rest(file, path, header)
        return [BinaryPly(path, header)]


def _check_rest(file: BufferedReader, path: Path, header: PlyHeader) -> None:
    """Check that the elements after the vertices of a binary file end with it. Raises ScanError.

    A vertex count that is too small makes vertices the first bytes of the next element, a face for
    instance, whose lists then end elsewhere. file: at the end of the vertices.
    """
    _skip_elements(file, path, header.after)
    check_end(file, path, "elements")


def _skip_element(file: BufferedReader, path: Path, element: PlyElement) -> None:
    """Advance a binary file past an element. Raises ScanError where the file is shorter."""
    at, size = file.tell(), file.seek(0, 2)
    # Of each list: bytes before its length, type of the length, whether it is an unsigned byte, and
    # bytes of a value.
    lists: list[tuple[int, np.dtype[Any], bool, int]] = []
    fixed = 0
    for _, kind, length in element.properties:
        if length is None:
            fixed += kind.itemsize
        else:
            lists.append((fixed, length, length == np.uint8, kind.itemsize))
            fixed = 0
    if not lists:
        at += element.records * fixed
    begin, data = at, b""
    for number in range(element.records if lists else 0):
        if not number % 4096:
            check_interrupt()
        for before, length, is_byte, width in lists:
            at += before
            past = at + length.itemsize - begin
            if past > len(data):
                file.seek(at)
                begin, data, past = at, file.read(LISTS_BYTES), length.itemsize
            if past > len(data):
                at = size + 1
                break
            # A byte is the usual type of a length; its conversion would take most of the time.
            held = data[past - 1] if is_byte else int(np.frombuffer(data, length, 1, at - begin)[0])
            at += length.itemsize + held * width
            if held < 0 or held * width > BLOCK_BYTES:
                raise _bad_list(path, element, held)
        at += fixed
        if at > size:
            raise _truncated(path, number, element.records, f"{element.name} records")
    if at > size:
        raise _truncated(path, 0, element.records, f"{element.name} records")
    file.seek(at)


def ply_polygons(path: Path) -> list[NDArray[np.int64]]:
    """Return the vertex numbers of the faces, (n, k) for each number of corners k; none without faces.

    Raises ScanError.
    """
    header = read_ply_header(path)
    at = next((k for k, each in enumerate(header.elements) if each.name == "face" and each.has_lists), None)
    if at is None:
        return []
    face, before = header.elements[at], header.elements[:at]
    lists = [each.name for each in face.properties if each.length is not None]
    name = next((each for each in lists if each in ("vertex_indices", "vertex_index")), lists[0])
    found: dict[int, list[NDArray[Any]]] = {}
    with open_text_file(path) if header.ascii else path.open("rb") as file:
        file.seek(header.start)
        if header.ascii:
            _skip_lines(file, sum(each.records for each in before))
            runs = _text_lists(file, path, face, name)
        else:
            _skip_elements(file, path, before)
            runs = (records[name] for records in _list_records(file, path, face, BLOCK_POINTS))
        for run in runs:
            found.setdefault(run.shape[1], []).append(run)
    return [np.concatenate(found[corners]).astype(np.int64) for corners in sorted(found)]


def _text_lists(file: BinaryIO, path: Path, element: PlyElement, name: str) -> Iterator[NDArray[np.int64]]:
    """Yield a list of each record of an element in text, as (1, k). Raises ScanError."""
    for number in range(element.records):
        check_interrupt()
        words = file.readline(LONGEST_LINE).split()
        for each in element.properties:
            size = 1 if each.length is None else 1 + int(words[0]) if words else 0
            values, words = words[:size], words[size:]
            if not values or len(values) < size:
                raise _truncated(path, number, element.records, f"{element.name} records")
            if each.name == name:
                yield np.array([values[1:]], np.int64)


def _truncated(path: Path, found: int, declared: int, what: str = "vertices") -> Exception:
    return scan_error(
        path,
        f"the file ends after {found} {what} at most",
        f"the {declared} its header declares",
        "fetch the file again, it is truncated, or a count in its header is damaged",
    )
