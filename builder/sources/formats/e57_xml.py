"""Check of an E57 file's header, XML and number of records, and repair of its letters.

The library's time grows with the square of the nesting depth of elements: 30,000 levels, in a file
of 0.7 MB, take 2 s; ten times as many take minutes. The library also creates a node for every
element, however many there are.
"""

import re
import shutil
import struct
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

from ..common.scan import damaged_error

# Maximum bytes of XML that are read. The XML of 700 scans, each with a pose and bounds, takes about
# 4 MiB.
LONGEST_XML = 16 << 20
PAGE_BYTES = 1024  # the last four bytes are the page's checksum [ASTM E2807, 7]
# A scan has about 60 elements, nested at most nine deep; extensions add some.
MAX_ELEMENTS = 1 << 18
DEEPEST = 64
# Bytes that are not UTF-8, and characters that XML 1.0 does not allow.
_FORBIDDEN = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\ufffe\uffff\udc80-\udcff]+")


class XmlLimitError(ValueError):
    """Content of the XML that no scan needs."""


def check_e57(path: Path) -> None:
    """Check an E57 file's header against its size, and its XML against limits. Raises ScanError."""
    with path.open("rb") as file:
        head = file.read(48)
        size = file.seek(0, 2)
        fields = struct.unpack("<8sIIQQQQ", head) if len(head) == 48 else (head[:8], 0, 0, 0, 0, 0, 0)
        signature, _, _, length, offset, xml_length, page = fields
        if signature != b"ASTM-E57" or page != PAGE_BYTES:
            raise damaged_error(
                path,
                f"a file that begins with {signature!r}, pages of {page} bytes",
                f"b'ASTM-E57' and {PAGE_BYTES}",
            )
        if length != size or offset + xml_length > size or xml_length > LONGEST_XML:
            raise damaged_error(
                path,
                f"{size} bytes, {xml_length} of XML from byte {offset} on, {length} bytes declared",
                f"all declared bytes, and at most {LONGEST_XML} bytes of XML",
            )
        xml = xml_of(file)
    try:
        check_xml(plain_letters(xml))
    except XmlLimitError as error:
        raise damaged_error(path, str(error), "the description of some scans") from None
    except expat.ExpatError:
        # The XML up to the error is within the limits. libE57Format checks the checksums first and
        # then reports the error.
        pass


def check_xml(xml: bytes) -> None:
    """Raise XmlLimitError for excessive depth, too many elements, or a document type.

    A document type may define entities, which can expand to any depth and number of elements.
    """
    depth = count = 0

    def begin(name: str, attributes: dict[str, str]) -> None:
        nonlocal depth, count
        depth, count = depth + 1, count + 1
        if depth > DEEPEST or count > MAX_ELEMENTS:
            raise XmlLimitError(f"XML of over {MAX_ELEMENTS} elements, or nested over {DEEPEST} deep")

    def end(name: str) -> None:
        nonlocal depth
        depth -= 1

    def declares(*what: object) -> None:
        raise XmlLimitError("XML with a document type")

    parser = expat.ParserCreate()
    parser.StartElementHandler = begin
    parser.EndElementHandler = end
    parser.StartDoctypeDeclHandler = declares
    parser.Parse(xml, True)


def plain_letters(xml: bytes) -> bytes:
    """Return XML with "?" for each byte of letters that are not UTF-8 or that XML does not allow."""
    text = xml.decode("utf-8", "surrogateescape")
    return _FORBIDDEN.sub(lambda found: "?" * len(found[0].encode("utf-8", "surrogateescape")), text).encode()


@contextmanager
def with_plain_letters(path: Path) -> Iterator[Path | None]:
    """Make a copy of an E57 file with `plain_letters`; None if that does not make its XML readable.

    libE57Format reads no other letters, and only from a file. Some programs write names in the
    encoding of their computer. Pages with a wrong checksum are left to the library.
    """
    with path.open("rb") as file:
        raw = xml_of(file)
        plain = plain_letters(raw)
        file.seek(0)
        offset, length = struct.unpack("<24xQQ", file.read(40))
        first, at = divmod(offset, PAGE_BYTES)
        count = -(-(at + length) // (PAGE_BYTES - 4))
        file.seek(first * PAGE_BYTES)
        data = bytearray(file.read(count * PAGE_BYTES))
    try:
        check_xml(plain)
    except (XmlLimitError, expat.ExpatError):
        plain = raw
    pages = np.frombuffer(data[: len(data) // PAGE_BYTES * PAGE_BYTES], np.uint8).reshape(-1, PAGE_BYTES)
    if plain == raw or len(pages) < count or not np.array_equal(pages[:, -4:], _checksums(pages)):
        yield None
        return
    section = pages[:, :-4].reshape(-1)
    section[at : at + length] = np.frombuffer(plain, np.uint8)
    pages[:, :-4] = section.reshape(count, -1)
    pages[:, -4:] = _checksums(pages)
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder, "scan.e57")
        shutil.copyfile(path, copy)
        with copy.open("r+b") as file:
            file.seek(first * PAGE_BYTES)
            file.write(pages.tobytes())
        yield copy


def _checksums(pages: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the checksums (n, 4) of pages (n, PAGE_BYTES): CRC-32C, big-endian [ASTM E2807, 7]."""
    table: NDArray[np.uint32] = np.arange(256, dtype=np.uint32)
    one, eight = np.uint32(1), np.uint32(8)
    for _ in range(8):
        table = table >> one ^ (table & one) * np.uint32(0x82F63B78)
    found: NDArray[np.uint32] = np.full(len(pages), 0xFFFFFFFF, np.uint32)
    for column in pages[:, :-4].T:
        found = found >> eight ^ table[(found ^ column) & np.uint32(0xFF)]
    return (~found).astype(">u4")[:, None].view(np.uint8)


def xml_of(file: BufferedReader) -> bytes:
    """Return the XML section without the page checksums, which are not verified.

    Raises ValueError where the file has no E57 header.
    """
    file.seek(0)
    signature, _, _, _, offset, length, page = struct.unpack("<8sIIQQQQ", file.read(48))
    if signature != b"ASTM-E57" or page != PAGE_BYTES or length > LONGEST_XML:
        raise ValueError("no E57 header")
    return _content(file, _logical(offset), length)


def _logical(offset: int) -> int:
    """Return the position without checksums of a byte offset in the file."""
    return offset // PAGE_BYTES * (PAGE_BYTES - 4) + offset % PAGE_BYTES


def _content(file: BufferedReader, at: int, length: int) -> bytes:
    """Return bytes without the checksums of their pages. at: position without checksums."""
    page, at = divmod(at, PAGE_BYTES - 4)
    pages = (at + length) // (PAGE_BYTES - 4) + 1
    file.seek(page * PAGE_BYTES)
    raw = file.read(pages * PAGE_BYTES)
    section = b"".join(raw[start : start + PAGE_BYTES - 4] for start in range(0, len(raw), PAGE_BYTES))
    return section[at : at + length]


def checked_xml(file: BufferedReader) -> bytes:
    """Return the XML of a file that libE57Format refuses. Raises ValueError if it may be damaged.

    The checksums of its pages and of the header's page must match: damaged bounds would put the
    scan elsewhere.
    """
    xml = xml_of(file)
    file.seek(24)
    offset, _ = struct.unpack("<QQ", file.read(16))
    first, past = offset // PAGE_BYTES, -(-(_logical(offset) + len(xml)) // (PAGE_BYTES - 4))
    for begin, end in ((0, 1), (first, past)):
        file.seek(begin * PAGE_BYTES)
        pages = np.frombuffer(file.read((end - begin) * PAGE_BYTES), np.uint8).reshape(-1, PAGE_BYTES)
        if len(pages) < end - begin or not np.array_equal(pages[:, -4:], _checksums(pages)):
            raise ValueError("a page whose checksum does not match")
    return xml


class Section(NamedTuple):
    """Binary section of a scan's records.

    offset: of its header in the file.  streams: (bits of a value, bits of padding at most) of each
    field of a record.
    """

    offset: int
    streams: tuple[tuple[int, int], ...]


def record_sections(xml: bytes) -> list[Section | None]:
    """Return the section of each scan, in the file's order; None where the XML states none.

    Returns an empty list for XML that expat refuses.
    """
    try:
        root = ElementTree.fromstring(xml)
        tag = root.tag.rpartition("}")[0] + "}" if "}" in root.tag else ""
        return [
            _section(scan.find(f"{tag}points"), tag)
            for scan in root.iterfind(f"{tag}data3D/{tag}vectorChild")
        ]
    except (ElementTree.ParseError, ValueError):
        return []


def _section(points: ElementTree.Element | None, tag: str) -> Section | None:
    """Return the section of a vector of points; a number of the prototype may raise ValueError."""
    prototype = None if points is None else points.find(f"{tag}prototype")
    if points is None or prototype is None or not points.get("fileOffset", "").isdecimal():
        return None
    streams = []
    for field in prototype:
        bits, padding = 32 if field.get("precision") == "single" else 64, 0
        if field.get("type") != "Float":
            low, high = int(field.get("minimum", -(1 << 63))), int(field.get("maximum", (1 << 63) - 1))
            bits = (high - low).bit_length()
            # libE57Format writes integers in words of 8, 16, 32 or 64 bits and fills the last one.
            padding = max(8, 1 << (bits - 1).bit_length()) - 1 if bits else 0
        streams.append((bits, padding))
    return Section(int(points.get("fileOffset", "0")), tuple(streams))


def records_held(file: BufferedReader, section: Section) -> int:
    """Return the number of records that the section of a scan holds at least.

    Reads the heads of its packets, of 64 kB usually, without verifying checksums. Stops at one
    that is no packet, which libE57Format reports.
    """
    at = _logical(section.offset)
    kind, length, first = struct.unpack("<B7xQQ8x", _content(file, at, 32).ljust(32, b"\0"))
    past, at = min(at + length, file.seek(0, 2)), _logical(first)
    held = [0] * len(section.streams)
    while kind == 1 and at + 6 <= past:
        head = _content(file, at, 6 + 2 * len(held)).ljust(6 + 2 * len(held), b"\0")
        packet, size, count = struct.unpack_from("<BxHH", head)
        if packet == 1 and count == len(held):
            held = [a + b for a, b in zip(held, struct.unpack_from(f"<{count}H", head, 6), strict=True)]
        elif packet not in (0, 2) or size < 3:
            break
        at += size + 1
    return max(
        (
            -(-(8 * found - padding) // bits)
            for found, (bits, padding) in zip(held, section.streams, strict=True)
            if bits and found
        ),
        default=0,
    )
