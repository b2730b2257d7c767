"""PTX reader: scans of a terrestrial scanner in text, one after the other, each with its pose.

A scan begins with two numbers, the columns and rows of its grid. Four lines give the scanner's
position and axes; the matrix repeats them. Four lines of four numbers give that matrix, for points
as rows: x' = (x y z 1) M. Then follows one line per grid cell, column by column: x y z, intensity
(0 to 1) and optionally a colour. A direction without a return is 0 0 0.
"""

from io import BufferedReader
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ....schemas.archive.units import MAX_SCANS
from ..common.counted_rows import CountedRows, next_line, skip_rows
from ..common.scan import Scan, library_errors, scan_error, zero_rotation_note
from ..common.text_rows import LONGEST_LINE, is_number, open_text_file

# Numbers in each header line after the two lines of the grid's size.
HEAD = (3, 3, 3, 3, 4, 4, 4, 4)


def open_ptx(path: Path) -> list[Scan]:
    """Return the scans of a PTX file, in file order. Raises ScanError.

    Reads the whole file to find the scans (counted_rows.py).
    """
    scans: list[Scan] = []
    with library_errors(path), open_text_file(path) as file:
        text, line = next_line(file, 1)
        while text:
            if len(scans) == MAX_SCANS:
                raise scan_error(path, f"over {MAX_SCANS} scans", "fewer", "split the file")
            columns = _size(path, line, text)
            rows = _size(path, line + 1, file.readline(LONGEST_LINE).decode("latin-1").strip())
            pose, notes = _pose(file, path, len(scans), line + 2)
            line += 2 + len(HEAD)
            start, count = file.tell(), columns * rows
            fields, after = skip_rows(file, path, len(scans), count, line)
            scans.append(
                CountedRows(
                    path, "ptx", len(scans), count, start=start, line=line, columns=fields, pose=pose,
                    zeros_are_no_return=True,
                )
            )  # fmt: skip
            scans[-1].notes = notes
            text, line = next_line(file, after)
    if not scans:
        raise scan_error(path, "blank lines", "the header of a scan", "fetch the file again")
    return scans


def _size(path: Path, line: int, text: str) -> int:
    """Return the column or row count of a grid. Raises ScanError."""
    if not text.isdecimal() or len(text) > 9:
        raise scan_error(
            path,
            f"line {line} is {text[:60]!r}",
            "the columns, then the rows, of a scan's grid",
            "check that this is a PTX file, and that the numbers before this line fit",
        )
    return int(text)


def _pose(
    file: BufferedReader, path: Path, index: int, line: int
) -> tuple[NDArray[np.float64], tuple[str, ...]]:
    """Read the pose (4, 4) of a scan's header; return it and `Scan.notes`. Raises ScanError.

    index: number of the scan.
    line: number of the first line after the grid's size, at the current file position.
    The matrix need not be rigid: files exist that stretch an axis, and the matrix determines where
    the points are. Rows of zeros are no rotation, unless the scanner's axes or position say
    another.
    """
    found: list[list[float]] = []
    for number, expected in enumerate(HEAD, line):
        text = file.readline(LONGEST_LINE).decode("latin-1").strip()
        fields = text.split()
        if len(fields) != expected or not all(map(is_number, fields)):
            raise scan_error(
                path,
                f"line {number} is {text[:60]!r}",
                f"{expected} numbers of a scanner's pose",
                "check that this is a PTX file, and that it is complete",
            )
        found.append([float(field) for field in fields])
    pose = np.array(found[4:]).T
    notes = zero_rotation_note(path, index, pose[:3, :3].ravel().tolist())
    position, axes = np.array(found[0]), np.array(found[1:4])
    if notes and np.array_equal(position, pose[:3, 3]) and not (axes - np.eye(3) * axes.any()).any():
        pose[:3, :3], pose[3] = np.eye(3), [0, 0, 0, 1]
    if not np.isfinite(pose).all() or pose[3].tolist() != [0, 0, 0, 1] or np.linalg.matrix_rank(pose) < 4:
        raise scan_error(
            path,
            f"lines {line + 4} to {line + 7} are {found[4:]}",
            "an invertible matrix with last column 0 0 0 1",
            "register the scan again",
        )
    return pose, notes
