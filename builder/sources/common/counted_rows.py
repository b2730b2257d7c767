"""Text blocks of rows whose count is declared before them, as in PTX and PTS files.

Such a file does not state where its second block begins. Opening it therefore reads it once and
counts lines, in bounded memory.
"""

import io
import re
from collections.abc import Iterator
from io import BufferedReader
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ....schemas.runtime.interrupts import check_interrupt
from ....schemas.runtime.text_encoding import UTF8_MARK
from .colours import INTENSITY, RGB, whole_bytes
from .scan import NO_RETURN, Scan, ScanBlock, apply_pose, scan_error
from .text_rows import (
    CHUNK_BYTES,
    LONGEST_LINE,
    NEWLINE,
    is_number,
    line_ends,
    number_rows,
    open_text_file,
    split_row,
)

# Bytes of the shortest row of three numbers, "0 0 0" and a line end. A declared count is checked
# against the bytes left in the file.
MIN_ROW_BYTES = 6
# The end of a line before a blank line or a comment, which is no row.
_NO_ROW = re.compile(rb"\n(?=[ \t]*(?:\n|#|//|;(?![ \t]*[-+.\d])))")


class CountedRows(Scan):
    """One block of rows: x, y, z, and optionally an intensity and a colour."""

    def __init__(
        self,
        path: Path,
        format: str,
        index: int,
        count: int,
        *,
        start: int,
        line: int,
        columns: int,
        pose: NDArray[np.float64] | None = None,
        zeros_are_no_return: bool = False,
    ) -> None:
        """Describe a block of `count` rows.

        start, line: byte and line number of the first row.
        columns: numbers in each row, see `pts_columns`. Colours are from 0 to 255.
        """
        super().__init__(path, format, index=index, declared_count=count, pose=pose)
        self._start, self._line, self._columns = start, line, columns
        self._zeros_are_no_return = zeros_are_no_return
        self._intensity, self._rgb = pts_columns(columns)
        self.columns = frozenset([INTENSITY] * (self._intensity is not None) + [RGB] * bool(self._rgb))

    def _read(self, block_points: int) -> Iterator[ScanBlock]:
        count = self.declared_count or 0
        if not count:
            return
        seen = 0
        with open_text_file(self.path) as file:
            file.seek(self._start)
            for rows in number_rows(
                file, self.path, columns=self._columns, delimiter=None, first_line=self._line, limit=count
            ):
                seen += len(rows)
                for start in range(0, len(rows), block_points):
                    block = self._block(rows[start : start + block_points])
                    if len(block.xyz):
                        yield block
        if seen < count:
            raise _too_few(self.path, self.index, seen, count)

    def _block(self, rows: NDArray[np.float64]) -> ScanBlock:
        if self._zeros_are_no_return:
            hit = (rows[:, :3] != 0).any(axis=1)
            lost = len(rows) - int(np.count_nonzero(hit))
            if lost:
                self.dropped[NO_RETURN] = self.dropped.get(NO_RETURN, 0) + lost
                rows = rows[hit]
        xyz = apply_pose(self.pose, np.ascontiguousarray(rows[:, :3]))
        return ScanBlock(
            xyz,
            None if self._intensity is None else rows[:, self._intensity].astype(np.float32),
            whole_bytes(rows[:, self._rgb]) if self.delivers(RGB) else None,
        )


def pts_columns(count: int) -> tuple[int | None, tuple[int, ...]]:
    """Return the columns of the intensity, or None, and of red, green and blue, or (), in PTS and PTX.

    count: numbers in a row. x y z i, x y z i r g b and x y z r g b are common. A fifth number has
    no meaning of its own; of more than seven, only x, y and z are certain.
    """
    return 3 if count in (4, 5, 7) else None, (count - 3, count - 2, count - 1) if count in (6, 7) else ()


def skip_rows(file: BufferedReader, path: Path, index: int, count: int, first_line: int) -> tuple[int, int]:
    """Advance the file past `count` rows; return the columns of the first one, and the next line's number.

    index: number of the scan, for messages.
    first_line: number of the line at the current file position.
    Blank lines and comments are no rows (text_rows.py). Without rows there are 0 columns.
    Raises ScanError where there are fewer lines, or where the first row is not a point.
    """
    if not count:
        return 0, first_line
    begin = file.tell()
    left = file.seek(0, 2) - begin
    file.seek(begin)
    if count * MIN_ROW_BYTES > left + 1:  # the last row may lack its line end
        raise _too_few(path, index, max(0, (left + 1) // MIN_ROW_BYTES), count)
    columns, wanted, line = 0, count, first_line
    while True:
        check_interrupt()
        begin = file.tell()
        data = file.read(CHUNK_BYTES)
        data += file.readline(LONGEST_LINE)
        if not data:
            raise _too_few(path, index, count - wanted, count)
        # The last row may lack its line end. A match of _NO_ROW is the line end before such a line.
        lines = line_ends(NEWLINE + data + (b"" if data.endswith(NEWLINE) else NEWLINE))
        columns = columns or _first_columns(path, lines[1:], line)
        others = [found.start() for found in _NO_ROW.finditer(lines)]
        found = lines.count(NEWLINE) - 1 - len(others)
        if found >= wanted:
            ends = np.flatnonzero(np.frombuffer(lines, np.uint8) == NEWLINE[0])
            row_ends = ends[1:][~np.isin(ends[:-1], others)]
            last = row_ends[wanted - 1]
            file.seek(begin + min(int(last), len(data)))
            return columns, line + int(np.searchsorted(ends, last))
        wanted, line = wanted - found, line + lines.count(NEWLINE) - 1


def _first_columns(path: Path, lines: bytes, line: int) -> int:
    """Return the columns of the first row in some lines, 0 without one. line: number of the first line."""
    for number, raw in enumerate(io.BytesIO(lines), line):
        if not (fields := split_row(raw, None)):
            continue
        if len(fields) < 3 or not all(map(is_number, fields)):
            raise scan_error(
                path,
                f"line {number} is {raw.decode('latin-1').strip()[:60]!r}",
                "x y z, optionally followed by an intensity, a colour or both",
                "check the program that wrote this file",
            )
        return len(fields)
    return 0


def next_line(file: BufferedReader, line: int) -> tuple[str, int]:
    """Return the next line, stripped, that is neither blank nor a comment, and its number.

    line: number of the line at the current file position. At the end of the file the text is "".
    """
    while raw := file.readline(LONGEST_LINE):
        raw = raw.removeprefix(UTF8_MARK)  # of files that were joined
        if split_row(raw, None):
            return raw.decode("latin-1").strip(), line
        line += 1
    return "", line


def _too_few(path: Path, index: int, found: int, declared: int) -> Exception:
    return scan_error(
        path,
        f"scan {index} ends after {found} rows at most",
        f"the {declared} declared before them",
        "fetch the file again, it may be truncated",
    )
