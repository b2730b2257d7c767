"""OBJ and STL readers: the vertices of meshes as points, in file order, duplicates included.

The vertices are read here, in blocks. trimesh, which surface_samples.py uses for sampling, holds the whole
mesh; its OBJ loader omits vertices that no face uses and splits vertices that have two texture
coordinates.
"""

import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np

from ....schemas.runtime.text_encoding import UTF8_MARK, is_utf16
from ..common.records import check_end, read_records
from ..common.scan import (
    Scan,
    ScanBlock,
    SeekableScan,
    library_errors,
    scan_error,
)
from ..common.text_rows import keyword_rows, open_text_file

# A binary STL: 80 bytes of anything, the number of triangles (uint32), then a record each.
STL_HEADER_BYTES = 84
SOLID = re.compile(rb"(?:\xff\xfe|\xfe\xff)?\s*solid", re.IGNORECASE)
_FACET = re.compile(rb"facet|endsolid", re.IGNORECASE)
STL_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


class VertexLines(Scan):
    """Vertices of an OBJ or ASCII STL file: three numbers after a keyword."""

    def __init__(self, path: Path, keyword: str, of_triangles: bool = False) -> None:
        super().__init__(path, "mesh")
        self._keyword, self._of_triangles = keyword, of_triangles

    def _read(self, block_points: int) -> Iterator[ScanBlock]:
        seen = 0
        with open_text_file(self.path) as file:
            for rows in keyword_rows(file, self.path, self._keyword):
                seen += len(rows)
                for start in range(0, len(rows), block_points):
                    yield ScanBlock(rows[start : start + block_points], None)
        if self._of_triangles and seen % 3:
            raise _truncated_stl(self.path, f"{seen} corners", "three a triangle")


class BinaryStl(SeekableScan):
    """Corners of the triangles of a binary STL."""

    def __init__(self, path: Path, triangles: int) -> None:
        super().__init__(path, "mesh", declared_count=3 * triangles)

    def _read_between(self, block_points: int, start: int, stop: int) -> Iterator[ScanBlock]:
        first, past = start // 3, -(-stop // 3)
        with self.path.open("rb") as file:
            file.seek(STL_HEADER_BYTES + first * STL_TRIANGLE.itemsize)
            at = 3 * first
            for record in read_records(
                file, self.path, STL_TRIANGLE, past - first, block_points // 3, "triangles"
            ):
                corners = record["corners"].reshape(-1, 3).astype(np.float64)
                end = at + len(corners)
                corners = corners[max(0, start - at) : len(corners) - max(0, end - stop)]
                at = end
                for k in range(0, len(corners), block_points):
                    yield ScanBlock(corners[k : k + block_points], None)


def open_obj(path: Path) -> list[Scan]:
    """Return the one scan of an OBJ file, its vertices. Raises ScanError."""
    return [VertexLines(path, "v")]


def open_stl(path: Path) -> list[Scan]:
    """Return the one scan of an STL file, the corners of its triangles, binary or ASCII.

    Reads the first and last bytes of the file only. Raises ScanError.
    """
    size = path.stat().st_size
    with library_errors(path), path.open("rb") as file:
        start = file.read(1024)
        (triangles,) = struct.unpack("<I", start[80:STL_HEADER_BYTES].ljust(4, b"\0"))
        is_binary = size == STL_HEADER_BYTES + triangles * STL_TRIANGLE.itemsize
        # Many binary files begin with "solid" too, some with "facet" behind it: their first 80
        # bytes may hold anything.
        letters = start.replace(b"\0", b"") if is_utf16(start) else start.removeprefix(UTF8_MARK)
        if not is_binary and SOLID.match(letters) and _FACET.search(letters):
            with open_text_file(path) as text:
                _check_ascii_end(text, path)
            return [VertexLines(path, "vertex", of_triangles=True)]
    if len(start) < STL_HEADER_BYTES:
        raise _truncated_stl(path, f"{size} bytes", f"a header of {STL_HEADER_BYTES}")
    held = (size - STL_HEADER_BYTES) // STL_TRIANGLE.itemsize
    if triangles > held:
        raise _truncated_stl(path, f"{held} triangles at most", f"the {triangles} its header declares")
    with library_errors(path), path.open("rb") as file:
        file.seek(STL_HEADER_BYTES + triangles * STL_TRIANGLE.itemsize)
        check_end(file, path, "triangles")
    return [BinaryStl(path, triangles)]


def _check_ascii_end(file: BinaryIO, path: Path) -> None:
    """Check that an ASCII STL ends with the line that ends its last solid. Raises ScanError."""
    file.seek(max(0, file.seek(0, 2) - 1024))
    lines = file.read().strip().splitlines()
    if not lines or not lines[-1].lstrip().lower().startswith(b"endsolid"):
        raise _truncated_stl(path, f"a last line {lines[-1][:60] if lines else b''!r}", "'endsolid'")


def _truncated_stl(path: Path, found: str, expected: str) -> Exception:
    return scan_error(path, found, expected, "fetch the file again, it is truncated or no STL")
