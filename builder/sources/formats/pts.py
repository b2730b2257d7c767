"""PTS reader: blocks of a point count and as many rows of x y z, intensity and colour.

Each block is one scan. A file with this suffix but without a count before its rows is read as any
other text scan.
"""

from pathlib import Path

from ....schemas.archive.units import MAX_SCANS
from ..common.counted_rows import CountedRows, next_line, skip_rows
from ..common.scan import Scan, library_errors, scan_error
from ..common.text_rows import open_text_file
from .text import open_text


def open_pts(path: Path) -> list[Scan]:
    """Return the scans of a PTS file, in file order. Raises ScanError.

    Reads the whole file to find the blocks (counted_rows.py).
    """
    scans: list[Scan] = []
    with library_errors(path), open_text_file(path) as file:
        text, line = next_line(file, 1)
        if not _is_count(text):
            return open_text(path)
        while text:
            if not _is_count(text):
                raise scan_error(
                    path,
                    f"line {line} is {text[:60]!r} after the last of {scans[-1].declared_count} points",
                    "the end of the file, or the number of points that follow",
                    "correct the count before them",
                )
            if len(scans) == MAX_SCANS:
                raise scan_error(path, f"over {MAX_SCANS} blocks of points", "fewer", "split the file")
            count, start, line = int(text), file.tell(), line + 1
            columns, after = skip_rows(file, path, len(scans), count, line)
            scans.append(CountedRows(path, "pts", len(scans), count, start=start, line=line, columns=columns))
            text, line = next_line(file, after)
    return scans


def _is_count(text: str) -> bool:
    """Return whether a line is a point count of at most 18 digits; Python cannot convert thousands."""
    return text.isdecimal() and len(text) <= 18
