"""Text files, opened in one way, and rows of numbers in them, read in bounded blocks.

Shared by all formats that are text or begin with a header in text.
"""

import io
import re
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ....schemas.errors import ScanError
from ....schemas.runtime.interrupts import check_interrupt
from ....schemas.runtime.text_encoding import UTF8_MARK, is_utf16
from .scan import scan_error

# 4 MiB of text is about 130,000 rows of three numbers. In the worst case ("1 1 1 ...") it is 2 M
# numbers, 16 MiB.
CHUNK_BYTES = 4 << 20

# Longest accepted line; without this limit a file without line ends would be read whole.
LONGEST_LINE = 1 << 20

NEWLINE = b"\n"
_ROW = re.compile(rb"^[^\S\n]*(?!//)[^\s#;]", re.MULTILINE)

# Bytes of the beginning of a file that show its encoding and its line ends.
_HEAD_BYTES = 1 << 16
# Ctrl-Z at the end of a file: end-of-file mark of CP/M and DOS, which some programs still write.
_END_MARK = re.compile(rb"\x1a[\x1a\s]*\Z")
_LINE_END = re.compile(rb"\r\n?|\n")

# What rows may hold besides numbers and delimiters, and numpy.loadtxt does not accept.
# A number behind the ";" makes it a row: one wrong bit turns "3" into ";".
# So does a number before the "#": one wrong byte joins two rows by it.
_COMMENT = re.compile(rb"(?<!\S)#.*|^[ \t]*(?://|;(?![ \t]*[-+.\d])).*", re.MULTILINE)
_HASH_COMMENT = re.compile(rb"#(?<!\S#).*")
_COMMENT_OR_FIELDS = re.compile(rb"(?<!\S)#.*|^[ \t]*//.*", re.MULTILINE)  # where ";" separates fields
_EMPTY_ENDS = {
    ",": re.compile(rb",[, \t\r]*$", re.MULTILINE),
    ";": re.compile(rb";[; \t\r]*$", re.MULTILINE),
}
# The search for a literal first byte is fast.
DECIMAL_COMMA = re.compile(rb",(?<=\d,)(?=\d)")
# What C programs on Windows print for NaN and infinities; the "#" would begin a comment.
_WINDOWS_NAN = re.compile(rb"[-+]?(?:nan\([a-z]*\)|1\.#(?:QNAN|SNAN|IND|INF)\d*)", re.IGNORECASE)
# Numbers of an OBJ file with a vertex in the same line: one wrong byte joins two lines.
_JOINED_OBJ = re.compile(rb"^[ \t]*(?:v[ntp]?|[flp])[ \t][^\n]*[v#]", re.MULTILINE | re.IGNORECASE)
_QUOTED = re.compile(rb"""(["'])([^\s"',;]*)\1""")


class _CleanedText(io.RawIOBase):
    """Bytes of a text file up to its end mark, with CR turned into LF. Offsets are those of the file."""

    def __init__(self, file: io.RawIOBase, end: int, cr: bool) -> None:
        self._file, self._end, self._cr = file, end, cr

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = 0) -> int:
        return self._file.seek(self._end + offset if whence == 2 else offset, whence % 2)

    def readinto(self, buffer: Any) -> int:
        data = self._file.read(max(0, min(len(buffer), self._end - self._file.tell())))
        buffer[: len(data)] = data.replace(b"\r", NEWLINE) if self._cr else data
        return len(data)

    def close(self) -> None:
        self._file.close()
        super().close()


def open_text_file(path: Path) -> io.BufferedReader:
    """Open a text file, or one that begins with text, at its first letter, in binary mode.

    A byte order mark is skipped, and an end mark (Ctrl-Z) is left out. Where lines end in CR alone,
    as on old Macs, CR is read as LF. Offsets are those of the file. Use the result for text only.
    Raises ScanError for UTF-16.
    """
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES)
        size = file.seek(0, 2)
        file.seek(max(0, size - 64))
        mark = _END_MARK.search(file.read())
    if is_utf16(head):
        raise scan_error(
            path, "text in UTF-16", "ASCII or UTF-8", "save it as UTF-8 (in Windows: not as Unicode)"
        )
    first_end = _LINE_END.search(head)
    cr = first_end is not None and first_end[0] == b"\r"
    end = size - len(mark[0]) if mark else size
    text: io.BufferedReader = path.open("rb")
    if cr or mark:
        text = io.BufferedReader(_CleanedText(text.detach(), end, cr))
    text.seek(len(UTF8_MARK) if head.startswith(UTF8_MARK) else 0)
    return text


def text_chunks(file: BinaryIO, path: Path, first_line: int = 1) -> Iterator[tuple[int, bytes]]:
    """Read the rest of a file as chunks of whole lines.

    file: open in binary mode, at the start of a line.
    first_line: the number of that line, for messages.
    Yields (number of the chunk's first line, its bytes). Raises ScanError for a line longer than
    LONGEST_LINE and for a zero byte.
    """
    rest = b""
    line = first_line
    while data := file.read(CHUNK_BYTES):
        check_interrupt()  # an OBJ may hold gigabytes of faces only, and yield no block meanwhile
        data = rest + data
        # A file system that lost part of a file returns zeros in its place; OBJ would skip them as
        # a line without a vertex.
        if b"\0" in data:
            at = line + data.count(NEWLINE, 0, data.index(b"\0"))
            raise scan_error(
                path, f"line {at} holds a zero byte", "text", "fetch the file again, it is damaged"
            )
        if UTF8_MARK in data:  # of files that were joined
            data = data.replace(UTF8_MARK, b"")
        end = data.rfind(NEWLINE) + 1
        chunk, rest = line_ends(data[:end]), data[end:]
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
        yield line, line_ends(rest)


def line_ends(lines: bytes) -> bytes:
    """Return whole lines that end in LF, of the same length: a CR alone ends a line too."""
    return lines.replace(b"\r\n", b" \n").replace(b"\r", NEWLINE) if b"\r" in lines else lines


def split_row(line: bytes, delimiter: str | None) -> list[str]:
    """Split one line into stripped fields; see `tidy_rows`."""
    text = tidy_rows(line, delimiter).decode("latin-1").strip()
    return [field.strip() for field in text.split(delimiter)] if text else []


def tidy_rows(lines: bytes, delimiter: str | None) -> bytes:
    """Return lines of rows as numpy.loadtxt accepts them, each at its place.

    Comments are left out: what follows "#" behind a blank, and lines that begin with "//", or with
    ";" and no number. So are delimiters at the end of a line, and quotes around a number. A decimal
    comma becomes a point where commas do not separate fields.
    """
    lines = _without_comments(_plain_nan(lines), delimiter)
    if delimiter != ",":
        lines = DECIMAL_COMMA.sub(b".", lines)
    if b'"' in lines or b"'" in lines:
        lines = _QUOTED.sub(rb"\2", lines)
    return _EMPTY_ENDS[delimiter].sub(b"", lines) if delimiter else lines


def _plain_nan(lines: bytes) -> bytes:
    """Return lines with "nan" for what means that, or infinity, to C programs on Windows."""
    return _WINDOWS_NAN.sub(b"nan", lines) if b".#" in lines or b"(" in lines else lines


def _without_comments(lines: bytes, delimiter: str | None) -> bytes:
    """Return lines without comments. The search for them is slow, and few files have any."""
    if b"#" in lines or b"//" in lines or (delimiter != ";" and b";" in lines):
        return (_COMMENT_OR_FIELDS if delimiter == ";" else _COMMENT).sub(b"", lines)
    return lines


def is_number(field: str) -> bool:
    """Return whether a field is a number; Python's "1_000" is not, because other programs refuse it."""
    try:
        float(field)
    except ValueError:
        return False
    return "_" not in field


def _parse(lines: io.BytesIO | list[bytes], delimiter: str | None, **options: object) -> NDArray[np.float64]:
    """Parse lines with numpy.loadtxt into (n, columns); raises ValueError for a line it cannot read."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # "input contained no data": blank lines are valid
        # Latin-1 decodes any byte: a stray byte is reported as a broken line and not as a codec
        # error.
        return np.loadtxt(lines, delimiter=delimiter, comments=None, encoding="latin-1", ndmin=2, **options)  # type: ignore[call-overload, no-any-return]


def number_rows(
    file: BinaryIO,
    path: Path,
    *,
    columns: int,
    delimiter: str | None,
    first_line: int,
    limit: int | None = None,
    behind: int | None = None,
    more: bool = False,
) -> Iterator[NDArray[np.float64]]:
    """Read rows of `columns` numbers each, in blocks of at most CHUNK_BYTES of text.

    file: open in binary mode, at the start of line number `first_line`.
    delimiter: "," or ";", or None for any run of blanks.
    limit: stop after that many rows.
    more: whether rows may go on after these numbers.
    behind: number of rows of any content that must follow these to the end of the file, because a
    count that is too small would leave out points; None: not checked.
    Yields (n, columns) float64, n > 0. Blank lines and comments are skipped, see `tidy_rows`.
    Numbers are rounded correctly (David Gay's algorithm, by way of CPython). Raises ScanError with
    the number of the first line that is not `columns` numbers, for decimal commas beside decimal
    points, one of which may separate thousands, and if not `behind` rows follow.
    numpy.loadtxt parses 3 to 4.7 million rows a second in a trial, against 1.3 million for
    bytes.split(). Rows that it refuses are tidied and parsed again.
    """
    following = 0
    points = commas = False  # whether numbers with decimal points, and with decimal commas, were read
    options = {"usecols": range(columns)} if more else {}
    for line, chunk in text_chunks(file, path, first_line):
        if limit == 0:
            following += _count_rows(chunk)
            continue
        chunk, most = _without_comments(_plain_nan(chunk), delimiter), None
        if limit is not None:
            # loadtxt allocates max_rows rows at once, with as many columns as the first row has.
            # Bound both by what these bytes can hold.
            width = _first_width(chunk, delimiter)
            if width is not None and (width < columns if more else width != columns):
                raise _broken_row(path, line, chunk, columns, delimiter, limit, more)
            most = min(limit, chunk.count(NEWLINE) + 1, len(chunk) // (2 * columns) + 1)
        try:
            rows = _parse(io.BytesIO(chunk), delimiter, max_rows=most, **options)
        except ValueError:
            commas = commas or (delimiter != "," and b"," in chunk)
            try:
                rows = _parse(io.BytesIO(tidy_rows(chunk, delimiter)), delimiter, max_rows=most, **options)
            except ValueError as error:
                raise _broken_row(path, line, chunk, columns, delimiter, limit, more) from error
        points = points or b"." in chunk
        if commas and points:
            raise scan_error(
                path,
                f"decimal commas and points (first at line {line} or below)",
                "one of them in all numbers",
                "write it with decimal points, and without separators of thousands",
            )
        if not rows.size:
            continue
        if rows.shape[1] != columns:
            raise _broken_row(path, line, chunk, columns, delimiter, limit, more)
        yield rows
        if limit is not None:
            limit -= len(rows)
            if limit == 0 and behind is None:
                return
            following = _count_rows(chunk) - len(rows)
    if limit == 0 and behind not in (None, following):
        raise scan_error(
            path,
            f"{following} rows behind the points that its header declares",
            f"{behind}",
            "fetch the file again: a count in its header is damaged, or the file is truncated",
        )


def _count_rows(chunk: bytes) -> int:
    """Return the number of lines that are neither blank nor a comment."""
    return sum(1 for _ in _ROW.finditer(chunk))


def _first_width(chunk: bytes, delimiter: str | None) -> int | None:
    """Return the number of fields of the first row in a chunk, or None where there is no row."""
    for raw in io.BytesIO(chunk):
        if fields := split_row(raw, delimiter):
            return len(fields)
    return None


def _broken_row(
    path: Path,
    first_line: int,
    chunk: bytes,
    columns: int,
    delimiter: str | None,
    limit: int | None,
    more: bool,
) -> ScanError:
    """Build the error for the first line of a chunk that is not `columns` numbers; slow, called once."""
    expected = f"{columns} numbers like the first row"
    rows = 0
    for number, raw in enumerate(io.BytesIO(chunk), first_line):
        fields = split_row(raw, delimiter)
        fits = len(fields) >= columns if more else len(fields) == columns
        if fields and not (fits and all(map(is_number, fields[:columns]))):
            return _broken_line(path, number, raw, expected)
        rows += bool(fields)
        if rows == limit:
            break
    # loadtxt and is_number() differ on what a number is: the failing line is unknown, report the
    # chunk.
    return _broken_line(path, first_line, b"(here or below)", expected)


def _broken_line(path: Path, number: int, raw: bytes, expected: str) -> ScanError:
    shown = raw.decode("latin-1").strip()[:60]
    what_to_do = "repair or remove that line; if it is the last one, the file may be truncated"
    return scan_error(path, f"line {number} is {shown!r}", expected, what_to_do)


def keyword_rows(file: BinaryIO, path: Path, keyword: str) -> Iterator[NDArray[np.float64]]:
    """Read the three numbers after a keyword ("v" in OBJ, "vertex" in STL); other lines are skipped.

    Yields (n, 3) float64, n > 0; further numbers on the line (a weight, a colour) are ignored.
    Decimal commas are read where no number has a point.
    Raises ScanError with the number of the first line whose three numbers cannot be read.
    """
    lines_of = re.compile(rb"^[ \t]*" + keyword.encode() + rb"(?:[ \t]+(.*))?$", re.MULTILINE | re.IGNORECASE)
    for line, chunk in text_chunks(file, path):
        plain = _HASH_COMMENT.sub(b"", chunk)
        found = lines_of.findall(plain)
        if b"," in plain and not any(b"." in each for each in found):
            found = [DECIMAL_COMMA.sub(b".", each) for each in found]
        try:
            rows = _parse(found, None, usecols=(0, 1, 2)) if found else np.empty((0, 3))
            # loadtxt skips a keyword with nothing after it.
            broken = len(rows) != len(found) or (keyword == "v" and _JOINED_OBJ.search(plain) is not None)
        except ValueError:
            broken = True
        if broken:
            raise _broken_keyword(path, line, chunk, lines_of, keyword)
        if len(rows):
            yield rows


def _broken_keyword(
    path: Path, first_line: int, chunk: bytes, lines_of: re.Pattern[bytes], keyword: str
) -> ScanError:
    """Build the error for the first line of a chunk whose keyword lacks three numbers after it."""
    expected = f"{keyword!r} and three numbers"
    for number, raw in enumerate(io.BytesIO(chunk), first_line):
        plain = _HASH_COMMENT.sub(b"", raw.rstrip(b"\r\n"))
        if keyword == "v" and _JOINED_OBJ.match(plain):
            return _broken_line(path, number, raw, "numbers only")
        if match := lines_of.match(plain):
            # Unlike split_row(), without decimal commas.
            fields = (match[1] or b"").decode("latin-1").split()
            if len(fields) < 3 or not all(map(is_number, fields[:3])):
                return _broken_line(path, number, raw, expected)
    return _broken_line(path, first_line, b"(here or below)", expected)
