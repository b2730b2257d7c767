"""Where the bytes of each point lie in the valid scans of broken_scans.py, and damage that keeps track of them.

A point is intact if its own bytes are, and those that place it: scale, offset and pose. The bytes of
a point in text are its line and both line ends; in LZF and in LAZ up to point format 5, the stream
up to it; in other LAZ, its chunk; in E57, all pages of its scan.
"""

import io
import json
import re
import struct
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import laspy
import lazrs
import numpy as np
from broken_scans import EXTREMES, PAGE, with_checksums
from solidcloud.builder.sources.placed_scan import place_scan
from solidcloud.builder.sources.scan_files import open_scans

Span = tuple[int, int]


class Field(NamedTuple):
    """Number in a header. form: of struct, or "" for text. fill: whether its length must stay."""

    span: Span
    form: str = ""
    fill: bytes = b""


class Whole(NamedTuple):
    """Valid file.

    points: (n, 3) world [m].  own: spans of bytes of each point.  placing: spans that place points.
    header: span of the header.  counts: fields that count points, each with the ones that say the
    same.  boxes: fields of bounds.
    """

    name: str
    data: bytes
    points: np.ndarray
    own: list[list[Span]]
    placing: list[Span]
    header: Span
    counts: list[list[Field]]
    boxes: list[Field]


def las_boxes(points: np.ndarray) -> list[float]:
    """Return the bounds of points (n, 3) in the order of a LAS header."""
    low, high = points.min(axis=0).tolist(), points.max(axis=0).tolist()
    return [value for pair in zip(high, low, strict=True) for value in pair]


def _lines(data: bytes) -> list[Span]:
    """Return the span of each line, with the line end before it."""
    ends = [-1, *(m.start() for m in re.finditer(rb"\n", data))]
    if not data.endswith(b"\n"):
        ends.append(len(data) - 1)
    return [(max(0, a), b + 1) for a, b in pairwise(ends)]


def _found(pattern: bytes, data: bytes) -> list[Span]:
    return [match.span(1) for match in re.finditer(pattern, data)]


def _laz_own(data: bytes, points: int, start: int) -> list[list[Span]]:
    """Return the spans of the points of a LAZ file."""
    with laspy.open(io.BytesIO(data)) as file:
        vlr = lazrs.LazVlr(file.header.vlrs.get("LasZipVlr")[0].record_data_bytes())
        layered = file.header.point_format.id >= 6
    source = io.BytesIO(data)
    source.seek(start)
    chunks = lazrs.read_chunk_table(source, vlr)
    if layered:
        own, at, left = [], start + 8, points
        for count, size in chunks:
            own += [[(at, at + size)]] * min(count, left)
            at, left = at + size, left - min(count, left)
        return own
    # How much of the only chunk a point needs: where other bytes behind it change no coordinate.
    (_, size), begin = chunks[0], start + 8
    right = laspy.read(io.BytesIO(data)).xyz
    ends = np.full(points, begin + size)
    for end in range(begin + size - 1, begin, -8):
        other = data[:end] + bytes(b ^ 0x55 for b in data[end : begin + size]) + data[begin + size :]
        try:
            same = (laspy.read(io.BytesIO(other)).xyz == right).all(axis=1)
        except Exception:
            break
        first = points if same.all() else int(np.argmin(same))
        ends[:first] = end
    return [[(begin, int(end))] for end in ends]


def _lzf_ends(data: bytes, start: int) -> np.ndarray:
    """Return, for each byte of the decompressed data, the end of its code in the file."""
    ends: list[int] = []
    while start < len(data):
        code = data[start]
        taken, count = (code + 2, code + 1) if code < 32 else (2, (code >> 5) + 2)
        if code >> 5 == 7:
            taken, count = 3, count + data[start + 1]
        start += taken
        ends += [start] * count
    return np.array(ends)


def _text_number(data: bytes, name: str) -> list[list[Field]]:
    """Return the counts of a header in text."""
    if name.endswith(".ply"):
        return [[Field(span)] for span in _found(rb"element \w+ (\d+)", data[:1000])]
    if name.endswith(".pcd"):
        both = [Field(span) for span in _found(rb"(?:WIDTH|POINTS) (\d+)", data[:1000])]
        return [both, both[:1]]
    if name.endswith(".glb"):
        (words,) = struct.unpack_from("<I", data, 12)
        return [
            [Field(span, fill=b" ")] for span in _found(rb'"(?:count|byteLength)": (\d+)', data[: 20 + words])
        ]
    return []


def describe(name: str, path: Path) -> Whole:
    """Describe a valid file that broken_scans.py wrote."""
    data = path.read_bytes()
    scans = [place_scan(scan) for scan in open_scans(path)]
    blocks = [np.concatenate([block.xyz for block in scan.blocks()]) for scan in scans]
    points = np.concatenate(blocks)
    n, suffix, lines = len(points), path.suffix, _lines(data)
    own: list[list[Span]] = []
    placing: list[Span] = []
    counts, boxes = _text_number(data, name), list[Field]()
    header: Span = (0, len(data))
    if suffix in (".las", ".laz"):
        start, size = struct.unpack_from("<I", data, 96)[0], struct.unpack_from("<H", data, 105)[0]
        # The coordinates, and the flags, one of which deletes the point.
        plain = [[(at, at + 12), (at + 15, at + 16)] for at in range(start, start + size * n, size)]
        own = plain if suffix == ".las" else _laz_own(data, n, start)
        placing, header = [(131, 179)], (0, start)
        legacy, wide = Field((107, 111), "<I"), Field((247, 255), "<Q")
        counts = [[legacy, wide], [wide], [legacy]] if data[25] >= 4 else [[legacy]]
        boxes = [Field((at, at + 8), "<d") for at in range(179, 227, 8)]
    elif suffix == ".e57":
        (offset,) = struct.unpack_from("<Q", data, 24)
        header = (offset, len(data))
        xml = data[offset:]
        sections = [int(x) for x in re.findall(rb'fileOffset="(\d+)"', xml)]
        for k, at in enumerate(sections):
            past = [*sections, offset][k + 1]
            own += [[(at // PAGE * PAGE, -(-past // PAGE) * PAGE)]] * len(blocks[k])
        counts = [
            [Field((a + offset, b + offset), fill=b"0")] for a, b in _found(rb'recordCount="(\d+)"', xml)
        ]
        boxes = [
            Field((a + offset, b + offset), fill=b"0")
            for a, b in _found(rb'<[xyz]M(?:in|ax)imum type="Float">([^<]+)<', xml)
        ]
        # The rest of the XML says where points are and in which units.
        stated = [f.span for f in (*boxes, *(f for group in counts for f in group))]
        at = offset
        for begin, end in sorted(stated):
            placing.append((at, begin))
            at = end
        placing.append((at, len(data)))
    elif suffix == ".ply" and name != "text.ply":
        start = data.index(b"end_header\n") + 11
        own, header = [[(start + 25 * k, start + 25 * k + 20)] for k in range(n)], (0, start)
    elif suffix == ".pcd" and name != "text.pcd":
        start = data.index(b"\n", data.index(b"DATA ")) + 1
        header, placing = (0, start), _found(rb"VIEWPOINT ([^\n]+)", data[:1000])
        if name == "binary.pcd":
            own = [[(at + 12, at + 28), (at + 29, at + 37)] for at in range(start, start + 41 * n, 41)]
        else:
            ends = _lzf_ends(data, start + 8)
            own = [[(start + 8, int(ends[29 * n + 8 * k + 7]))] for k in range(n)]
            counts += [[Field((start, start + 4), "<I")], [Field((start + 4, start + 8), "<I")]]
    elif suffix == ".stl" and name != "ascii.stl":
        own = [[(at, at + 12)] for k in range(n // 3) for at in range(96 + 50 * k, 132 + 50 * k, 12)]
        header, counts = (0, 84), [[Field((80, 84), "<I")]]
    elif suffix == ".glb":
        (words,) = struct.unpack_from("<I", data, 12)
        start = 28 + words
        own, header = [[(start + 16 * k, start + 16 * k + 12)] for k in range(n)], (0, start)
    elif suffix == ".ptx":
        at = 0
        for block in blocks:
            placing += lines[at + 6 : at + 10]
            counts += [[Field(_number(data, lines[at]))], [Field(_number(data, lines[at + 1]))]]
            own += [[span] for span in lines[at + 10 : at + 10 + len(block)]]
            at += 10 + len(block)
        header = (0, lines[9][1])
    elif suffix == ".pts":
        at = 0
        for block in blocks:
            counts += [[Field(_number(data, lines[at]))]]
            own += [[span] for span in lines[at + 1 : at + 1 + len(block)]]
            at += 1 + len(block)
        header = (0, lines[0][1])
    else:
        marks = {"text.ply": b"end_header", "text.pcd": b"DATA ", "header.csv": b"x,y,z"}
        first = next(
            (k + 1 for k, (a, b) in enumerate(lines) if data[a:b].lstrip().startswith(marks.get(name, b"?"))),
            0,
        )
        rows = lines[first : first + n]
        if name in ("mesh.obj", "ascii.stl"):
            rows = [span for span in lines if re.match(rb"\s*(v|vertex) ", data[span[0] : span[1]])]
        own, header = [[span] for span in rows], (0, max(1, rows[0][0]))
        placing = [(0, rows[0][0])] if name == "header.csv" else []
        if name == "text.pcd":
            placing = _found(rb"VIEWPOINT ([^\n]+)", data[:1000])
    assert len(own) == n, (name, len(own), n)
    return Whole(name, data, points, own, placing, header, counts, boxes)


def _number(data: bytes, line: Span) -> Span:
    """Return the span of the text in a line."""
    text = data[line[0] : line[1]]
    begin = line[0] + len(text) - len(text.lstrip())
    return begin, begin + len(text.strip())


class Damaged:
    """Copy of a valid file that is being damaged.

    data: its bytes.  origin: for each, its number in the valid file, or -1 if it was changed.
    """

    def __init__(self, whole: Whole, rng: np.random.Generator) -> None:
        self.whole, self.rng = whole, rng
        self.data, self.origin = bytearray(whole.data), np.arange(len(whole.data))

    def replace(self, begin: int, end: int, new: bytes) -> None:
        """Replace the bytes [begin, end). Equal ones at the same place count as unchanged."""
        kept = np.full(len(new), -1)
        if len(new) == end - begin:
            same = np.frombuffer(new, np.uint8) == np.frombuffer(self.data[begin:end], np.uint8)
            kept = np.where(same, self.origin[begin:end], -1)
        self.data[begin:end] = new
        self.origin = np.concatenate([self.origin[:begin], kept, self.origin[end:]])

    def field(self, field: Field, value: float) -> None:
        """Write a number into a field that has not moved."""
        at = np.flatnonzero(self.origin == field.span[0])
        if not len(at):
            return
        begin, length = int(at[0]), field.span[1] - field.span[0]
        new = struct.pack(field.form, value) if field.form else str(value).encode()
        if field.fill:
            new = (
                new.rjust(length, b"0")
                if field.fill == b"0" and new[:1] != b"-"
                else new.ljust(length, field.fill)
            )
            new = new[:length]
        self.replace(begin, begin + length, new)

    def count(self) -> bool:
        """Change a count. Return whether the file has one."""
        if not self.whole.counts:
            return False
        group = self.whole.counts[int(self.rng.integers(len(self.whole.counts)))]
        field = group[0]
        raw = self.whole.data[field.span[0] : field.span[1]]
        old = struct.unpack(field.form, raw)[0] if field.form else int(raw)
        values = [0, 0, 1, max(0, old - 1), old // 2, old + 1, 3 * old]
        value = values[int(self.rng.integers(len(values)))]
        for field in sorted(group, key=lambda f: f.span, reverse=True):
            self.field(field, value)
        return True

    def box(self) -> bool:
        """Change some bounds. Return whether the file has any."""
        if not self.whole.boxes:
            return False
        for field in self.whole.boxes:
            if self.rng.random() < 0.5:
                values = (0, 1, -1, 1000, -1000, 5, 1e300 if field.form else 9)
                self.field(field, values[int(self.rng.integers(len(values)))])
        return True

    def header(self) -> bool:
        """Replace some bytes of the header."""
        begin, end = self.whole.header
        at = int(self.rng.integers(begin, min(end, len(self.data))))
        new = EXTREMES[int(self.rng.integers(len(EXTREMES)))]
        if self.rng.random() < 0.5:
            new = self.rng.bytes(int(self.rng.integers(1, 5)))
        new = new[: len(self.data) - at]
        self.replace(at, at + len(new), new)
        return True

    def cut(self) -> bool:
        """Cut the file off, mostly within the points."""
        begin = self.whole.own[0][0][0] if self.rng.random() < 0.8 else 0
        at = int(self.rng.integers(min(begin, len(self.data) - 1), len(self.data)))
        self.data, self.origin = self.data[: max(1, at)], self.origin[: max(1, at)]
        return True

    def flips(self) -> bool:
        """Flip one to four bits anywhere."""
        for at in self.rng.integers(len(self.data), size=int(self.rng.integers(1, 5))).tolist():
            self.replace(at, at + 1, bytes([self.data[at] ^ 1 << int(self.rng.integers(8))]))
        return True

    def zeros(self) -> bool:
        """Write zeros over some bytes, as a file system does that lost them."""
        at = int(self.rng.integers(len(self.data)))
        end = min(len(self.data), at + int(self.rng.integers(1, 200)))
        self.replace(at, end, bytes(end - at))
        return True

    def finish(self) -> bytes:
        """Return the file; one of two E57 files gets checksums that match, as if written like this."""
        if self.whole.name.endswith(".e57") and self.rng.random() < 0.5:
            return with_checksums(bytes(self.data))
        return bytes(self.data)

    def intact(self) -> np.ndarray:
        """Return which points (n,) have all their own bytes."""
        kept = self._kept()
        return np.array([all(kept[a:b].all() for a, b in spans) for spans in self.whole.own])

    def is_placed(self) -> bool:
        """Return whether all that places the points is unchanged."""
        if self.whole.name.endswith(".glb") and not self._same_values():
            return False
        kept = self._kept()
        return all(kept[a:b].all() for a, b in self.whole.placing)

    def _kept(self) -> np.ndarray:
        kept = np.zeros(len(self.whole.data), bool)
        kept[self.origin[self.origin >= 0]] = True
        return kept

    def _same_values(self) -> bool:
        """Return whether a GLB's document is none, or has the numbers and texts of the valid one.

        Counts may differ, and names: what these change is a fault to be found.
        """
        found = []
        for data in (self.whole.data, bytes(self.data)):
            try:
                (words,) = struct.unpack_from("<I", data, 12)
                found.append(list(_leaves(json.loads(data[20 : 20 + words]))))
            except (ValueError, struct.error, RecursionError):
                return True
        return found[0] == found[1]


def _leaves(value: object, key: str = "") -> Iterator[object]:
    """Yield the values of a document in their order, without counts."""
    if isinstance(value, dict):
        for name, each in value.items():
            yield from _leaves(each, name)
    elif isinstance(value, list):
        yield len(value)
        for each in value:
            yield from _leaves(each)
    elif key not in ("count", "byteLength"):
        yield value


# Damage by name: what is done in turn. What a file does not have is left out.
DAMAGES: dict[str, tuple[Callable[[Damaged], bool], ...]] = {
    "count": (Damaged.count,),
    "header": (Damaged.header,),
    "box": (Damaged.box,),
    "truncation": (Damaged.cut,),
    "flips": (Damaged.flips,),
    "zeros": (Damaged.zeros,),
    "box and truncation": (Damaged.box, Damaged.cut),
    "box and count": (Damaged.box, Damaged.count),
    "count and flips": (Damaged.count, Damaged.flips),
    "header and truncation": (Damaged.header, Damaged.cut),
}


def damage(whole: Whole, kind: str, rng: np.random.Generator) -> Damaged:
    """Return a damaged copy of a file, damaged by flips if it has nothing of that kind."""
    broken = Damaged(whole, rng)
    if not all([step(broken) for step in DAMAGES[kind]]):
        broken.flips()
    return broken
