"""Units of a scan's coordinates: their names, and their lengths in metres."""

import math

# Length units [m]. "us-ft": the US survey foot, which older state plane coordinates use.
METRES = {
    "m": 1.0,
    "mm": 1e-3,
    "cm": 1e-2,
    "dm": 1e-1,
    "km": 1e3,
    "in": 0.0254,
    "ft": 0.3048,
    "us-ft": 1200 / 3937,
    "yd": 0.9144,
}
# Units of a file in degrees of latitude and longitude, and in a unit whose length is not known. A
# build does not take them.
DEGREES, UNKNOWN = "deg", "?"
# A stated length names the unit that it equals within this relative difference. Files round the
# US survey foot to 0.3048006, a difference of 3e-8; it differs from the foot by 2e-6.
SAME_UNIT = 1e-7
# Form of a unit in messages.
EXPECTED_UNITS = (
    f'{", ".join(METRES)}, a number of metres such as "0.3047972654", or two of these for x and y, and for '
    'heights, such as "m+us-ft"'
)


def axis_metres(units: str) -> tuple[float, float, float] | None:
    """Return the lengths [m] of the units of x, y and z, where z is up; None for text that is no unit.

    units: a key of METRES, or the length of another unit in metres as decimal text; for heights in
    another unit than x and y, two of these with "+" between them.
    """
    horizontal, plus, vertical = units.partition("+")
    across = _metres(horizontal)
    upward = _metres(vertical) if plus else across
    return None if across is None or upward is None else (across, across, upward)


def _metres(unit: str) -> float | None:
    try:
        metres = METRES[unit] if unit in METRES else float(unit)
    except ValueError:
        return None
    return metres if 0 < metres < math.inf else None


def unit_name(metres: float) -> str:
    """Return the name of a unit of this length [m], or the length as text if no unit has it."""
    for name, length in METRES.items():
        if math.isclose(metres, length, rel_tol=SAME_UNIT):
            return name
    return repr(metres)
