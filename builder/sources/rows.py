"""Rows of numbers in text, read in bounded blocks: what text scans, ASCII PLY, OBJ and ASCII STL share."""

import io
import re
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from ...schemas.errors import ScanError
from ...schemas.interrupts import check
from .scan import scan_error

# 4 MiB of text is about 130,000 rows of three numbers. At worst ("1 1 1 ...") it is 2 M numbers, 16 MiB.
CHUNK_BYTES = 4 << 20

# The longest line accepted; a file without line ends would otherwise be read whole to find one.
LONGEST_LINE = 1 << 20

NEWLINE = b"\n"


def text_chunks(file: BinaryIO, path: Path, first_line: int = 1) -> Iterator[tuple[int, bytes]]:
    """Read the rest of a file as chunks of whole lines.

    file: open for reading bytes, at the start of a line.  first_line: the number of that line, for messages.
    Yields (number of the chunk's first line, its bytes). Raises ScanError for a line over LONGEST_LINE and
    for a zero byte.
    """
    rest = b""
    line = first_line
    while data := file.read(CHUNK_BYTES):
        check()  # an OBJ may have nothing but faces for gigabytes
        data = rest + data
        # A file system that lost a part of a file gives zeros in its place; OBJ would skip them as no vertex.
        if b"\0" in data:
            at = line + data.count(NEWLINE, 0, data.index(b"\0"))
            raise scan_error(
                path, f"line {at} holds a zero byte", "text", "fetch the file again, it is damaged"
            )
        end = data.rfind(NEWLINE) + 1
        chunk, rest = data[:end], data[end:]
        if len(rest) > LONGEST_LINE:
            raise scan_error(
                path,
                f"line {line + chunk.count(NEWLINE)} is longer than {LONGEST_LINE} bytes",
                "text with one point a line",
                "check that this is a text file with LF or CRLF line ends",
            )
        if chunk:
            yield line, chunk
            line += chunk.count(NEWLINE)
    if rest:
        yield line, rest


def split_row(line: str, delimiter: str | None) -> list[str]:
    """The fields of one line, as numpy.loadtxt would split it: "#" starts a comment, blanks around go."""
    line = line.split("#", 1)[0].strip()
    return [field.strip() for field in line.split(delimiter)] if line else []


def is_number(field: str) -> bool:
    """Whether a field of a row is a number; Python's "1_000" is none to the readers of other programs."""
    try:
        float(field)
    except ValueError:
        return False
    return "_" not in field


def _parse(lines: io.BytesIO | list[bytes], delimiter: str | None, **options: object) -> NDArray[np.float64]:
    """The rows of some lines by numpy's own reader, (n, columns); ValueError for a line it cannot read."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # "input contained no data": blank lines are no fault
        # Latin-1 takes any byte, so that a stray one is reported as a broken line and not as a codec's error.
        return np.loadtxt(lines, delimiter=delimiter, encoding="latin-1", ndmin=2, **options)  # type: ignore[call-overload, no-any-return]


def number_rows(
    file: BinaryIO,
    path: Path,
    *,
    columns: int,
    delimiter: str | None,
    first_line: int,
    limit: int | None = None,
) -> Iterator[NDArray[np.float64]]:
    """Read rows of `columns` numbers each, in blocks of at most CHUNK_BYTES of text.

    file: open for reading bytes, at the start of line number `first_line`.
    delimiter: "," or ";", or None for any run of blanks.  limit: stop after that many rows.
    Yields (n, columns) float64, n > 0. Blank lines and what follows "#" are skipped. Numbers are rounded
    correctly (David Gay's algorithm, by way of CPython). Raises ScanError with the number of the first line
    that is not `columns` numbers.
    Parsed by numpy.loadtxt: 3 to 4.7 million rows a second in a trial, against 1.3 for bytes.split().
    """
    for line, chunk in text_chunks(file, path, first_line):
        most = None
        if limit is not None:
            # loadtxt makes room at once for as many rows as it is told to read at most, of as many numbers as the first
            # has: for no more than these bytes can hold.
            if _first_width(chunk, delimiter) not in (None, columns):
                raise _broken_row(path, line, chunk, columns, delimiter, limit)
            most = min(limit, chunk.count(NEWLINE) + 1, len(chunk) // (2 * columns) + 1)
        try:
            rows = _parse(io.BytesIO(chunk), delimiter, max_rows=most)
        except ValueError as error:
            raise _broken_row(path, line, chunk, columns, delimiter, limit) from error
        if not rows.size:
            continue
        if rows.shape[1] != columns:
            raise _broken_row(path, line, chunk, columns, delimiter, limit)
        yield rows
        if limit is not None:
            limit -= len(rows)
            if limit == 0:
                return


def _first_width(chunk: bytes, delimiter: str | None) -> int | None:
    """How many fields the first row of some lines has; None where there is no row."""
    for raw in io.BytesIO(chunk):
        if fields := split_row(raw.decode("latin-1"), delimiter):
            return len(fields)
    return None


def _broken_row(
    path: Path, first_line: int, chunk: bytes, columns: int, delimiter: str | None, limit: int | None
) -> ScanError:
    """The error for the first line of a chunk that is not `columns` numbers; slow, and called once."""
    expected = f"{columns} numbers like the first row"
    rows = 0
    for number, raw in enumerate(io.BytesIO(chunk), first_line):
        fields = split_row(raw.decode("latin-1"), delimiter)
        if fields and (len(fields) != columns or not all(map(is_number, fields))):
            return _broken_line(path, number, raw, expected)
        rows += bool(fields)
        if rows == limit:
            break
    # loadtxt and is_number() differ on what a number is: name the chunk, it is all we know.
    return _broken_line(path, first_line, b"(here or below)", expected)


def _broken_line(path: Path, number: int, raw: bytes, expected: str) -> ScanError:
    shown = raw.decode("latin-1").strip()[:60]
    what_to_do = "repair or remove that line; if it is the last one, the file may be truncated"
    return scan_error(path, f"line {number} is {shown!r}", expected, what_to_do)


def keyword_rows(file: BinaryIO, path: Path, keyword: str) -> Iterator[NDArray[np.float64]]:
    """Read the three numbers after a keyword ("v" in OBJ, "vertex" in STL), other lines skipped.

    Yields (n, 3) float64, n > 0; further numbers on the line (a weight, a colour) are left out.
    Raises ScanError with the number of the first line whose three numbers cannot be read.
    """
    lines_of = re.compile(rb"^[ \t]*" + keyword.encode() + rb"(?:[ \t]+(.*))?$", re.MULTILINE)
    for line, chunk in text_chunks(file, path):
        found = lines_of.findall(chunk)
        try:
            rows = _parse(found, None, usecols=(0, 1, 2)) if found else np.empty((0, 3))
            broken = len(rows) != len(found)  # loadtxt skips a keyword with nothing behind it
        except ValueError:
            broken = True
        if broken:
            raise _broken_keyword(path, line, chunk, lines_of, keyword)
        if len(rows):
            yield rows


def _broken_keyword(
    path: Path, first_line: int, chunk: bytes, lines_of: re.Pattern[bytes], keyword: str
) -> ScanError:
    """The error for the first line of a chunk whose keyword is not followed by three numbers."""
    expected = f"{keyword!r} and three numbers"
    for number, raw in enumerate(io.BytesIO(chunk), first_line):
        match = lines_of.match(raw.rstrip(b"\r\n"))
        if match:
            fields = split_row((match[1] or b"").decode("latin-1"), None)
            if len(fields) < 3 or not all(map(is_number, fields[:3])):
                return _broken_line(path, number, raw, expected)
    return _broken_line(path, first_line, b"(here or below)", expected)
