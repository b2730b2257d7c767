"""Blocks of rows in text whose number is declared before them: what PTX and PTS files are made of.

Where the second block of a file begins is not written anywhere, so opening such a file reads it through once,
counting line ends and holding nothing (about 1 GB a second).
"""

from collections.abc import Iterator
from io import BufferedReader
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...schemas.interrupts import check
from .rows import CHUNK_BYTES, LONGEST_LINE, NEWLINE, is_number, number_rows, split_row
from .scan import NO_RETURN, Block, Scan, apply_pose, scan_error

# The shortest row of three numbers, "0 0 0" and a line end: a count is held against what is left of the file.
LEAST_ROW_BYTES = 6
# Of all readers: the archive numbers scans by 16 bits (schemas/FORMAT.md), and a scan of no points takes two bytes.
MOST_SCANS = 1 << 16


class CountedRows(Scan):
    """One block of rows: x, y, z, and perhaps an intensity and colours."""

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
        """start, line: byte and line number of the first row.  columns: of each row; with 4 or 7 of them the fourth
        is an intensity (x y z i, x y z i r g b), with 6 it is red."""
        super().__init__(path, format, index=index, declared_count=count, pose=pose)
        self._start, self._line, self._columns = start, line, columns
        self._zeros_are_no_return = zeros_are_no_return

    def _read(self, block_points: int) -> Iterator[Block]:
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

    def _block(self, rows: NDArray[np.float64]) -> Block:
        if self._zeros_are_no_return:
            hit = (rows[:, :3] != 0).any(axis=1)
            lost = len(rows) - int(np.count_nonzero(hit))
            if lost:
                self.dropped[NO_RETURN] = self.dropped.get(NO_RETURN, 0) + lost
                rows = rows[hit]
        xyz = apply_pose(self.pose, np.ascontiguousarray(rows[:, :3]))
        return Block(xyz, rows[:, 3].astype(np.float32) if self._columns in (4, 7) else None)


def skip_rows(file: BufferedReader, path: Path, index: int, count: int, first_line: int) -> int:
    """Go past `count` rows from where a file stands; returns how many columns the first of them has, 0 of none.

    index: of the scan, for messages.  first_line: the number of the line the file stands at.
    Raises ScanError where there are fewer lines, or the first is no point.
    """
    if not count:
        return 0
    begin = file.tell()
    left = file.seek(0, 2) - begin
    file.seek(begin)
    if count * LEAST_ROW_BYTES > left + 1:  # the last row may lack its line end
        raise _too_few(path, index, max(0, (left + 1) // LEAST_ROW_BYTES), count)
    raw = file.readline(LONGEST_LINE)
    fields = split_row(raw.decode("latin-1"), None)
    if len(fields) not in (3, 4, 6, 7) or not all(map(is_number, fields)):
        raise scan_error(
            path,
            f"line {first_line} is {' '.join(fields)[:60]!r}",
            "x y z, with an intensity, a colour or both behind them",
            "check what wrote this file",
        )
    wanted, last = count - 1, NEWLINE
    while wanted:
        check()
        data = file.read(CHUNK_BYTES)
        if not data:
            # A last row without a line end is one too.
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
    """The next line that is not blank, without blanks around it, and its number; "" at the end of the file.

    line: the number of the line the file stands at.
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
