"""Coordinate reference system that a LAS file names, as text for people: its WKT or its GeoTIFF keys."""

import struct
from typing import BinaryIO

PROJECTION = b"LASF_Projection"
WKT, GEO_KEYS, GEO_TEXTS = 2112, 34735, 34737
# Maximum bytes of a text, several times longer than any real one; a longer one is truncated.
LONGEST_CRS = 1 << 16

# GeoTIFF keys that identify the system [OGC 19-008r4, 7]; other keys refine it.
KEY_NAMES = {
    1024: "model",
    1026: "citation",
    2048: "geodetic EPSG",
    2049: "geodetic citation",
    3072: "projected EPSG",
    3073: "projected citation",
    3076: "linear units EPSG",
    4096: "vertical EPSG",
    4097: "vertical citation",
    4099: "vertical units EPSG",
}


def las_crs(file: BinaryIO, header_size: int, vlr_count: int, start: int, evlrs: tuple[int, int]) -> str:
    """Return the text of the system that a LAS file names. Never raises.

    start: offset of the points, where the records before them end.
    evlrs: (offset, number) of the records after the points.
    Returns "" where the file names none or its records are broken.
    """
    try:
        found = _records(file, header_size, vlr_count, start, "<2x16sHH32x")
        if WKT not in found:
            at, count = evlrs
            found = {**_records(file, at, count, 1 << 62, "<2x16sHQ32x"), **found}
        if found.get(WKT, b"").strip(b"\0 "):
            return found[WKT].split(b"\0")[0].decode("utf-8", "replace").strip()
        return _geo_text(found[GEO_KEYS], found.get(GEO_TEXTS, b"")) if GEO_KEYS in found else ""
    except (OSError, ValueError, struct.error, OverflowError):
        return ""


def _records(file: BinaryIO, at: int, count: int, end: int, form: str) -> dict[int, bytes]:
    """Return the projection records among `count` from offset `at`, up to LONGEST_CRS bytes of each."""
    head = struct.Struct(form)
    found: dict[int, bytes] = {}
    file.seek(at)
    for _ in range(count):
        raw = file.read(head.size)
        if len(raw) < head.size or file.tell() > end:
            break
        user, number, length = head.unpack(raw)
        behind = file.tell() + length
        if user.rstrip(b"\0") == PROJECTION and number not in found:
            found[number] = file.read(min(length, LONGEST_CRS, end - file.tell()))
        file.seek(behind)
    return found


def _geo_text(keys: bytes, texts: bytes) -> str:
    """Format the identifying keys: "projected EPSG 26915; citation NAD83 / UTM zone 15N"."""
    words = struct.unpack(f"<{len(keys) // 2}H", keys[: len(keys) // 2 * 2])
    parts = []
    for k in range(1, 1 + min(words[3] if len(words) > 3 else 0, len(words) // 4 - 1)):
        key, place, count, value = words[4 * k : 4 * k + 4]
        if key not in KEY_NAMES:
            continue
        if place == GEO_TEXTS:
            text = texts[value : value + count].decode("ascii", "replace").strip("|\0 ")
        else:
            text = str(value) if place == 0 else ""
        if text:
            parts.append(f"{KEY_NAMES[key]} {text}")
    return "; ".join(parts)
