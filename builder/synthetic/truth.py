"""Ground truth of a generated scene: reference figures for tests of scans and of the engine.

Frame: the façade's own, metres, z up, x along the façade, the visitor's side at negative y, ground
at z = 0; `FacadeTruth.origin` moves it into the world. The figures are those the mesh was built
from, before any noise.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import msgspec

from ...schemas.errors import ScanError

Truth = TypeVar("Truth")


@dataclass(frozen=True, slots=True)
class DoorTruth:
    """Open door through the wall: two vertical jambs from sill to springing, a pointed arch above.

    x_left, x_right: the jamb planes; their difference is the clear width.
    y_front, y_back: the wall's faces.
    """

    name: str
    x_left: float
    x_right: float
    y_front: float
    y_back: float
    sill: float
    springing: float
    apex: float

    @property
    def width(self) -> float:
        """Return the clear width [m]."""
        return self.x_right - self.x_left


@dataclass(frozen=True, slots=True)
class StepTruth:
    """One step of a stair: a tread at height z, from its riser at y_front to the next riser or wall."""

    stair: str
    x_left: float
    x_right: float
    y_front: float
    y_back: float
    z: float


@dataclass(frozen=True, slots=True)
class ColumnTruth:
    """Free-standing round column: a shaft between a base and a capital, both wider by `collar`."""

    name: str
    x: float
    y: float
    radius: float
    collar: float
    z_low: float
    z_high: float


@dataclass(frozen=True, slots=True)
class WallTruth:
    """Plane piece of wall: coordinate `axis` equals `offset`, seen from the side `facing` (+1 or -1).

    low, high: the extent along the other horizontal axis.
    z_low, z_high: the extent in height.
    """

    name: str
    axis: str
    offset: float
    facing: int
    low: float
    high: float
    z_low: float
    z_high: float


@dataclass(frozen=True, slots=True)
class FacadeTruth:
    """One façade: all figures in its own frame; world = own + origin."""

    seed: int
    origin: tuple[float, float, float]
    floor: float
    doors: tuple[DoorTruth, ...]
    steps: tuple[StepTruth, ...]
    columns: tuple[ColumnTruth, ...]
    walls: tuple[WallTruth, ...]

    def door(self, name: str) -> DoorTruth:
        """Return the door of this name: `main`, `left` or `right`."""
        return next(door for door in self.doors if door.name == name)

    def column(self, name: str) -> ColumnTruth:
        """Return the column of this name."""
        return next(column for column in self.columns if column.name == name)

    def wall(self, name: str) -> WallTruth:
        """Return the wall of this name."""
        return next(wall for wall in self.walls if wall.name == name)


@dataclass(frozen=True, slots=True)
class StationTruth:
    """Position of one scan, world frame, and the number of its points.

    number: from 1; the point_source_id in LAZ.
    yaw: rotation of the scanner about z [rad].
    step: angle between neighbouring rays [rad].
    """

    number: int
    position: tuple[float, float, float]
    yaw: float
    step: float
    points: int


@dataclass(frozen=True, slots=True)
class SceneTruth:
    """Content of the file `<name>.truth.json` beside a scan."""

    seed: int
    points: int
    noise: float
    stations: tuple[StationTruth, ...]
    facades: tuple[FacadeTruth, ...]


@dataclass(frozen=True, slots=True)
class StrayTruth:
    """Stray points of one scan: points `first` to `first + count` of the scan, from 0.

    kind: "dust" or "person".
    station: the station's number.
    """

    kind: str
    station: int
    first: int
    count: int


@dataclass(frozen=True, slots=True)
class OfficeTruth:
    """Content of the file `<name>.truth.json` beside the scans of an office.

    door: from the room to the corridor.
    strays: the stray points; all others are points of surfaces.
    """

    seed: int
    points: int
    noise: float
    stations: tuple[StationTruth, ...]
    door: DoorTruth
    strays: tuple[StrayTruth, ...]


def write_truth(path: Path, truth: SceneTruth | OfficeTruth) -> None:
    """Write the truth as indented JSON; the same truth gives the same bytes."""
    path.write_bytes(msgspec.json.format(msgspec.json.encode(truth), indent=1) + b"\n")


def read_truth(path: Path) -> SceneTruth:
    """Read the truth of façades. Raises ScanError where the file is something else."""
    return _read(path, SceneTruth)


def read_office_truth(path: Path) -> OfficeTruth:
    """Read the truth of an office. Raises ScanError where the file is something else."""
    return _read(path, OfficeTruth)


def _read(path: Path, kind: type[Truth]) -> Truth:
    """Read a file of `write_truth`."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=kind)
    except OSError as error:
        raise ScanError(
            f"{path}: cannot be read ({error.strerror}): give the .truth.json of a generated scene"
        ) from error
    except msgspec.MsgspecError as error:
        raise ScanError(
            f"{path}: not the truth of a generated scene ({error}): make the scene again"
        ) from error
