"""PLY reader: the vertices of one file, ASCII or binary of either byte order.

plyfile reads the header. This module reads the body in blocks, because plyfile reads faces one by
one and ASCII vertices into one array of the size that the header claims.
"""

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.process.interrupts import check_interrupt
from ..common.colours import CLASSIFICATION, INTENSITY, RGB, find_columns, stack_channels, whole_bytes
from ..common.scan import (
    INTENSITY_NAMES,
    Scan,
    ScanBlock,
    SeekableScan,
    check_end,
    library_errors,
    read_records,
    reader_library,
    scan_error,
)
from ..common.text_rows import LONGEST_LINE, number_rows

# Maximum bytes of a header. A real one has a few hundred bytes.
LONGEST_HEADER = 1 << 20
# Bytes of elements with lists read at a time.
LISTS_BYTES = 1 << 16


class _Header(NamedTuple):
    """Description of a PLY file's vertices, from its header."""

    record: np.dtype[np.void]  # layout of one vertex in a binary file
    points: int
    start: int  # byte offset of the body
    skip: int  # size of the data before the vertices: bytes in a binary file, lines in an ASCII one
    lines: int  # number of header lines
    behind: int  # number of rows after the vertices in an ASCII file
    ascii: bool
    order: str  # byte order of a binary file: "<" or ">"
    intensity: str | None  # the property's name
    rgb: tuple[str, ...]  # names of red, green and blue, or ()
    classification: str | None

    @property
    def columns(self) -> frozenset[str]:
        """Return `Scan.columns`."""
        held = {INTENSITY: self.intensity, RGB: self.rgb, CLASSIFICATION: self.classification}
        return frozenset(name for name, here in held.items() if here)


class BinaryPly(SeekableScan):
    """Vertices of one binary PLY file."""

    def __init__(self, path: Path, header: _Header) -> None:
        super().__init__(path, "ply", declared_count=header.points)
        self._header, self.columns = header, header.columns

    def _read_between(self, block_points: int, start: int, stop: int) -> Iterator[ScanBlock]:
        header = self._header
        with self.path.open("rb") as file:
            file.seek(header.start + header.skip + start * header.record.itemsize)
            for record in read_records(
                file, self.path, header.record, stop - start, block_points, "vertices"
            ):
                yield _block(self, record, header)


def _skip_lines(file: BinaryIO, lines: int) -> None:
    """Read past lines of any length, in bounded memory; stops at the end of the file."""
    while lines and (piece := file.readline(LONGEST_LINE)):
        lines -= piece.endswith(b"\n")


class AsciiPly(Scan):
    """Vertices of one PLY file in text."""

    def __init__(self, path: Path, header: _Header) -> None:
        super().__init__(path, "ply", declared_count=header.points)
        self._header, self.columns = header, header.columns

    def _read(self, block_points: int) -> Iterator[ScanBlock]:
        header = self._header
        # Rows become float64 records with the vertex's property names, like the records of a binary
        # file.
        names = header.record.names or ()
        row = np.dtype([(name, np.float64) for name in names])
        seen = 0
        with self.path.open("rb") as file:
            file.seek(header.start)
            _skip_lines(file, header.skip)
            for rows in number_rows(
                file,
                self.path,
                columns=len(names),
                delimiter=None,
                first_line=header.lines + header.skip + 1,
                limit=header.points,
                behind=header.behind,
            ):
                seen += len(rows)
                for start in range(0, len(rows), block_points):
                    yield _block(self, rows.view(row)[start : start + block_points, 0], header)
        if seen < header.points:
            raise _truncated(self.path, seen, header.points)


def _block(scan: Scan, record: NDArray[np.void], header: _Header) -> ScanBlock:
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
    with library_errors(path), path.open("rb") as file:
        header, later = _read_header(file, path)
        least = 2 * len(header.record.names or ()) if header.ascii else header.record.itemsize
        left = path.stat().st_size - header.start - (0 if header.ascii else header.skip)
        # The last ASCII row may lack its line end; allow one byte for it.
        if header.points * least > left + header.ascii:
            raise _truncated(path, max(0, left // least), header.points)
        if not header.ascii:
            size = header.record.itemsize
            file.seek(header.start + header.skip + header.points * size)
            for element, count in later:
                _skip_element(file, path, element, count, header.order)
            check_end(file, path, "elements")
        return [(AsciiPly if header.ascii else BinaryPly)(path, header)]


def _skip_element(file: BinaryIO, path: Path, element: Any, count: int, order: str) -> None:
    """Advance a binary file past an element of plyfile. Raises ScanError where the file is shorter.

    A vertex count that is too small makes vertices the first bytes of the next element, a face for
    instance, whose lists then end elsewhere than the file.
    """
    at, size = file.tell(), file.seek(0, 2)
    # Of each list: bytes of fixed size before its length, type of the length, bytes of an item.
    lists: list[tuple[int, np.dtype[Any], int]] = []
    fixed = 0
    for item in element.properties:
        if hasattr(item, "list_dtype"):
            length, value = map(np.dtype, item.list_dtype(order))
            lists.append((fixed, length, value.itemsize))
            fixed = 0
        else:
            fixed += np.dtype(item.dtype(order)).itemsize
    if not lists:
        at += count * fixed
        count = 0
    begin, data = at, b""
    for number in range(count):
        if not number % 4096:
            check_interrupt()
        for before, kind, width in lists:
            at += before
            past = at + kind.itemsize - begin
            if past > len(data):
                file.seek(at)
                begin, data, past = at, file.read(LISTS_BYTES), kind.itemsize
            if past > len(data):
                at = size + 1
                break
            # A byte, the usual type of a length, needs no conversion: 0.1 us per face.
            held = data[past - 1] if kind.itemsize == 1 else np.frombuffer(data, kind, 1, at - begin)[0]
            at += kind.itemsize + max(0, int(held)) * width
        at += fixed
        if at > size:
            break
    if at > size:
        raise scan_error(
            path,
            f"element {element.name!r} that ends at byte {at} of {size}",
            "all elements that its header declares",
            "fetch the file again: it is truncated, or a count in its header is damaged",
        )
    file.seek(at)


def _truncated(path: Path, found: int, declared: int) -> Exception:
    return scan_error(
        path,
        f"the file ends after {found} vertices at most",
        f"the {declared} its header declares",
        "fetch the file again, it is truncated",
    )


def _read_header(file: BinaryIO, path: Path) -> tuple[_Header, list[tuple[Any, int]]]:
    """Read and check the header; leaves the file position at the start of the body.

    Returns the elements of plyfile after the vertices, too, each with its count.
    """
    lines: list[str] = []
    counts: list[int] = []
    while not lines or lines[-1] != "end_header":
        raw = file.readline(LONGEST_HEADER)
        # Some writers leave blanks at the ends of lines ("ply "), which plyfile refuses.
        line = raw.decode("ascii", "replace").strip()
        if (not lines and line != "ply") or not raw or file.tell() > LONGEST_HEADER:
            raise scan_error(
                path,
                f"line {len(lines) + 1} is {line[:60]!r}",
                "a PLY header, from 'ply' to 'end_header'",
                "check that this is a PLY file",
            )
        words = line.split()
        if len(words) == 3 and words[0] == "element" and words[2].isdecimal():
            counts.append(int(words[2]))
            # plyfile reads the declared number of records. Declare none: only the header is needed.
            line = f"element {words[1]} 0"
        lines.append(line)
    start = file.tell()
    plyfile = reader_library("plyfile", path)
    ply = plyfile.PlyData.read(io.BytesIO(("\n".join(lines) + "\n").encode("ascii")))
    if "vertex" not in ply:
        found = ", ".join(element.name for element in ply) or "none"
        raise scan_error(
            path, f"elements: {found}", "an element 'vertex'", "check that this is a PLY of points"
        )
    skip = 0
    later = list(zip(ply, counts, strict=True))
    while later:
        element, count = later.pop(0)
        lists = any(isinstance(item, plyfile.PlyListProperty) for item in element.properties)
        if lists and (element.name == "vertex" or not ply.text):
            raise scan_error(
                path,
                f"element {element.name!r} has a list property and comes no later than the vertices",
                "vertices of fixed size, first in the file",
                "write the PLY with its vertices first and no lists in them",
            )
        if element.name == "vertex":
            break
        skip += count if ply.text else count * element.dtype().itemsize
    record = element.dtype("=" if ply.text else ply.byte_order)
    missing = [name for name in "xyz" if name not in record.names]
    if missing:
        raise scan_error(
            path,
            f"vertices without {', '.join(missing)}",
            "properties x, y and z",
            "check the program that wrote this file",
        )
    intensity = next((name for name in record.names if name.lower() in INTENSITY_NAMES), None)
    colours, of_class = find_columns(record.names)
    header = _Header(
        record, count, start, skip, len(lines), sum(rows for _, rows in later), ply.text, ply.byte_order,
        intensity, tuple(record.names[at] for at in colours),
        None if of_class is None else record.names[of_class],
    )  # fmt: skip
    return header, later
