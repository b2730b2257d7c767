"""Text blocks of rows whose count is declared before them, as in PTX and PTS files.

Such a file does not state where its second block begins. Opening it therefore reads it once and
counts line ends, in bounded memory (about 1 GB a second).
"""

from collections.abc import Iterator
from io import BufferedReader
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ....schemas.process.interrupts import check_interrupt
from .colours import INTENSITY, RGB, whole_bytes
from .scan import NO_RETURN, Scan, ScanBlock, apply_pose, scan_error
from .text_rows import CHUNK_BYTES, LONGEST_LINE, NEWLINE, is_number, number_rows, split_row

# Bytes of the shortest row of three numbers, "0 0 0" and a line end. A declared count is checked
# against the bytes left in the file.
MIN_ROW_BYTES = 6
# Maximum scans in one file, for all readers: the archive numbers scans with 16 bits
# (schemas/FORMAT.md), and a scan without points takes only two bytes of text.
MAX_SCANS = 1 << 16


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
        columns: numbers in each row. With 4 or 7 columns the fourth is an intensity (x y z i, x y z
        i r g b); with 6 it is red. Colours are from 0 to 255.
        """
        super().__init__(path, format, index=index, declared_count=count, pose=pose)
        self._start, self._line, self._columns = start, line, columns
        self._zeros_are_no_return = zeros_are_no_return
        intensity, rgb = columns in (4, 7), columns in (6, 7)
        self.columns = frozenset([INTENSITY] * intensity + [RGB] * rgb)

    def _read(self, block_points: int) -> Iterator[ScanBlock]:
        count = self.declared_count or 0
        if not count:
            return
        seen = 0
        with self.path.open("rb") as file:
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
            rows[:, 3].astype(np.float32) if self._columns in (4, 7) else None,
            whole_bytes(rows[:, self._columns - 3 :]) if self.delivers(RGB) else None,
        )


def skip_rows(file: BufferedReader, path: Path, index: int, count: int, first_line: int) -> int:
    """Advance the file past `count` rows; return the first row's number of columns, 0 without rows.

    index: number of the scan, for messages.
    first_line: number of the line at the current file position.
    Raises ScanError where there are fewer lines, or where the first row is not a point.
    """
    if not count:
        return 0
    begin = file.tell()
    left = file.seek(0, 2) - begin
    file.seek(begin)
    if count * MIN_ROW_BYTES > left + 1:  # the last row may lack its line end
        raise _too_few(path, index, max(0, (left + 1) // MIN_ROW_BYTES), count)
    raw = file.readline(LONGEST_LINE)
    fields = split_row(raw.decode("latin-1"), None)
    if len(fields) not in (3, 4, 6, 7) or not all(map(is_number, fields)):
        raise scan_error(
            path,
            f"line {first_line} is {' '.join(fields)[:60]!r}",
            "x y z, optionally followed by an intensity, a colour or both",
            "check the program that wrote this file",
        )
    wanted, last = count - 1, NEWLINE
    while wanted:
        check_interrupt()
        data = file.read(CHUNK_BYTES)
        if not data:
            # A last row without a line end counts too.
            if wanted > 1 or last == NEWLINE:
                raise _too_few(path, index, count - wanted, count)
            break
        found = data.count(NEWLINE)
        if found >= wanted:
            ends = np.flatnonzero(np.frombuffer(data, np.uint8) == NEWLINE[0])
            file.seek(int(ends[wanted - 1]) + 1 - len(data), 1)
            break
        wanted, last = wanted - found, data[-1:]
    return len(fields)


def next_line(file: BufferedReader, line: int) -> tuple[str, int]:
    """Return the next non-blank line, stripped, and its number; "" at the end of the file.

    line: number of the line at the current file position.
    """
    while raw := file.readline(LONGEST_LINE):
        text = raw.decode("latin-1").strip()
        if text:
            return text, line
        line += 1
    return "", line


def _too_few(path: Path, index: int, found: int, declared: int) -> Exception:
    return scan_error(
        path,
        f"scan {index} ends after {found} rows at most",
        f"the {declared} declared before them",
        "fetch the file again, it may be truncated",
    )
