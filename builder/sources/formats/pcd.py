"""PCD reader, the format of the Point Cloud Library: ASCII, binary or compressed.

Only the fields x, y, z and intensity are read, and colour (rgb or rgba) and class (label,
classification) if they are wanted. A colour is one number, 0xRRGGBB in an integer or in the bits of
a float. Organised clouds store directions without a return as NaN points in their grid; these are
dropped as NO_RETURN.

VIEWPOINT is applied as the scan's pose, as the library's own viewer does.

Missing lines of the header mean what they mean in that library: COLUMNS is an old name of FIELDS,
COUNT and HEIGHT are 1, WIDTH times HEIGHT is POINTS, and in text TYPE is F. Without WIDTH and
POINTS the rest of the file is points.
"""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.colours import CLASS_NAMES, CLASSIFICATION, INTENSITY, RGB, whole_bytes
from ..common.records import check_end, read_records
from ..common.scan import (
    BLOCK_BYTES,
    INTENSITY_NAMES,
    NO_RETURN,
    Scan,
    ScanBlock,
    SeekableScan,
    apply_pose,
    damaged_error,
    library_errors,
    quaternion_pose,
    scan_error,
    zero_rotation_note,
)
from ..common.text_rows import is_number, number_rows, open_text_file

# Maximum bytes of a header. A real one has a few hundred bytes; a file without a DATA line in this
# range is not a PCD file.
LONGEST_HEADER = 1 << 16
KINDS = ("ascii", "binary", "binary_compressed")
TYPES = {("F", 4): "<f4", ("F", 8): "<f8", **{(t, n): f"<{t.lower()}{n}" for t in "IU" for n in (1, 2, 4, 8)}}
# Column of a scan -> names of its field; and the types in which a field packs a colour.
COLUMN_NAMES = {INTENSITY: INTENSITY_NAMES, RGB: ("rgb", "rgba"), CLASSIFICATION: CLASS_NAMES}
PACKED = (("F", 4), ("U", 4), ("I", 4))
# Maximum decompressed bytes per compressed byte: a reference of three bytes stands for at most 264
# [LZF].
MAX_EXPANSION = 88


class _Field(NamedTuple):
    """One field to read.

    offset: bytes from the start of the record.
    column: number of its first value in a text row.
    is_packed: whether it is a colour in one number.
    """

    offset: int
    column: int
    type: str
    is_packed: bool = False


class _Header(NamedTuple):
    """Header of a PCD file. fields: of x, y, z and the columns of `Scan.columns`, by name."""

    fields: dict[str, _Field]
    record_bytes: int
    columns: int
    points: int  # 0 if it is not declared: the rest of a text is points
    is_counted: bool
    pose: NDArray[np.float64]
    notes: tuple[str, ...]
    kind: str
    start: int  # byte offset of the data
    lines: int  # number of header lines

    @property
    def column_names(self) -> frozenset[str]:
        """Return `Scan.columns`."""
        return frozenset(self.fields) - set("xyz")


def _read_fields(scan: Scan, header: _Header) -> dict[str, _Field]:
    """Return the fields that are read."""
    return {
        n: field for n, field in header.fields.items() if n in ("x", "y", "z", INTENSITY) or scan.delivers(n)
    }


def _block(scan: Scan, columns: dict[str, NDArray[Any]]) -> ScanBlock:
    """Build a block from the columns that are read, (n,) each, by name; drops NaN points."""
    xyz = np.stack([columns[axis] for axis in "xyz"], axis=1, dtype=np.float64, casting="unsafe")
    block = ScanBlock(
        xyz,
        columns[INTENSITY].astype(np.float32) if INTENSITY in columns else None,
        _unpack_rgb(columns[RGB]) if RGB in columns else None,
        whole_bytes(columns[CLASSIFICATION]) if CLASSIFICATION in columns else None,
    )
    hit = np.asarray(~np.isnan(xyz).any(axis=1))
    lost = len(hit) - int(np.count_nonzero(hit))
    if lost:
        scan.dropped[NO_RETURN] = scan.dropped.get(NO_RETURN, 0) + lost
        block = block.taken(hit)
    return block._replace(xyz=apply_pose(scan.pose, block.xyz))


def _unpack_rgb(packed: NDArray[Any]) -> NDArray[np.uint8]:
    """Return colours (n, 3) from numbers 0xAARRGGBB (n,), integers or the bits of float32."""
    bits = packed.view(np.uint32) if packed.dtype.kind == "f" else packed.astype(np.uint32)
    return np.stack([bits >> np.uint32(shift) & np.uint32(255) for shift in (16, 8, 0)], axis=1).astype(
        np.uint8
    )


class BinaryPcd(SeekableScan):
    """Points of a binary PCD file, stored record by record."""

    def __init__(self, path: Path, header: _Header) -> None:
        super().__init__(path, "pcd", declared_count=header.points, pose=header.pose)
        self._header, self.columns = header, header.column_names

    def _read_between(self, block_points: int, start: int, stop: int) -> Iterator[ScanBlock]:
        header, fields = self._header, _read_fields(self, self._header)
        record = np.dtype(
            {
                "names": list(fields),
                "formats": [field.type for field in fields.values()],
                "offsets": [field.offset for field in fields.values()],
                "itemsize": header.record_bytes,
            }
        )
        with self.path.open("rb") as file:
            file.seek(header.start + start * header.record_bytes)
            for records in read_records(file, self.path, record, stop - start, block_points, "points"):
                yield _block(self, {name: np.ascontiguousarray(records[name]) for name in fields})


class CompressedPcd(Scan):
    """Points of a compressed PCD file: one stream with the columns one after the other."""

    def __init__(self, path: Path, header: _Header, past: int) -> None:
        """Create the scan; past is the offset of the first byte after the compressed data."""
        super().__init__(path, "pcd", declared_count=header.points, pose=header.pose)
        self._header, self._past, self.columns = header, past, header.column_names

    def _read(self, block_points: int) -> Iterator[ScanBlock]:
        from .pcd_lzf import LzfStream  # loads the kernels

        header = self._header
        with self.path.open("rb") as file:
            # Decode once to find where the last column begins, then decode all columns side by
            # side, each from its start.
            fields = _read_fields(self, header)
            streams: dict[int, LzfStream] = {}
            stream, at = LzfStream(self.path, header.start + 8, self._past), 0
            for field in sorted(fields.values()):
                # A field of several values stores the values of one point together: read the first
                # of each.
                stream.skip(file, field.offset * header.points - at)
                at = field.offset * header.points
                streams[field.offset] = stream.fork()
            sizes = {name: np.dtype(field.type).itemsize for name, field in fields.items()}
            for start in range(0, header.points, block_points):
                count = min(block_points, header.points - start)
                yield _block(
                    self,
                    {
                        name: streams[field.offset].read(file, count * sizes[name]).view(field.type)
                        for name, field in fields.items()
                    },
                )


def _number(rows: NDArray[np.float64], field: _Field) -> NDArray[Any]:
    """Return one field of rows of text; a packed colour as float32 or an integer."""
    values = rows[:, field.column]
    if not field.is_packed:
        return values
    if field.type == "<f4":
        return np.ascontiguousarray(values, np.float32)
    return np.clip(np.nan_to_num(values), -(1 << 31), (1 << 32) - 1).astype(np.int64)


class AsciiPcd(Scan):
    """Points of an ASCII PCD file."""

    def __init__(self, path: Path, header: _Header) -> None:
        count = header.points if header.is_counted else None
        super().__init__(path, "pcd", declared_count=count, pose=header.pose)
        self._header, self.columns = header, header.column_names

    def _read(self, block_points: int) -> Iterator[ScanBlock]:
        header, seen = self._header, 0
        fields = _read_fields(self, header)
        with open_text_file(self.path) as file:
            file.seek(header.start)
            for rows in number_rows(
                file, self.path, columns=header.columns, delimiter=None, first_line=header.lines + 1,
                limit=self.declared_count, behind=0,
            ):  # fmt: skip
                seen += len(rows)
                for start in range(0, len(rows), block_points):
                    part = rows[start : start + block_points]
                    yield _block(self, {name: _number(part, field) for name, field in fields.items()})
        if seen < header.points:
            raise damaged_error(self.path, f"{seen} points", f"the {header.points} its header declares")


def open_pcd(path: Path) -> list[Scan]:
    """Return the one scan of a PCD file; reads its header only. Raises ScanError."""
    with library_errors(path):
        header = _read_header(path)
        left = path.stat().st_size - header.start
        if header.kind == "binary_compressed":
            return [_noted(CompressedPcd(path, header, _compressed_end(path, header, left)), header)]
        least = 2 * header.columns if header.kind == "ascii" else header.record_bytes
        # The last row of a text may lack its line end.
        if header.points * least > left + (header.kind == "ascii"):
            raise damaged_error(path, f"{left // least} points at most", f"the {header.points} declared")
        if header.kind == "binary":
            with path.open("rb") as file:
                file.seek(header.start + header.points * header.record_bytes)
                check_end(file, path, "points")
        return [_noted((AsciiPcd if header.kind == "ascii" else BinaryPcd)(path, header), header)]


def _noted(scan: Scan, header: _Header) -> Scan:
    scan.notes = header.notes
    return scan


def _compressed_end(path: Path, header: _Header, left: int) -> int:
    """Return the offset of the first byte after the compressed data; checks both of its sizes."""
    with path.open("rb") as file:
        file.seek(header.start)
        packed, unpacked = struct.unpack("<II", file.read(8).ljust(8, b"\0"))
    if 8 + packed > left:
        raise damaged_error(path, f"{left} bytes of data", f"{8 + packed}")
    if unpacked != header.points * header.record_bytes or unpacked > packed * MAX_EXPANSION:
        raise damaged_error(
            path,
            f"{unpacked} bytes in {packed} compressed",
            f"the {header.points * header.record_bytes} of {header.points} points",
        )
    return header.start + 8 + int(packed)


def _read_header(path: Path) -> _Header:
    """Read and check the header. Raises ScanError."""
    entries: dict[str, list[str]] = {}
    lines = 0
    with open_text_file(path) as file:
        while "DATA" not in entries:
            raw = file.readline(LONGEST_HEADER)
            lines += 1
            words = raw.decode("latin-1").split()
            if not raw or file.tell() > LONGEST_HEADER:
                raise scan_error(
                    path,
                    f"{lines - 1} lines and no DATA",
                    "the header of a PCD file",
                    "check that this is one",
                )
            if words and not words[0].startswith("#"):
                entries[words[0].upper()] = words[1:]
        start = file.tell()

    def refuse(name: str, expected: str) -> Exception:
        found = " ".join([name, *entries.get(name, ["missing"])])[:80]
        return scan_error(
            path, found, expected, "check the program that wrote this file, and that it is complete"
        )

    def numbers(name: str, count: int, default: list[str] | None = None) -> list[int]:
        words = entries.get(name, default) or []
        if len(words) != count or not all(w.isdecimal() and len(w) <= 15 for w in words):
            raise refuse(name, f"{count} whole numbers")
        return [int(word) for word in words]

    kind = " ".join(entries["DATA"]).lower()
    if kind not in KINDS:
        raise refuse("DATA", " or ".join(KINDS))
    names = [name.lower() for name in entries.get("FIELDS", entries.get("COLUMNS", []))]
    # A record of binary data has no size without them.
    is_text = kind == "ascii"
    sizes = numbers("SIZE", len(names), ["4"] * len(names) if is_text else None)
    counts = numbers("COUNT", len(names), ["1"] * len(names))
    types = [t.upper() for t in entries.get("TYPE", ["F"] * len(names) if is_text else [])]
    if len(types) != len(names) or any(k not in TYPES for k in zip(types, sizes, strict=True)):
        raise refuse("TYPE", "F of 4 or 8 bytes, I or U of 1, 2, 4 or 8, for each field")
    if any(names.count(axis) != 1 for axis in "xyz"):
        raise refuse("FIELDS", "x, y and z once each")
    if any(counts[names.index(axis)] != 1 for axis in "xyz"):
        raise refuse("COUNT", "1 of x, y and z")
    view = entries.get("VIEWPOINT", ["0", "0", "0", "1", "0", "0", "0"])
    if len(view) != 7 or not all(map(is_number, view)):
        raise refuse("VIEWPOINT", "seven numbers")
    place = [float(word) for word in view]
    record_bytes = sum(size * count for size, count in zip(sizes, counts, strict=True))
    if not 0 < record_bytes <= BLOCK_BYTES:
        raise refuse("COUNT", f"records of at most {BLOCK_BYTES} bytes")
    points, is_counted = 0, "POINTS" in entries or "WIDTH" in entries
    if is_counted:
        (points,) = numbers("POINTS", 1, None if "POINTS" in entries else ["0"])
        (width,), (height,) = numbers("WIDTH", 1, [str(points)]), numbers("HEIGHT", 1, ["1"])
        grid = width * height if "WIDTH" in entries else points
        if points != grid and "POINTS" in entries:
            raise refuse("POINTS", f"WIDTH times HEIGHT, {grid}")
        points = grid
    elif not is_text:
        points, rest = divmod(path.stat().st_size - start, record_bytes)
        if rest or kind == "binary_compressed":
            raise refuse("POINTS", "the number of points")
    fields: dict[str, _Field] = {}
    for column, called in {**{axis: (axis,) for axis in "xyz"}, **COLUMN_NAMES}.items():
        for name in called:
            if names.count(name) != 1 or counts[k := names.index(name)] != 1 or column in fields:
                continue
            if column == RGB and (types[k], sizes[k]) not in PACKED:
                continue
            offset = sum(size * count for size, count in zip(sizes[:k], counts[:k], strict=True))
            fields[column] = _Field(offset, sum(counts[:k]), TYPES[types[k], sizes[k]], column == RGB)
    pose, notes = quaternion_pose(path, 0, place[3:], place[:3]), zero_rotation_note(path, 0, place[3:])
    return _Header(fields, record_bytes, sum(counts), points, is_counted, pose, notes, kind, start, lines)
