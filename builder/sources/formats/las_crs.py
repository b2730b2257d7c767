"""Coordinate reference system of a LAS file, as WKT or GeoTIFF keys: its text and its units of length.

There is no database of systems: a unit counts as stated if WKT, a key of its own or the name of the
system (a citation) says it, not if it follows from the EPSG code of a projection. A code that may
be one in feet gets a note.
"""

import math
import re
import struct
from collections.abc import Mapping
from typing import NamedTuple

from ..common.units import DEGREES, METRES, UNKNOWN, unit_name

# Variable length records of the user "LASF_Projection" [LAS 1.4 R15, 3].
WKT, GEO_KEYS, GEO_DOUBLES, GEO_TEXTS = 2112, 34735, 34736, 34737

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
MODEL, GEOGRAPHIC, GEODETIC, ANGULAR_UNIT = 1024, 2, 2048, 2054
PROJECTED = range(3072, 3096)  # keys of a projection
# Keys of a unit of length, each with that of its size in metres, for a unit without EPSG code; the
# first pair is of projected systems, the second of geocentric ones.
LINEAR_UNITS, VERTICAL_UNIT = ((3076, 3077), (2052, 2053)), ((4099, 0),)
NO_CODE = (0, 32767)  # undefined, and defined by the file itself
PROJECTED_EPSG, VERTICAL_EPSG = 3072, 4096
# Citations of a plane system, and of one of heights. The first may name heights behind the plane.
PLANE_CITATIONS, HEIGHT_CITATION = (3073, 1026), 4097
_HEIGHTS = re.compile(r"[+;|]|height|vert", re.IGNORECASE)
# Units in names of systems, as EPSG writes them ("NAD83 / Texas Central (ftUS)") and ESRI
# ("NAD_1983_StatePlane_Texas_Central_FIPS_4203_Feet").
_CITED = (
    (re.compile(r"\(ftUS\)|\bUS survey f(?:oo|ee)t\b|_(?:Feet|Ft_?US)\b", re.IGNORECASE), 1200 / 3937),
    (re.compile(r"\(ft\)|\binternational f(?:oo|ee)t\b|_(?:Feet|Ft)_?Intl\b", re.IGNORECASE), 0.3048),
)
# EPSG codes of heights in feet in the United States (NAVD88 twice, NGVD29) -> metres.
FEET_HEIGHTS = {6360: 1200 / 3937, 5702: 1200 / 3937, 8228: 0.3048}
# EPSG codes among which are those of the State Plane systems in feet.
STATE_PLANES = (
    range(2222, 2291), range(2867, 2970), range(3417, 3761), range(6355, 6638), range(26729, 26871),
    range(32001, 32067),
)  # fmt: skip

# EPSG code of a unit of length -> metres [EPSG dataset, unit of measure].
EPSG_METRES = {
    1025: 0.001,
    1033: 0.01,
    9001: 1.0,
    9002: 0.3048,
    9003: 1200 / 3937,
    9005: 0.3047972654,
    9014: 1.8288,
    9030: 1852.0,
    9031: 1.0000135965,
    9033: 79200 / 3937,
    9034: 792 / 3937,
    9035: 6336000 / 3937,
    9036: 1000.0,
    9037: 0.9143917962,
    9040: 0.914398414616029,
    9041: 0.304799471538676,
    9080: 0.304799510248147,
    9084: 0.914398530744441,
    9093: 1609.344,
    9094: 0.304799710181509,
    9095: 0.3048007491,
    9096: 0.9144,
    9097: 20.1168,
    9098: 0.201168,
}

# WKT 1 and 2 [OGC 12-063r5, 18-010r11]: nodes of systems whose unit is that of x and y, or of
# heights, and of units. A base system, inside another or that of a bound one, does not count.
GEOGRAPHIC_NODES = {"GEOGCS", "GEOGCRS", "GEOGRAPHICCRS"}
GEODETIC_NODES = {"GEODCRS", "GEODETICCRS"}  # geographic or geocentric
PLANE_NODES = {
    "PROJCS", "PROJCRS", "PROJECTEDCRS", "DERIVEDPROJCRS", "GEOCCS", "LOCAL_CS", "ENGCRS", "ENGINEERINGCRS",
}  # fmt: skip
VERTICAL_NODES = {"VERT_CS", "VERTCS", "VERTCRS", "VERTICALCRS"}
OUTER_NODES = {"COMPD_CS", "COMPOUNDCRS", "BOUNDCRS", "SOURCECRS"}
UNIT_NODES = {"UNIT", "LENGTHUNIT", "ANGLEUNIT"}
DEEPEST = 100  # nodes inside one another; real ones are ten

_OTHERWISE = "otherwise set units in a list of `solidcloud inspect`"


class Units(NamedTuple):
    """Units that a file states. name: as `axis_metres` takes it.  note: as in `Scan.units_note`."""

    name: str
    note: str


class _Unit(NamedTuple):
    """Unit of some axes.  metres: None for an angle or an unknown length.  where: what states it."""

    metres: float | None
    where: str
    angular: bool = False


def crs_text(found: Mapping[int, bytes]) -> str:
    """Return the text of the system: WKT, or the identifying GeoTIFF keys; "" without either.

    found: number -> projection record.
    """
    if wkt := _wkt(found):
        return wkt
    return "; ".join(
        f"{KEY_NAMES[key]} {value}"
        for key, value in geo_keys(found).items()
        if key in KEY_NAMES and value != ""
    )


def stated_units(found: Mapping[int, bytes]) -> Units | None:
    """Return the units that the records of a file state; None where they state none.

    found: number -> projection record. Heights without a unit of their own have that of x and y.
    """
    tree, whole = _parse_wkt(_wkt(found))
    across, upward = _wkt_units(tree) if whole and tree else (None, None)
    if across is None and upward is None:
        across, upward = _key_units(geo_keys(found))
    if across is None and upward is None:
        if not whole:
            return Units("m", "its WKT ends too soon: taken as metres")
        code = geo_keys(found).get(PROJECTED_EPSG)
        if not any(code in codes for codes in STATE_PLANES):
            return None
        where = f"GeoTIFF key {PROJECTED_EPSG} = {code}"
        return Units(
            "m", f"{where} may be a system in feet, but no key states the unit: taken as metres, {_OTHERWISE}"
        )
    for unit in filter(None, (across, upward)):
        if unit.angular:
            return Units(DEGREES, f"coordinates in degrees of latitude and longitude, as {unit.where} states")
        if unit.metres is None:
            return Units(UNKNOWN, f"coordinates in a unit whose length is not known, as {unit.where} states")
    plane = unit_name(across.metres) if across and across.metres else "m"
    height = unit_name(upward.metres) if upward and upward.metres else plane
    if plane == height:
        where = (across or upward or _Unit(None, "")).where
        return Units(plane, "" if plane == "m" else f"coordinates in {_long_name(plane)}, as {where} states")
    across_text = (
        f"{_long_name(plane)}, as {across.where} states" if across else "metres, as no unit is stated"
    )
    where = upward.where if upward else ""
    return Units(
        f"{plane}+{height}", f"x and y in {across_text}; heights in {_long_name(height)}, as {where} states"
    )


def _long_name(name: str) -> str:
    """Return the name of a unit for a message."""
    names = {"m": "metres", "ft": "feet (ft)", "us-ft": "US survey feet (us-ft)"}
    return names.get(name, name if name in METRES else f"units of {name} m")


def geo_keys(found: Mapping[int, bytes]) -> dict[int, int | float | str]:
    """Return the values of the GeoTIFF keys of a file; those that cannot be read are left out."""
    keys, texts, numbers = (found.get(number, b"") for number in (GEO_KEYS, GEO_TEXTS, GEO_DOUBLES))
    words = struct.unpack(f"<{len(keys) // 2}H", keys[: len(keys) // 2 * 2])
    values: dict[int, int | float | str] = {}
    for k in range(1, 1 + min(words[3] if len(words) > 3 else 0, len(words) // 4 - 1)):
        key, place, count, value = words[4 * k : 4 * k + 4]
        if place == 0:
            values[key] = value
        elif place == GEO_TEXTS:
            values[key] = texts[value : value + count].decode("ascii", "replace").strip("|\0 ")
        elif place == GEO_DOUBLES and 8 * value + 8 <= len(numbers):
            (values[key],) = struct.unpack_from("<d", numbers, 8 * value)
    return values


def _key_units(keys: Mapping[int, int | float | str]) -> tuple[_Unit | None, _Unit | None]:
    """Return the units of x and y and of heights that GeoTIFF keys state."""
    across = next(filter(None, (_key_unit(keys, *pair) for pair in LINEAR_UNITS)), None)
    model = keys.get(MODEL)
    # Without a model, a system of latitude and longitude is one that names nothing else.
    plain = model in (None, *NO_CODE) and across is None and not keys.keys() & PROJECTED
    if model == GEOGRAPHIC or (plain and (GEODETIC in keys or ANGULAR_UNIT in keys)):
        key = MODEL if model == GEOGRAPHIC else GEODETIC if GEODETIC in keys else ANGULAR_UNIT
        across = _Unit(None, f"GeoTIFF key {key} = {keys[key]}", True)
    cited = {key: _HEIGHTS.split(str(keys.get(key, "")), maxsplit=1) for key in PLANE_CITATIONS}
    across = across or next(filter(None, (_cited_unit(key, cited[key][0]) for key in cited)), None)
    upward, code = _key_unit(keys, *VERTICAL_UNIT[0]), keys.get(VERTICAL_EPSG)
    if upward is None and isinstance(code, int) and code in FEET_HEIGHTS:
        upward = _Unit(FEET_HEIGHTS[code], f"GeoTIFF key {VERTICAL_EPSG} = {code}")
    names = [(HEIGHT_CITATION, str(keys.get(HEIGHT_CITATION, "")))]
    names += [(key, parts[1]) for key, parts in cited.items() if len(parts) > 1]
    return across, upward or next(filter(None, (_cited_unit(*name) for name in names)), None)


def _cited_unit(key: int, name: str) -> _Unit | None:
    """Return the unit that the name of a system in a citation holds."""
    for unit, metres in _CITED:
        if found := unit.search(name):
            return _Unit(metres, f"GeoTIFF key {key} {found[0]!r}")
    return None


def _key_unit(keys: Mapping[int, int | float | str], code: int, size: int) -> _Unit | None:
    """Return the unit that a key names by its EPSG code, or another by its size [m]."""
    number, metres = keys.get(code), keys.get(size)
    if isinstance(number, int) and number not in NO_CODE:
        angular = 9101 <= number <= 9122
        return _Unit(EPSG_METRES.get(number), f"GeoTIFF key {code} = {number}", angular)
    if isinstance(metres, float) and metres > 0:
        return _Unit(metres, f"GeoTIFF key {size} = {metres:.12g}")
    return None


class _Node(NamedTuple):
    """Node of WKT, in capitals, and what it holds: texts, numbers as text, and nodes."""

    name: str
    values: list["str | _Node"]

    def child(self, names: set[str]) -> "_Node | None":
        """Return the first node of one of these names right inside this one."""
        return next((v for v in self.values if isinstance(v, _Node) and v.name in names), None)


_UNPRINTABLE = re.compile(r"[^ -~]")
_TOKEN = re.compile(r'"((?:[^"]|"")*)"|([\[(])|([\])])|([^\s,\[\]()"]+)')


def _wkt(found: Mapping[int, bytes]) -> str:
    return found.get(WKT, b"").split(b"\0")[0].decode("utf-8", "replace").strip()


def _parse_wkt(text: str) -> tuple[_Node | None, bool]:
    """Return a node that holds those of WKT, None if they are nested too deeply, and whether all end.

    Some programs write the system of heights behind the other, without a node around both.
    """
    path = [_Node("COMPOUNDCRS", [])]
    for quoted, opens, closes, word in _TOKEN.findall(text):
        values = path[-1].values
        if len(path) > DEEPEST:
            return None, True
        if opens:
            name = values.pop() if values and isinstance(values[-1], str) else ""
            assert isinstance(name, str)
            values.append(_Node(name.upper(), []))
            path.append(values[-1])  # type: ignore[arg-type]  # the node
        elif not closes:
            values.append(word or quoted)
        elif len(path) > 1:
            path.pop()
    return path[0], len(path) == 1


def _wkt_units(node: _Node) -> tuple[_Unit | None, _Unit | None]:
    """Return the units of x and y and of heights that a system in WKT states."""
    if node.name in OUTER_NODES:
        across = upward = None
        for part in (value for value in node.values if isinstance(value, _Node)):
            of_part = _wkt_units(part)
            across, upward = across or of_part[0], upward or of_part[1]
        return across, upward
    if node.name in VERTICAL_NODES:
        return None, _node_unit(node, node)
    kind = node.child({"CS"})
    if node.name in GEOGRAPHIC_NODES or (
        node.name in GEODETIC_NODES and kind and "ellipsoidal" in kind.values
    ):
        return _Unit(None, f"its WKT {node.name}", True), None
    if node.name not in PLANE_NODES | GEODETIC_NODES:
        return None, None
    axes = [part for part in node.values if isinstance(part, _Node) and part.name == "AXIS"]
    return _node_unit(node, node), _node_unit(axes[2], node) if len(axes) > 2 else None


def _node_unit(holder: _Node, system: _Node) -> _Unit | None:
    """Return the unit right inside a node of a system, or inside its first axis."""
    axis = holder.child({"AXIS"})
    unit = holder.child(UNIT_NODES) or (axis and axis.child(UNIT_NODES))
    if unit is None or len(unit.values) < 2:
        return None
    name, size = (_UNPRINTABLE.sub("?", str(value))[:40] for value in unit.values[:2])
    where = f"its WKT {system.name} {unit.name} {name!r} of {size}"
    try:
        metres = float(size)
    except ValueError:
        metres = 0.0
    return _Unit(metres if 0 < metres < math.inf else None, where, unit.name == "ANGLEUNIT")
