"""Lists of scans, as TOML: written from entries, and read back after edits by hand. Opens no scan.

scan_files.py makes the entries and opens the scans that a list names.
"""

import math
import os
import re
import sys
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tomli_w
from numpy.typing import NDArray

from ...schemas.errors import BadRequestError
from ...schemas.runtime.new_file import new_file
from ...schemas.runtime.text_encoding import decode_text
from .common.units import DEGREES, EXPECTED_UNITS, UNKNOWN, axis_metres
from .placed_scan import TURNS

LIST_SUFFIX = ".toml"
_VERSION = 1

# Code points that represent bytes of a file name that is not UTF-8.
_BROKEN_NAME = re.compile("[\ud800-\udfff]")

_HEAD = """\
# Scans for `solidcloud build`, as their headers describe them. Edit by hand:
#   use    false leaves a scan out: the archive has no information about its region.
#   units  unit of length in the file; without this line, what the file states, else metres:
#          {units}.
#   scale  additional factor of the coordinates.
#   up     axis of the file that points up: z, y or x; without this line, what its format has. Scans
#          are turned to make it z.
#   pose   four rows of four: where the scan is, in metres with z up, after units, scale and up. The value
#          written here is the file's own pose, in its own units; unchanged or removed, it is applied first.
# For information only: count, low and high (declared bounds in the file's units), crs, sha256, fault.
"""


@dataclass(frozen=True, slots=True, eq=False)
class ScanEntry:
    """Entry of a scan list.

    path, index: file, and number of the scan in it, from 0.  format: as in `Scan`, "" if not known.
    count: points that the header declares; None: not declared.
    bounds: (2, 3) as declared, in the file's units, in its frame or where its pose puts it; None:
    not declared.
    pose: (4, 4), or None.  units: see `axis_metres`, up: a key of TURNS; "": what the file states.
    scale: additional factor.
    crs: text of the coordinate reference system, or "".  sha256: of the file, "" if not requested.
    use: whether a build reads the scan.  fault: why it cannot be read, or "".
    warnings: what looks wrong, one line each.  columns: see `Scan`.  classes: points that were
    read, by class and flag (`Scan.count_classes`); None: not counted. These three are not written
    to a list.
    """

    path: Path
    index: int = 0
    format: str = ""
    count: int | None = None
    bounds: NDArray[np.float64] | None = None
    pose: NDArray[np.float64] | None = None
    units: str = ""
    up: str = ""
    scale: float = 1.0
    crs: str = ""
    sha256: str = ""
    use: bool = True
    fault: str = ""
    warnings: tuple[str, ...] = ()
    columns: tuple[str, ...] = ()
    classes: Mapping[str, int] | None = None


def write_scan_list(path: Path, entries: Sequence[ScanEntry]) -> None:
    """Write a list of scans as TOML, with paths relative to it.

    Replaces an existing file atomically.

    Raise BadRequestError for a file name that is not UTF-8, which TOML cannot hold.
    """
    folder = Path(path).parent
    tables = [_table(entry, folder) for entry in entries]
    head = _HEAD.format(units=EXPECTED_UNITS)
    text = head + "\n" + tomli_w.dumps({"version": _VERSION, "scan": tables})
    for entry in entries:
        if _BROKEN_NAME.search(str(entry.path)):
            raise BadRequestError(
                f"{str(entry.path)!r}: the file name is not UTF-8, which a list cannot hold: rename the file, or build "
                "without a list"
            )
    # Other broken text is informational only: replace what is not UTF-8.
    data = _BROKEN_NAME.sub("\ufffd", text).encode()
    with new_file(Path(path)) as file:
        file.write(data)


def _table(entry: ScanEntry, folder: Path) -> dict[str, Any]:
    """Make the table of one scan, without unknown values."""
    low, high = ([], []) if entry.bounds is None else entry.bounds.tolist()
    table = {
        "path": _relative(entry.path, folder),
        "index": entry.index,
        "use": entry.use,
        "units": entry.units,
        "scale": float(entry.scale),
        "up": entry.up,
        "pose": [] if entry.pose is None else entry.pose.tolist(),
        "format": entry.format,
        "count": entry.count,
        "low": low,
        "high": high,
        "crs": entry.crs,
        "sha256": entry.sha256,
        "fault": entry.fault,
    }
    return {name: value for name, value in table.items() if value not in (None, "", [])}


def _relative(path: Path, folder: Path) -> str:
    """Return a path relative to a folder, with slashes."""
    seen = os.path.relpath(os.path.abspath(path), os.path.abspath(folder))
    if seen.startswith(".."):
        # If the folder is reached by a link, ".." leads elsewhere.
        seen = os.path.relpath(path.resolve(), folder.resolve())
    return Path(seen).as_posix()


def read_scan_list(path: Path) -> list[ScanEntry]:
    """Read a list of scans, possibly edited by hand. Opens no scan.

    Raise BadRequestError that names the file, the scan and the field, what was found and what was
    expected.
    """
    path = Path(path)
    text = ""
    try:
        text = decode_text(path.read_bytes())
        document = tomllib.loads(text)
    except (OSError, ValueError) as error:
        found = _long_number(text) or error
        raise BadRequestError(
            f"{path}: {found}, expected a list of scans: correct it, or write it with `solidcloud inspect`"
        ) from error
    unknown = sorted(set(document) - {"version", "scan"})
    if unknown or document.get("version", _VERSION) != _VERSION or not isinstance(document.get("scan"), list):
        found = f"unknown {unknown[0]}" if unknown else f"version {_short_text(document.get('version'))}"
        raise BadRequestError(f"{path}: {found}, expected version = {_VERSION} and a [[scan]] for each scan")
    entries = [_entry(path, number, table) for number, table in enumerate(document["scan"], 1)]
    seen: dict[tuple[str, int], int] = {}
    for number, entry in enumerate(entries, 1):
        first = seen.setdefault((os.path.realpath(entry.path), entry.index), number)
        if first != number:
            raise BadRequestError(
                f"{path}: scan {number} ({entry.path}, index {entry.index}): the same as scan {first}, "
                "expected each scan once: remove one"
            )
    return entries


def _long_number(text: str) -> str:
    """Return the position of a number with more digits than Python reads, or "".

    Python's own error does not tell the line.
    """
    most = sys.get_int_max_str_digits()
    found = re.search(rf"[0-9_]{{{most + 1},}}", text) if most else None
    if found is None:
        return ""
    line = text.count("\n", 0, found.start()) + 1
    return f"a number of {len(found[0])} digits (at line {line})"


def _short_text(value: Any) -> str:
    """Return the beginning of a value as text for a message."""
    try:
        return str(value)[:80]
    except ValueError:  # a hexadecimal number may be too long to be converted to decimal
        return "a number of very many digits"


class _Field(NamedTuple):
    """Constraint on a field of a table. good: predicate of valid values."""

    expected: str
    good: Any


def _is_number(value: Any) -> bool:
    if isinstance(value, int):  # TOML integers have any length
        return not isinstance(value, bool) and abs(value) <= sys.float_info.max
    return isinstance(value, float) and math.isfinite(value)


def _is_numbers(value: Any, length: int) -> bool:
    return isinstance(value, list) and len(value) == length and all(map(_is_number, value))


def _is_pose(value: Any) -> bool:
    rows = isinstance(value, list) and len(value) == 4 and all(_is_numbers(row, 4) for row in value)
    return rows and list(value[3]) == [0, 0, 0, 1] and np.linalg.matrix_rank(np.array(value, float)) == 4


def _is_whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 1 << 63


def _is_units(value: Any) -> bool:
    # A list that `inspect` wrote for a file without a unit of length says so until it is edited.
    return isinstance(value, str) and (value in (DEGREES, UNKNOWN) or axis_metres(value) is not None)


_TEXT = _Field("text in quotes", lambda value: isinstance(value, str))
_FIELDS = {
    "path": _Field(
        "the path of a file, seen from the list", lambda v: isinstance(v, str) and v and "\0" not in v
    ),
    "index": _Field("a whole number, 0 or more, of 63 bits", _is_whole),
    "use": _Field("true or false", lambda value: isinstance(value, bool)),
    "units": _Field(EXPECTED_UNITS, _is_units),
    "scale": _Field("a number above 0", lambda value: _is_number(value) and value > 0),
    "up": _Field(" or ".join(TURNS), lambda value: isinstance(value, str) and value in TURNS),
    "pose": _Field("four rows of four numbers that move points, the last 0 0 0 1", _is_pose),
    "format": _TEXT,
    "count": _Field("a whole number, 0 or more, of 63 bits", _is_whole),
    "low": _Field("three numbers", lambda value: _is_numbers(value, 3)),
    "high": _Field("three numbers", lambda value: _is_numbers(value, 3)),
    "crs": _TEXT,
    "sha256": _TEXT,
    "fault": _TEXT,
}


def _entry(path: Path, number: int, table: Any) -> ScanEntry:
    """Make an entry from a table; check every field."""
    name = table.get("path", "without path") if isinstance(table, dict) else "no table"
    where = f"{path}: scan {number} ({name})"
    if not isinstance(table, dict) or "path" not in table:
        raise BadRequestError(f'{where}: no path, expected the path of its file: give path = "..."')
    for field, value in table.items():
        if field not in _FIELDS:
            raise BadRequestError(
                f"{where}: unknown field {field!r}, expected one of {', '.join(_FIELDS)}: correct or remove it"
            )
        if not _FIELDS[field].good(value):
            raise BadRequestError(
                f"{where}: {field} is {_short_text(value)!r}, expected {_FIELDS[field].expected}: correct it"
            )
    if ("low" in table) != ("high" in table):
        raise BadRequestError(f"{where}: low or high alone, expected both or none: remove it")
    return ScanEntry(
        path.parent / table["path"],
        table.get("index", 0),
        table.get("format", ""),
        table.get("count"),
        np.array([table["low"], table["high"]], np.float64) if "low" in table else None,
        np.array(table["pose"], np.float64) if "pose" in table else None,
        table.get("units", ""),
        table.get("up", ""),
        float(table.get("scale", 1.0)),
        table.get("crs", ""),
        table.get("sha256", ""),
        table.get("use", True),
        table.get("fault", ""),
    )
