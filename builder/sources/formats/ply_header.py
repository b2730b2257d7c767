"""Header of a PLY file: its elements, their properties, and where the body begins. plyfile parses it."""

import io
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..common.colours import CLASSIFICATION, INTENSITY, RGB, find_columns
from ..common.scan import INTENSITY_NAMES, reader_library, scan_error
from ..common.text_rows import open_text_file

# Maximum bytes of a header. A real one has a few hundred bytes.
LONGEST_HEADER = 1 << 20


class PlyProperty(NamedTuple):
    """Property of an element. length: type of the number before a list; None: a single value."""

    name: str
    type: np.dtype[Any]
    length: np.dtype[Any] | None


class PlyElement(NamedTuple):
    """Element of a PLY file: so many records of some properties."""

    name: str
    records: int
    properties: tuple[PlyProperty, ...]

    @property
    def has_lists(self) -> bool:
        """Return whether records differ in size."""
        return any(each.length is not None for each in self.properties)

    @property
    def least_bytes(self) -> int:
        """Return the least size of a record of a binary file."""
        return sum((each.length or each.type).itemsize for each in self.properties)

    def record(self, lengths: Sequence[int] = ()) -> np.dtype[np.void]:
        """Return the layout of a record. lengths: of its lists, in order; see `length_name`."""
        fields: list[Any] = []
        left = iter(lengths)
        for name, kind, length in self.properties:
            if length is None:
                fields.append((name, kind))
            else:
                fields += [(length_name(name), length), (name, kind, (next(left, 0),))]
        return np.dtype(fields)


def length_name(name: str) -> str:
    """Return the name of the field with a list's length. It has a blank: no property has it."""
    return f"{name} length"


class PlyHeader(NamedTuple):
    """Description of a PLY file's vertices, from its header."""

    elements: tuple[PlyElement, ...]
    at: int  # number of the element of the vertices
    record: np.dtype[np.void]  # properties of a vertex up to its first list; all if it has none
    start: int  # byte offset of the body
    lines: int  # number of header lines
    ascii: bool
    intensity: str | None  # the property's name
    rgb: tuple[str, ...]  # names of red, green and blue, or ()
    classification: str | None

    @property
    def vertex(self) -> PlyElement:
        """Return the vertices."""
        return self.elements[self.at]

    @property
    def after(self) -> tuple[PlyElement, ...]:
        """Return the elements after the vertices."""
        return self.elements[self.at + 1 :]

    @property
    def before(self) -> tuple[PlyElement, ...]:
        """Return the elements before the vertices."""
        return self.elements[: self.at]

    @property
    def points(self) -> int:
        """Return the number of vertices."""
        return self.vertex.records

    @property
    def columns(self) -> frozenset[str]:
        """Return `Scan.columns`."""
        held = {INTENSITY: self.intensity, RGB: self.rgb, CLASSIFICATION: self.classification}
        return frozenset(name for name, here in held.items() if here)


def _header_lines(path: Path) -> tuple[list[str], int]:
    """Return the lines of a PLY file's header without comments, and the offset of its body.

    Raises ScanError.
    """
    lines: list[str] = []
    with open_text_file(path) as file:
        while not lines or lines[-1] != "end_header":
            raw = file.readline(LONGEST_HEADER)
            # Letters that are not ASCII occur in comments, and in names that nothing here reads.
            # Some writers leave blanks at the ends of lines ("ply "), or blank lines; plyfile
            # refuses both.
            line = raw.decode("ascii", "backslashreplace").strip()
            if (not lines and line != "ply") or not raw or file.tell() > LONGEST_HEADER:
                raise scan_error(
                    path,
                    f"line {len(lines) + 1} is {line[:60]!r}",
                    "a PLY header, from 'ply' to 'end_header'",
                    "check that this is a PLY file",
                )
            lines.append("comment" if not line or line.startswith(("comment", "obj_info")) else line)
        return lines, file.tell()


def read_ply_header(path: Path) -> PlyHeader:
    """Read and check the header. Raises ScanError."""
    lines, start = _header_lines(path)
    counts: list[int] = []
    for number, line in enumerate(lines):
        words = line.split()
        if len(words) == 3 and words[0] == "element" and words[2].isdecimal():
            counts.append(int(words[2]))
            # plyfile reads the declared number of records. Declare none: only the header is needed.
            lines[number] = f"element {words[1]} 0"
    plyfile = reader_library("plyfile", path)
    ply = plyfile.PlyData.read(io.BytesIO(("\n".join(lines) + "\n").encode("ascii")))
    order = "=" if ply.text else ply.byte_order
    elements = [
        PlyElement(element.name, count, tuple(_property(path, each, order) for each in element.properties))
        for element, count in zip(ply, counts, strict=True)
    ]
    at = next((k for k, element in enumerate(elements) if element.name == "vertex"), None)
    if at is None:
        found = ", ".join(element.name for element in elements) or "none"
        raise scan_error(
            path, f"elements: {found}", "an element 'vertex'", "check that this is a PLY of points"
        )
    vertex = elements[at]
    # Where rows of text have lists, only the columns before the first one have a fixed place.
    used = list(itertools.takewhile(lambda each: each.length is None, vertex.properties))
    known = tuple(used) if ply.text else tuple(each for each in vertex.properties if each.length is None)
    record = vertex._replace(properties=known).record()
    names = record.names or ()
    missing = [name for name in "xyz" if name not in names]
    if missing:
        raise scan_error(
            path,
            f"vertices without {', '.join(missing)}"
            + (" before their first list" if len(known) < len(vertex.properties) else ""),
            "properties x, y and z",
            "check the program that wrote this file",
        )
    intensity = next((name for name in names if name.lower() in INTENSITY_NAMES), None)
    colours, of_class = find_columns(names)
    return PlyHeader(
        tuple(elements), at, record, start, len(lines), ply.text, intensity,
        tuple(names[each] for each in colours), None if of_class is None else names[of_class],
    )  # fmt: skip


def _property(path: Path, given: Any, order: str) -> PlyProperty:
    """Return a property of plyfile with its types in this byte order. Raises ScanError."""
    if not hasattr(given, "len_dtype"):
        return PlyProperty(given.name, np.dtype(given.dtype(order)), None)
    count, kind = (np.dtype(each) for each in given.list_dtype(order))
    if count.kind not in "iu":
        raise scan_error(
            path,
            f"the list {given.name!r} with lengths of type {count.name}",
            "whole numbers",
            "check the program that wrote this file",
        )
    return PlyProperty(given.name, kind, count)
