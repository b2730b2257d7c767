"""CSV files of poses (t,x,y,z,qw,qx,qy,qz, one row per pose), rays and objects; TUM files of poses.

This is the only module that converts between quaternions and matrices.
"""

import csv
import io
import math
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.errors import BadRequestError, ScanError
from ....schemas.runtime.new_file import new_path
from ....schemas.runtime.text_encoding import decode_text

COLUMNS = ("t", "x", "y", "z", "qw", "qx", "qy", "qz")
RAY_COLUMNS = ("x", "y", "z", "dx", "dy", "dz")
OBJECT_COLUMNS = ("avatar", "x", "y", "z", "qw", "qx", "qy", "qz", "group", "mask")
# A quaternion that deviates more than this from unit length is a mistake, not rounding
# (NUMERICS.md, case 4): using |q| = 1.01 without normalising it would scale space by 2 %.
UNIT_WITHIN = 1e-6
# In TUM files, which round to four digits.
TUM_UNIT_WITHIN = 1e-3
# Suffixes of files in the format of the TUM RGB-D benchmark; others are CSV.
TUM_SUFFIXES = (".tum", ".txt")


class ObjectRow(NamedTuple):
    """One object of an objects file. avatar: file of its points.  pose: (4, 4)."""

    avatar: Path
    pose: NDArray[np.float64]
    group: int
    mask: int


def read_poses(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Read times (k,) [s] and poses (k, 4, 4), avatar to world [m], from a CSV file.

    The first line names the columns, in any order. Quaternions within 1e-6 of unit length are
    normalised.
    Raises ScanError if the file cannot be read, BadRequestError naming the line if a line is
    invalid.
    """
    return _csv_poses(str(path), _text(path, "a CSV file of poses"))


def read_tum_poses(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Read times (k,) [s] and poses (k, 4, 4), avatar to world [m], from a file in the TUM format.

    A line holds `timestamp tx ty tz qx qy qz qw`; lines that begin with # are comments. Quaternions
    within 1e-3 of unit length are normalised.
    Raises the same errors as `read_poses`.
    """
    return _tum_poses(str(path), _text(path, "a TUM file of poses"))


def read_path(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Read times (k,) [s] and poses (k, 4, 4) from a file of either format, by its suffix.

    Raises the same errors as `read_poses`.
    """
    return (read_tum_poses if path.suffix.lower() in TUM_SUFFIXES else read_poses)(path)


def parse_path(name: str, text: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return times (k,) [s] and poses (k, 4, 4) of a file's text, as `read_path` does.

    name: of the file; its suffix selects the format, and errors name it.
    """
    return (_tum_poses if Path(name).suffix.lower() in TUM_SUFFIXES else _csv_poses)(name, text)


def _text(path: Path, expected: str) -> str:
    """Return the text of a file. Raise ScanError."""
    try:
        # Comments in another encoding do not matter, and file names keep their bytes.
        return decode_text(path.read_bytes(), "surrogateescape")
    except OSError as error:
        raise ScanError(f"{path}: {error.strerror}: expected {expected}: check the path") from None
    except UnicodeDecodeError as error:  # UTF-16 of an odd number of bytes
        raise ScanError(f"{path}: {error}: expected {expected}: check the file") from None


def _csv_poses(name: str, text: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the times and poses of a CSV file."""
    rows = [
        _unit_quaternion(where, _numbers(where, row), 4) for where, row in _rows(name, text, COLUMNS, "poses")
    ]
    table = np.array(rows, np.float64).reshape(-1, len(COLUMNS))
    return table[:, 0].copy(), _matrices(table)


def _tum_poses(name: str, text: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the times and poses of a file in the TUM format."""
    rows = []
    for number, line in enumerate(text.splitlines(), 1):
        values = line.split()
        if not values or values[0].startswith("#"):
            continue
        where = f"{name}, line {number}"
        if len(values) != len(COLUMNS):
            raise BadRequestError(f"{where}: {len(values)} values: expected timestamp tx ty tz qx qy qz qw")
        t, x, y, z, qx, qy, qz, qw = _numbers(where, values)
        rows.append(_unit_quaternion(where, [t, x, y, z, qw, qx, qy, qz], 4, TUM_UNIT_WITHIN))
    table = np.array(rows, np.float64).reshape(-1, len(COLUMNS))
    return table[:, 0].copy(), _matrices(table)


def read_rays(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Read origins (k, 3) and directions (k, 3), world frame [m], from a CSV file x,y,z,dx,dy,dz.

    Raises the same errors as `read_poses`.
    """
    rows = [_numbers(where, row) for where, row in _read_rows(path, RAY_COLUMNS, "rays")]
    table = np.array(rows, np.float64).reshape(-1, len(RAY_COLUMNS))
    return table[:, :3].copy(), table[:, 3:].copy()


def read_objects(path: Path) -> list[ObjectRow]:
    """Read the objects of a CSV file avatar,x,y,z,qw,qx,qy,qz,group,mask.

    avatar: a file of points, relative to the folder of the CSV file.
    group, mask: integers; the prefixes 0x and 0b are allowed.
    Raises the same errors as `read_poses`.
    """
    found = []
    for where, row in _read_rows(path, OBJECT_COLUMNS, "objects"):
        values = _unit_quaternion(where, _numbers(where, row[1:8]), 3)
        try:
            group, mask = (int(value, 0) for value in row[8:])
        except ValueError as error:
            raise BadRequestError(f"{where}: {error}: expected integers for group and mask") from None
        pose = _matrices(np.array([[0.0, *values]]))[0]
        found.append(ObjectRow(path.parent / row[0], pose, group, mask))
    return found


def _read_rows(path: Path, columns: tuple[str, ...], what: str) -> Iterator[tuple[str, list[str]]]:
    """Yield the location (file and line) and the values, ordered as `columns`, of each CSV row."""
    return _rows(str(path), _text(path, f"a CSV file of {what}"), columns, what)


def _rows(name: str, text: str, columns: tuple[str, ...], what: str) -> Iterator[tuple[str, list[str]]]:
    """Yield the location and the values of each row of a CSV file's text."""
    reader = csv.reader(io.StringIO(text, newline=""))
    try:
        header = [each.strip() for each in next(reader, [])]
        if sorted(header) != sorted(columns):
            raise BadRequestError(
                f"{name}, line 1: columns {','.join(header)[:80] or 'missing'}: expected {','.join(columns)}"
            )
        order = [header.index(each) for each in columns]
        for row in reader:
            if not row:
                continue
            where = f"{name}, line {reader.line_num}"
            if len(row) != len(columns):
                raise BadRequestError(f"{where}: {len(row)} values: expected {len(columns)}, one per column")
            yield where, [row[column].strip() for column in order]
    except csv.Error as error:
        raise ScanError(f"{name}: {error}: expected a CSV file of {what}: check the file") from None


def write_poses(path: Path, times: NDArray[np.float64], poses: NDArray[np.float64]) -> None:
    """Write times (k,) [s] and rigid poses (k, 4, 4) as a pose file, completely or not at all."""
    rows = (
        (t, *pose[:3, 3].tolist(), *_quaternion(pose[:3, :3]))
        for t, pose in zip(times.tolist(), poses, strict=True)
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    with new_path(path) as temporary, temporary.open("w", newline="", encoding="ascii") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        writer.writerows([repr(float(value)) for value in row] for row in rows)


def _numbers(where: str, row: list[str]) -> list[float]:
    """Parse a row of finite numbers."""
    try:
        values = [float(value) for value in row]
    except ValueError as error:
        raise BadRequestError(f"{where}: {error}: expected numbers") from None
    if not all(map(math.isfinite, values)):
        raise BadRequestError(f"{where}: {','.join(row)}: expected finite numbers")
    return values


def _unit_quaternion(where: str, values: list[float], first: int, within: float = UNIT_WITHIN) -> list[float]:
    """Return the values with those from `first` on, a quaternion, checked and normalised."""
    length = math.hypot(*values[first:])
    if abs(length - 1) > within:
        raise BadRequestError(
            f"{where}: quaternion of length {length:.9g}: expected 1 within {within:g}: normalise it"
        )
    return values[:first] + [value / length for value in values[first:]]


def _matrices(table: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convert rows of COLUMNS, with unit quaternions, to poses (k, 4, 4)."""
    w, x, y, z = table[:, 4:].T
    poses = np.zeros((len(table), 4, 4))
    poses[:, 0, 0], poses[:, 0, 1], poses[:, 0, 2] = (
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
    )
    poses[:, 1, 0], poses[:, 1, 1], poses[:, 1, 2] = (
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
    )
    poses[:, 2, 0], poses[:, 2, 1], poses[:, 2, 2] = (
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    )
    poses[:, :3, 3] = table[:, 1:4]
    poses[:, 3, 3] = 1.0
    return poses


def _quaternion(turn: NDArray[np.float64]) -> tuple[float, float, float, float]:
    """Return the unit quaternion (w, x, y, z) of a rotation (3, 3).

    Divides by the largest component, for accuracy.
    """
    m = turn.tolist()
    # 4 w², 4 x², 4 y², 4 z².
    squares = [
        1 + m[0][0] + m[1][1] + m[2][2],
        1 + m[0][0] - m[1][1] - m[2][2],
        1 - m[0][0] + m[1][1] - m[2][2],
        1 - m[0][0] - m[1][1] + m[2][2],
    ]
    k = max(range(4), key=squares.__getitem__)
    # Four times the products of component k with each of w, x, y and z.
    products = [
        (squares[0], m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1]),
        (m[2][1] - m[1][2], squares[1], m[1][0] + m[0][1], m[0][2] + m[2][0]),
        (m[0][2] - m[2][0], m[1][0] + m[0][1], squares[2], m[2][1] + m[1][2]),
        (m[1][0] - m[0][1], m[0][2] + m[2][0], m[2][1] + m[1][2], squares[3]),
    ][k]
    length = math.hypot(*products)
    w, x, y, z = (value / length for value in products)
    return w, x, y, z
