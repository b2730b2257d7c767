"""Test the units that LAS files state, by GeoTIFF keys and WKT, and how far they move the points."""

import struct
from pathlib import Path

import laspy
import numpy as np
import pytest
from solidcloud.builder.sources.formats.las_crs import GEO_DOUBLES, GEO_KEYS, GEO_TEXTS, WKT, stated_units
from solidcloud.builder.sources.placed_scan import axis_metres, place_scan
from solidcloud.builder.sources.scan_files import header_bounds, open_scans
from solidcloud.schemas.errors import ScanError

FOOT, METRE, DEGREE = 'UNIT["US survey foot",0.3048006]', 'UNIT["metre",1]', 'UNIT["degree",0.01745]'
US_FOOT = 1200 / 3937
GEOGRAPHIC = f'GEOGCS["NAD83",DATUM["x",SPHEROID["s",6378137,298]],PRIMEM["G",0],{DEGREE}]'
PLANE = f'PROJCS["p",{GEOGRAPHIC},PROJECTION["L"],PARAMETER["f",1],%s,AXIS["X",EAST]]'
PLANE_2 = (
    'PROJCRS["p",BASEGEOGCRS["b",DATUM["d",ELLIPSOID["e",6378137,298,LENGTHUNIT["metre",1]]]],CONVERSION["c",'
    'METHOD["m"],PARAMETER["e",1,LENGTHUNIT["metre",1]]],CS[Cartesian,2],AXIS["x",east%s],AXIS["y",north%s]%s]'
)
FOOT_2 = ',LENGTHUNIT["US survey foot",0.304800609601219]'
METRE_2 = ',LENGTHUNIT["metre",1]'
HEIGHT = 'VERT_CS["h",VERT_DATUM["d",2005],%s,AXIS["Up",UP]]'


def keys(*entries: tuple[int, int], doubles: tuple[float, ...] = ()) -> dict[int, bytes]:
    """Make the GeoTIFF records of (key, value); the value of a key of a size is its place in doubles."""
    words = [1, 1, 0, len(entries)]
    for key, value in entries:
        words += [key, GEO_DOUBLES if key in (2053, 3077) else 0, 1, value]
    return {
        GEO_KEYS: struct.pack(f"<{len(words)}H", *words),
        GEO_DOUBLES: struct.pack(f"<{len(doubles)}d", *doubles),
    }


STATED = [
    (keys((1024, 1), (3072, 2264), (3076, 9003)), "us-ft"),
    (keys((1024, 1), (3076, 9002)), "ft"),
    (keys((1024, 1), (3076, 9001), (4099, 9003)), "m+us-ft"),
    (keys((1024, 1), (3076, 9002), (4099, 9001)), "ft+m"),
    (keys((3076, 32767), (3077, 1), doubles=(0.0, 0.5)), "0.5"),
    (keys((1024, 3), (2052, 9001)), "m"),
    (keys((4099, 9002)), "m+ft"),
    (keys((1024, 1), (3076, 9999)), "?"),
    (keys((1024, 2), (2048, 4269), (2054, 9102)), "deg"),
    (keys((2054, 9102)), "deg"),
    (keys((1024, 1), (2048, 4269), (2054, 9102), (3072, 26910)), None),
    (keys((1024, 1), (3076, 32767)), None),
    (PLANE % FOOT, "us-ft"),
    (PLANE % 'UNIT["metre",1,AUTHORITY["EPSG","9001"]]', "m"),
    (PLANE % 'UNIT["foot",3.048e-1]', "ft"),
    (f'COMPD_CS["c",{PLANE % FOOT},{HEIGHT % METRE}]', "us-ft+m"),
    (f'COMPD_CS["c",{PLANE % METRE},{HEIGHT % FOOT}]', "m+us-ft"),
    (f'LOCAL_CS["site (a] b""c)",{FOOT}]', "us-ft"),
    (f'{PLANE % METRE},VERTCS["h",VDATUM["d"],PARAMETER["Direction",1],{FOOT}]', "m+us-ft"),
    (GEOGRAPHIC, "deg"),
    (f'COMPD_CS["c",{GEOGRAPHIC},{HEIGHT % FOOT}]', "deg"),
    ('GEOCCS["g",DATUM["d"],UNIT["metre",1]]', "m"),
    (PLANE_2 % (FOOT_2, FOOT_2, ""), "us-ft"),
    (PLANE_2 % ("", "", FOOT_2), "us-ft"),
    (f'BOUNDCRS[SOURCECRS[{PLANE_2 % ("", "", FOOT_2)}],TARGETCRS[{GEOGRAPHIC}]]', "us-ft"),
    (f'COMPOUNDCRS["c",{PLANE_2 % ("", "", METRE_2)},VERTCRS["v",CS[vertical,1],AXIS["h",up{FOOT_2}]]]', "m+us-ft"),
    ('GEODCRS["g",CS[ellipsoidal,2],AXIS["lat",north,ANGLEUNIT["degree",0.017]]]', "deg"),
    ('GEODCRS["g",CS[Cartesian,3],AXIS["x",geocentricX,LENGTHUNIT["metre",1]]]', "m"),
    (PLANE % 'UNIT["ell"]', None),
    (PLANE % 'UNIT["ell",nothing]', "?"),
    ("EPSG:2264", None),
    ("COMPD_CS[" * 5000 + "]" * 5000, None),
    ("", None),
    (keys((1024, 1), (3072, 26910), (4096, 6360)), "m+us-ft"),
    (keys((1024, 1), (3072, 26910), (4096, 5703)), None),
    (PLANE % 'UNIT["millimetre",0.001]', "mm"),
]  # fmt: skip


@pytest.mark.parametrize(("record", "units"), STATED)
def test_the_unit_that_a_file_states_is_found(record: dict | str, units: str | None) -> None:
    """Issue 35, row 5."""
    found = stated_units({WKT: record.encode()} if isinstance(record, str) else record)
    assert (found and found.name) == units
    if found and found.name == "m":
        assert found.note == ""


CITED = [
    ({3073: "NAD83 / New York Long Island (ftUS)"}, "us-ft"),
    ({3073: "NAD83 / Oregon GIC Lambert (ft)", 4097: "NAVD88 height (ftUS)"}, "ft+us-ft"),
    ({1026: "NAD_1983_StatePlane_Texas_Central_FIPS_4203_Feet"}, "us-ft"),
    ({1026: "NAD_1983_StatePlane_Oregon_North_FIPS_3601_Feet_Intl"}, "ft"),
    ({1026: "NAD83 / UTM zone 10N + NAVD88 height (ftUS)"}, "m+us-ft"),
    ({1026: "Leica Foot scan (fts)", 3073: "UTM 33, a foot high"}, None),
]


@pytest.mark.parametrize(("texts", "units"), CITED)
def test_the_unit_in_the_name_of_a_system_is_found(texts: dict[int, str], units: str | None) -> None:
    """Issue 35: many files state feet in the name alone. A key of the unit has precedence."""
    words, data = [1, 1, 0, 1 + len(texts), 1024, 0, 1, 1], b""
    for key, text in sorted(texts.items()):
        words += [key, GEO_TEXTS, len(text) + 1, len(data)]
        data += text.encode() + b"|"
    record = {GEO_KEYS: struct.pack(f"<{len(words)}H", *words), GEO_TEXTS: data}
    found = stated_units(record)
    assert (found and found.name) == units
    words[3] += 1
    record[GEO_KEYS] = struct.pack(f"<{len(words) + 4}H", *words, 3076, 0, 1, 9001)
    found = stated_units(record)
    assert found is not None and found.name.partition("+")[0] == "m"


def test_a_code_that_may_be_in_feet_without_its_unit_is_told() -> None:
    found = stated_units(keys((1024, 1), (3072, 2263)))
    assert found is not None and found.name == "m"
    assert found.note == (
        "GeoTIFF key 3072 = 2263 may be a system in feet, but no key states the unit: taken as metres, "
        "otherwise set units in a list of `solidcloud inspect`"
    )


def test_text_that_ends_too_soon_states_nothing() -> None:
    """A size without its last digits is another one."""
    found = stated_units({WKT: (PLANE % FOOT)[:-25].encode()})
    assert found is not None and found.name == "m" and "ends too soon" in found.note


def written(
    path: Path, xyz: np.ndarray, record: str | dict, *, after: bool = False, scale: float = 0.001
) -> Path:
    """Write a LAS or LAZ file with projection records before the points, or after them."""
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = [scale] * 3, xyz.min(axis=0).round()
    las = laspy.LasData(header)
    las.x, las.y, las.z = xyz.T
    found = {WKT: record.encode()} if isinstance(record, str) else record
    records = [laspy.VLR("LASF_Projection", number, "", data) for number, data in found.items()]
    if after:
        las.evlrs = laspy.vlrs.vlrlist.VLRList(records)
    else:
        las.header.vlrs.extend(records)
    las.write(path, laz_backend=laspy.LazBackend.Lazrs)
    return path


ROOM = np.random.default_rng(5).integers(0, 5000, (400, 3)) * 0.001


@pytest.mark.parametrize("after", [False, True])
@pytest.mark.parametrize("name", ["a.las", "a.laz"])
@pytest.mark.parametrize(("record", "units"), [STATED[0], STATED[2], STATED[12], STATED[15], STATED[23]])
def test_points_are_where_the_stated_unit_puts_them(
    record: dict | str, units: str, name: str, after: bool, tmp_path: Path
) -> None:
    metres = np.array(axis_metres(units))
    path = written(tmp_path / name, ROOM / metres + [2e6, 7e5, 100], record, after=after)
    judge = laspy.read(path)
    scan = place_scan(open_scans(path)[0])
    xyz = np.concatenate([block.xyz for block in scan.blocks()])
    assert np.array_equal(xyz, np.column_stack([judge.x, judge.y, judge.z]) * metres)
    assert scan.units == units and "states" in scan.units_note
    assert scan.bounds is not None and (scan.bounds[0] <= xyz).all() and (xyz <= scan.bounds[1]).all()
    assert scan.lattice is not None
    steps = (xyz - scan.lattice.offset) / scan.lattice.scale
    assert np.abs(steps - np.rint(steps)).max() < 1e-5


def test_a_file_in_degrees_is_refused_and_a_given_unit_overrides(tmp_path: Path) -> None:
    path = written(tmp_path / "a.las", ROOM, GEOGRAPHIC)
    with pytest.raises(
        ScanError, match=r"degrees of latitude .* as its WKT GEOGCS states, .* project the scan"
    ):
        place_scan(open_scans(path)[0])
    scan = place_scan(open_scans(path)[0], units="m")
    assert (scan.units, scan.units_note) == ("m", "")
    assert np.array_equal(next(scan.blocks()).xyz, ROOM)


def test_bounds_of_a_damaged_file_are_in_metres_or_not_known(tmp_path: Path) -> None:
    """The unit may be stated behind the points, where a truncated file ends."""
    path = written(tmp_path / "a.las", ROOM / US_FOOT, PLANE % FOOT)
    path.write_bytes(path.read_bytes()[:-100])
    bounds = header_bounds(path)
    assert bounds is not None and np.abs(bounds - [ROOM.min(axis=0), ROOM.max(axis=0)]).max() < 1e-3
    assert np.allclose(header_bounds(path, "ft"), bounds / US_FOOT * 0.3048)
    for record, after in ((GEOGRAPHIC, False), (PLANE % FOOT, True)):
        path = written(tmp_path / "a.las", ROOM, record, after=after)
        path.write_bytes(path.read_bytes()[:-1000])
        assert header_bounds(path) is None
