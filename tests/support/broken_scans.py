"""Small valid scans in every format, and random damage to them.

Damage changes, cuts or repeats bytes, or makes numbers extreme. Damaged E57 pages may get new
checksums, because the checksums would otherwise hide the damage from the code behind them.
"""

import re
import struct
from collections.abc import Callable
from pathlib import Path

import lazrs
import numpy as np
import plyfile
from scan_formats import (
    cartesian,
    glb_document,
    glb_vertices,
    ptx_scan,
    text_rows,
    write_e57,
    write_glb,
    write_pcd,
    write_pts,
)
from synthetic_scans import write_las

COUNT = 60
POSE = np.array([[0.0, -1, 0, 10], [1, 0, 0, 20], [0, 0, 1, 30], [0, 0, 0, 1]])
PAGE = 1024


def _las(path: Path, xyz: np.ndarray, point_format: int) -> None:
    light = np.arange(len(xyz)).astype(np.uint16)
    offset = (1000.0, 2000.0, 3.0)
    write_las(path, np.rint(xyz * 1000), offset=offset, intensity=light, point_format=point_format)


def _variable_laz(path: Path, xyz: np.ndarray) -> None:
    """Return a LAZ whose chunks differ in size, as those of COPC do: 1, 7 and all other points."""
    plain = path.with_suffix(".las")
    _las(plain, xyz, 6)
    data = plain.read_bytes()
    plain.unlink()
    start, size = struct.unpack_from("<I", data, 96)[0], struct.unpack_from("<H", data, 105)[0]
    vlr = lazrs.LazVlr.new_for_compression(6, 0, True)
    record = vlr.record_data()
    head = bytearray(
        data[:start] + struct.pack("<H16sHH32s", 0, b"laszip encoded", 22204, len(record), b"") + record
    )
    struct.pack_into("<II", head, 96, len(head), struct.unpack_from("<I", data, 100)[0] + 1)
    head[104] |= 0x80
    with path.open("wb") as file:
        file.write(head)
        writer = lazrs.LasZipCompressor(file, vlr)
        for begin, end in ((0, 1), (1, 8), (8, len(xyz))):
            writer.compress_many(data[start + begin * size : start + end * size])
            writer.finish_current_chunk()
        writer.done()


def _e57(path: Path, xyz: np.ndarray) -> None:
    order = np.arange(len(xyz))
    light, state = order / len(xyz), (order % 7 == 0).astype(np.int8)
    scaled = {f"cartesian{axis}": (0.001, 0.5) for axis in "XYZ"}
    first = {"columns": {**cartesian(xyz), "intensity": light, "cartesianInvalidState": state}}
    first |= {"translation": [1.0, 2, 3], "rotation": [0.5, 0.5, -0.5, 0.5], "bounds": [[-5] * 3, [5] * 3]}
    second = {"columns": cartesian((xyz * 1000).round() / 1000 + 0.5), "scaled": scaled}
    write_e57(path, [first, second], crs="a system")


def _spherical(path: Path, xyz: np.ndarray) -> None:
    names = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
    columns = {
        name: np.ascontiguousarray(column)
        for name, column in zip(names, xyz.T.astype(np.float32), strict=True)
    }
    write_e57(path, [{"columns": columns}])


def _ply(path: Path, xyz: np.ndarray, text: bool, order: str) -> None:
    vertex = np.zeros(len(xyz), [("x", "f8"), ("y", "f4"), ("z", "f8"), ("red", "u1"), ("intensity", "f4")])
    vertex["x"], vertex["y"], vertex["z"] = xyz.T
    face = np.array([([0, 1, 2],), ([1, 2, 3],)], dtype=[("vertex_indices", "i4", (3,))])
    elements = [plyfile.PlyElement.describe(vertex, "vertex"), plyfile.PlyElement.describe(face, "face")]
    plyfile.PlyData(elements, text=text, byte_order=order).write(path)


def _stl(path: Path, xyz: np.ndarray) -> None:
    record = np.zeros(len(xyz) // 3, [("normal", "<f4", 3), ("corners", "<f4", 9), ("attribute", "<u2")])
    record["corners"] = xyz.reshape(-1, 9)
    path.write_bytes(b"binary".ljust(80) + np.uint32(len(record)).tobytes() + record.tobytes())


def _ascii_stl(path: Path, xyz: np.ndarray) -> None:
    text = "solid a\n"
    for triangle in xyz.reshape(-1, 3, 3).tolist():
        vertices = "".join(f"   vertex {x!r} {y!r} {z!r}\n" for x, y, z in triangle)
        text += f" facet normal 0 0 0\n  outer loop\n{vertices}  endloop\n endfacet\n"
    path.write_text(text + "endsolid a\n")


def _glb(path: Path, xyz: np.ndarray) -> None:
    document = glb_document(len(xyz), 30)
    document["nodes"] = [{"children": [1], "scale": [2, 2, 2]}, {"mesh": 0, "rotation": [0, 0, 1, 0]}]
    corners = (np.arange(30) % len(xyz)).astype("<u2")
    write_glb(path, document, glb_vertices(xyz) + corners.tobytes())


def _obj(path: Path, xyz: np.ndarray) -> None:
    path.write_text(
        "# made\n"
        + "".join(f"v {x} {y} {z}\nvn 0 0 1\n" for x, y, z in xyz.tolist())
        + "f 1 2 3\nf 2//1 3 4\n"
    )


def _text(separator: str, head: str = "", end: str = "\n") -> Callable[[Path, np.ndarray], None]:
    def write(path: Path, xyz: np.ndarray) -> None:
        rows = text_rows(xyz, np.arange(len(xyz))).replace(" ", separator).replace("\n", end)
        path.write_bytes((head + rows).encode())

    return write


def _ptx(path: Path, xyz: np.ndarray) -> None:
    light = np.arange(len(xyz))
    path.write_text(ptx_scan(xyz, light, POSE, 6) + ptx_scan(xyz[:9], light[:9]))


# Writer of each file. It gets points (n, 3), n a multiple of 6, within 5 m of the origin, with
# three decimals.
SEEDS: dict[str, Callable[[Path, np.ndarray], object]] = {
    "plain.las": lambda path, xyz: _las(path, xyz, 1),
    "new.las": lambda path, xyz: _las(path, xyz, 6),
    "old.laz": lambda path, xyz: _las(path, xyz, 3),
    "layered.laz": lambda path, xyz: _las(path, xyz, 7),
    "variable.laz": _variable_laz,
    "two.e57": _e57,
    "spherical.e57": _spherical,
    "little.ply": lambda path, xyz: _ply(path, xyz, False, "<"),
    "big.ply": lambda path, xyz: _ply(path, xyz, False, ">"),
    "text.ply": lambda path, xyz: _ply(path, xyz, True, "="),
    "text.pcd": lambda path, xyz: write_pcd(path, xyz, np.arange(len(xyz)), "ascii"),
    "binary.pcd": lambda path, xyz: write_pcd(path, xyz, np.arange(len(xyz)), "binary"),
    "packed.pcd": lambda path, xyz: write_pcd(path, xyz, np.arange(len(xyz)), "binary_compressed"),
    "two.ptx": _ptx,
    "two.pts": lambda path, xyz: write_pts(path, [(xyz, np.arange(len(xyz))), (xyz[:5], np.arange(5))]),
    "blanks.xyz": _text(" "),
    "header.csv": _text(",", "x,y,z,intensity\n"),
    "crlf.txt": _text(";", end="\r\n"),
    "mesh.obj": _obj,
    "binary.stl": _stl,
    "ascii.stl": _ascii_stl,
    "mesh.glb": _glb,
}


def write_seeds(folder: Path, count: int = COUNT) -> dict[str, bytes]:
    """Return all valid files: name -> content. They are also written below `folder`, which must exist.

    count: of points, a multiple of 6.
    """
    xyz = np.random.default_rng(12).uniform(-5, 5, (count, 3)).round(3)
    content = {}
    for name, write in SEEDS.items():
        write(folder / name, xyz)
        content[name] = (folder / name).read_bytes()
    return content


EXTREMES = [
    struct.pack(form, value)
    for form, values in (
        ("<B", (0, 1, 0x7F, 0xFF)),
        ("<H", (0, 1, 0x7FFF, 0xFFFF)),
        ("<I", (0, 1, 0x7FFFFFFF, 0xFFFFFFFF, 1 << 24, 1 << 30)),
        ("<Q", (0, 1, 1 << 31, (1 << 63) - 1, (1 << 64) - 1, 1 << 40)),
        ("<d", (0.0, -0.0, 1e308, -1e308, 1e-308, float("inf"), float("nan"), 1e9)),
        ("<f", (3e38, float("nan"))),
    )
    for value in values
]
NUMBERS = [
    b"0", b"1", b"-1", b"255", b"65536", b"4294967295", b"2147483648", b"9223372036854775807", b"1e308", b"-1e308",
    b"1e-320", b"nan", b"inf", b"-inf", b"99999999999999999999999999", b"0x10", b"1_000", b"1e999", b"", b"-",
    b"." * 20, b"9" * 5000,
]  # fmt: skip
NUMBER = re.compile(rb"-?\d[\d.eE+-]*")


def _flip(data: bytearray, rng: np.random.Generator) -> None:
    for _ in range(int(rng.integers(1, 5))):
        data[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))


def _replace_bytes(data: bytearray, rng: np.random.Generator) -> None:
    at = int(rng.integers(len(data)))
    some = rng.bytes(int(rng.integers(1, 9)))
    data[at : at + len(some)] = some


def _cut(data: bytearray, rng: np.random.Generator) -> None:
    del data[int(rng.integers(len(data))) :]


def _insert(data: bytearray, rng: np.random.Generator) -> None:
    at = int(rng.integers(len(data)))
    data[at:at] = rng.bytes(int(rng.integers(1, 65)))


def _remove(data: bytearray, rng: np.random.Generator) -> None:
    at = int(rng.integers(len(data)))
    del data[at : at + int(rng.integers(1, 65))]


def _repeat(data: bytearray, rng: np.random.Generator) -> None:
    begin = int(rng.integers(len(data)))
    part = data[begin : begin + int(rng.integers(1, 513))]
    at = int(rng.integers(len(data)))
    data[at:at] = part * int(rng.integers(1, 4))


def _zeros(data: bytearray, rng: np.random.Generator) -> None:
    at, count = int(rng.integers(len(data))), int(rng.integers(1, 513))
    data[at : at + count] = bytes(len(data[at : at + count]))


def _extreme(data: bytearray, rng: np.random.Generator) -> None:
    """Replace a number at the beginning or end of a file.

    Headers are at the beginning; LAZ and E57 have tables and XML at the end.
    """
    some = EXTREMES[int(rng.integers(len(EXTREMES)))]
    at = int(rng.integers(min(len(data), 512)))
    if rng.random() < 0.3:
        at = len(data) - 1 - at
    data[at : at + len(some)] = some[: len(data) - at]


def _text_number(data: bytearray, rng: np.random.Generator) -> None:
    """Replace a number written as text, in any file: E57, PLY, PCD and GLB have headers in text."""
    found = list(NUMBER.finditer(bytes(data)))
    if found:
        match = found[int(rng.integers(len(found)))]
        data[match.start() : match.end()] = NUMBERS[int(rng.integers(len(NUMBERS)))]


# Kinds listed twice find the most faults.
DAMAGES = (
    *(_flip, _replace_bytes, _cut, _insert, _remove, _repeat, _zeros, _extreme, _text_number),
    *(_flip, _extreme, _text_number),
)


def mutate(name: str, data: bytes, rng: np.random.Generator) -> bytes:
    """Return the content of a file after one to three kinds of damage; never empty.

    name: of the valid file.
    """
    broken = bytearray(data)
    e57 = name.endswith(".e57")
    for _ in range(int(rng.choice([1, 1, 1, 2, 3]))):
        damage = DAMAGES[int(rng.integers(len(DAMAGES)))]
        length = len(broken)
        damage(broken, rng)
        if e57 and damage is _text_number:
            # A change of length moves everything behind it off its page; the next number makes up
            # the difference.
            del broken[length:]
            broken.extend(bytes(length - len(broken)))
        if not broken:
            broken.append(0)
    if e57 and rng.random() < 0.7:
        broken = bytearray(with_checksums(bytes(broken)))
    return bytes(broken)


def _crc_table() -> list[int]:
    table = []
    for byte in range(256):
        for _ in range(8):
            byte = byte >> 1 ^ (0x82F63B78 if byte & 1 else 0)
        table.append(byte)
    return table


CRC32C = _crc_table()


def with_checksums(data: bytes) -> bytes:
    """Return an E57 file whose pages end in matching checksums: CRC-32C, big-endian [ASTM E2807, 7]."""
    pages = []
    for begin in range(0, len(data) - PAGE + 1, PAGE):
        page = data[begin : begin + PAGE - 4]
        crc = 0xFFFFFFFF
        for byte in page:
            crc = crc >> 8 ^ CRC32C[(crc ^ byte) & 255]
        pages.append(page + struct.pack(">I", crc ^ 0xFFFFFFFF))
    return b"".join(pages) + data[len(data) // PAGE * PAGE :]
