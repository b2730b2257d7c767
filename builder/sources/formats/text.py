"""Text scans, one point a line: XYZ, TXT, CSV, and PTS without counts.

The first lines of the file determine the layout:
- The file begins with optional comments ("#", "//" or ";" first) and blank lines, then an optional
  header row of names. Rows of numbers follow, separated by blanks, commas or semicolons
  (text_rows.py says what is skipped, and which numbers are read).
- Where semicolons or blanks separate the numbers, they may have decimal commas.
- A line that is one whole number, before the rows, is the count of points. It is checked against
  the rows: fewer rows mean a truncated file, more rows a broken one.
- x, y and z are the columns with these names in the header (a row, or a comment with as many
  names as there are columns), else the first three.
- The unit is that which stands behind the names x, y and z of the header: "x_mm", "x [mm]".
- The intensity is the column that the header names intensity or scalar_intensity. A PTS file
  needs no header, see `pts_columns`. In any other file without a header a fourth column may mean
  anything and is ignored.
- Colour and class are the columns that the header names red, green, blue (or r, g, b) and
  classification (or class, label).
"""

import csv
import re
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from ..common.colours import CLASSIFICATION, INTENSITY, RGB, find_columns, whole_bytes
from ..common.counted_rows import pts_columns
from ..common.scan import INTENSITY_NAMES, Scan, ScanBlock, library_errors, scan_error
from ..common.text_rows import LONGEST_LINE, is_number, number_rows, open_text_file, split_row
from ..common.units import METRES

# Maximum lines before the first row of numbers; a file with a longer preamble is not a point list.
LONGEST_PREAMBLE = 1000
# First line of a CSV file that tells Excel the delimiter.
_SEPARATOR_LINE = re.compile(r"sep=.?", re.IGNORECASE)

# Name of a column with its unit: "x_mm", "x [mm]", "x (mm)".
_AXIS_UNIT = re.compile(r"([xyz]) ?[_ \[(] ?([a-z-]+) ?[\])]?")


class _Layout(NamedTuple):
    """Positions of the numbers in a text scan."""

    start: int  # byte offset of the first row
    line: int  # its line number
    columns: int
    delimiter: str | None
    xyz: tuple[int, int, int]  # column numbers
    intensity: int | None
    rgb: tuple[int, ...]  # column numbers, or ()
    classification: int | None
    points: int | None  # the count that the first line declares
    units: str = "m"  # that the header states


class TextScan(Scan):
    """Points of one text file."""

    def __init__(self, path: Path, layout: _Layout | None) -> None:
        """Create the scan; layout is None for a file without rows."""
        super().__init__(path, "text", declared_count=layout.points if layout else 0)
        self._layout = layout
        if layout is not None and layout.units != "m":
            self.units, self.units_note = layout.units, f"coordinates in {layout.units}, as its header states"
        if layout is not None:
            held = {
                INTENSITY: layout.intensity is not None,
                RGB: bool(layout.rgb),
                CLASSIFICATION: layout.classification is not None,
            }
            self.columns = frozenset(name for name, here in held.items() if here)

    def _read(self, block_points: int) -> Iterator[ScanBlock]:
        if self._layout is None:
            return
        layout = self._layout
        seen = 0
        with open_text_file(self.path) as file:
            file.seek(layout.start)
            for rows in number_rows(
                file, self.path, columns=layout.columns, delimiter=layout.delimiter, first_line=layout.line
            ):
                seen += len(rows)
                for start in range(0, len(rows), block_points):
                    part = rows[start : start + block_points]
                    intensity = None
                    if layout.intensity is not None:
                        intensity = part[:, layout.intensity].astype(np.float32)
                    rgb = part[:, layout.rgb].astype(np.float32) if self.delivers(RGB) else None
                    classes = None
                    if self.delivers(CLASSIFICATION):
                        classes = whole_bytes(part[:, layout.classification])
                    yield ScanBlock(np.ascontiguousarray(part[:, layout.xyz]), intensity, rgb, classes)
        if layout.points is not None and seen != layout.points:
            raise scan_error(
                self.path,
                f"{seen} points",
                f"the {layout.points} its first line declares",
                "fetch the file again, it may be truncated"
                if seen < layout.points
                else "correct its first line",
            )


def open_text(path: Path) -> list[Scan]:
    """Return the one scan of a text file; reads its first lines only. Raises ScanError."""
    with library_errors(path), open_text_file(path) as file:
        return [TextScan(path, _find_layout(file, path))]


def _find_layout(file: BinaryIO, path: Path) -> _Layout | None:
    """Read the file up to the first row of numbers; None where there is no such row."""
    names: tuple[int, str] | None = None  # the header row: its line number and text
    comment = ""  # the last comment, which may name the columns
    count: int | None = None
    for line in range(1, LONGEST_PREAMBLE + 1):
        start = file.tell()
        raw = file.readline(LONGEST_LINE)
        if not raw:
            if names or count:
                raise scan_error(
                    path,
                    f"no rows of numbers after {(names[1] if names else str(count))[:60]!r}",
                    "one point a line",
                    "check that its numbers have decimal points, and that the file is complete",
                )
            return None
        text = raw.decode("utf-8", "replace").strip()
        # Several semicolons separate names, of which the first may be empty.
        is_one = text.startswith(";") and text.count(";") == 1 and not split_row(raw, None)
        if text.startswith(("#", "//")) or is_one:
            comment = text.lstrip("#/; \t")
            continue
        if not text or _SEPARATOR_LINE.fullmatch(text):
            continue
        delimiter = _delimiter(raw)
        fields = split_row(raw, delimiter)
        if count is None and len(fields) == 1 and fields[0].isdecimal():
            count = int(fields[0])
        elif any(map(is_number, fields)):
            return _layout_of(
                path,
                text,
                fields,
                delimiter,
                _Layout(start, line, 0, None, (0, 1, 2), None, (), None, count),
                names,
                comment,
            )
        elif names is None:
            names = (line, text)
        else:
            raise scan_error(path, f"line {line} is {text[:60]!r}", "numbers", "keep one header row only")
    raise scan_error(
        path,
        f"no row of numbers in {LONGEST_PREAMBLE} lines",
        "one point a line",
        "check that this is a scan",
    )


def _layout_of(
    path: Path,
    text: str,
    fields: list[str],
    delimiter: str | None,
    found: _Layout,
    names: tuple[int, str] | None,
    comment: str,
) -> _Layout:
    """Complete the layout from the first row of numbers and the header. Raises ScanError."""
    if len(fields) < 3 or not all(map(is_number, fields)):
        raise scan_error(
            path,
            f"line {found.line} is {text[:60]!r}",
            "at least three numbers (x, y, z), and nothing else",
            "check that this is a point list, one point a line; remove columns that are no numbers",
        )
    layout = found._replace(columns=len(fields), delimiter=delimiter)
    called, units = _without_units(_split_names(names[1] if names else comment))
    if names is None and (len(called) != len(fields) or not {"x", "y", "z"} <= set(called)):
        if path.suffix.lower() != ".pts":
            return layout
        intensity, rgb = pts_columns(len(fields))
        return layout._replace(intensity=intensity, rgb=rgb)
    if len(called) != len(fields) or any(called.count(axis) != 1 for axis in "xyz"):
        line, header = names or (0, comment)
        raise scan_error(
            path,
            f"line {line} names the columns {header[:60]!r} for rows of {len(fields)} fields",
            "a name for each column, with x, y and z once each",
            "correct that line",
        )
    intensity = next((called.index(name) for name in INTENSITY_NAMES if name in called), None)
    rgb, classification = find_columns(called)
    return layout._replace(
        xyz=(called.index("x"), called.index("y"), called.index("z")),
        intensity=intensity,
        rgb=rgb,
        classification=classification,
        units=units,
    )


def _without_units(names: list[str]) -> tuple[list[str], str]:
    """Return the names of columns, x, y and z without the unit behind them, and these units, else "m".

    A name that is followed by anything else, or by different units of x and y, stays as it is.
    """
    found = {match[1]: match[2] for match in map(_AXIS_UNIT.fullmatch, names) if match}
    plane, height = found.get("x", ""), found.get("z", "")
    if found.keys() != set("xyz") or found["y"] != plane or not {plane, height} <= METRES.keys():
        return names, "m"
    short = [match[1] if (match := _AXIS_UNIT.fullmatch(name)) else name for name in names]
    return short, plane if plane == height else f"{plane}+{height}"


def _split_names(text: str) -> list[str]:
    """Return the names of a header row, in lower case, without quotes."""
    delimiter = next((each for each in ";,\t" if each in text), None)
    names = (
        next(csv.reader([text], delimiter=delimiter, skipinitialspace=True)) if delimiter else text.split()
    )
    while len(names) > 1 and not names[-1].strip():
        names.pop()  # a delimiter at the line's end
    return [name.strip().strip("\"'").lower() for name in names]


def _delimiter(line: bytes) -> str | None:
    """Return what separates the fields of a line: ";" or ",", or None for blanks."""
    if b";" in line:
        return ";"
    if b"," not in line:
        return None
    # Numbers with decimal commas, separated by blanks, are no numbers if separated by commas.
    fields = split_row(line, None)
    if len(fields) > 2 and all(map(is_number, fields)) and not all(map(is_number, split_row(line, ","))):
        return None
    return ","
