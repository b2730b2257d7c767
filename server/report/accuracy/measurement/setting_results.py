"""Results of the accuracy report: a row for each setting of a knob, with its cost and its errors."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Bools = NDArray[np.bool_]
Floats = NDArray[np.float64]

# Knobs: the settings that are varied, one at a time.
TOLERANCE, BUDGET, RADIUS = "tolerance", "budget", "radius model"
SHEET = "radius model, a thin sheet with a door"
STEP, DEGREE, LEAF, NODES = "lattice step", "degree", "leaf size", "bounding volume"
# Knobs in the charts of time against error. Degree and leaf size change no answer and hardly any
# time.
SHOWN = (TOLERANCE, BUDGET, RADIUS, STEP, NODES)


@dataclass
class Row:
    """One setting and its results. Results that were not measured are None.

    knob, setting: the parameter that is varied, and its value.
    value: the setting as a number, if it is one.  default: it is the server's default.
    scene: where it was measured.
    factor: of a radius model, on its radii; of a fixed radius, its approximate ratio to the mean
    radius.
    mean_us, p50_us, p99_us: time per pose [us], see interleaved_timing.py.
    times: ratio of mean_us to that of the default setting timed with it.  noise: see TimedSetting.
    poses: number of judged poses.  early: of these, contact where the exact answer is clear.
    late: clear where the exact answer is contact.  unknown: not answered.
    tangent, tangent_early, tangent_late, tangent_unknown: the same for near-tangent poses.
    distance_max_mm, distance_mean_mm: |distance - exact distance| [mm].
    distance_missing: poses where no pair was found although one is in reach.
    doorway_mm: see doorway.py; inf: the figure cannot even stand in the door.
    made_doorway_mm: doorway error measured on generated doors, see measured_doorway.py.
    leak_p50_mm, leak_p99_mm, leak_worst_mm, leak_share: see wall_leak.py.
    archive_bytes, decode_ms: of a build.  node_tests, pair_tests: means over poses.
    front: the errors for which this row is on the Pareto front of the settings in the charts.
    note: remark in words.
    """

    knob: str
    setting: str
    value: float | None = None
    default: bool = False
    scene: str = ""
    factor: float | None = None
    mean_us: float | None = None
    p50_us: float | None = None
    p99_us: float | None = None
    times: float | None = None
    noise: float | None = None
    poses: int = 0
    early: int = 0
    late: int = 0
    unknown: int = 0
    tangent: int = 0
    tangent_early: int = 0
    tangent_late: int = 0
    tangent_unknown: int = 0
    distance_max_mm: float | None = None
    distance_mean_mm: float | None = None
    distance_missing: int = 0
    doorway_mm: float | None = None
    made_doorway_mm: float | None = None
    leak_p50_mm: float | None = None
    leak_p99_mm: float | None = None
    leak_worst_mm: float | None = None
    leak_share: float | None = None
    archive_bytes: int | None = None
    decode_ms: float | None = None
    node_tests: float | None = None
    pair_tests: float | None = None
    front: tuple[str, ...] = ()
    note: str = ""

    @property
    def wrong_share(self) -> float:
        """Return the share (0 to 1) of judged poses whose verdict is wrong or unknown."""
        return (self.early + self.late + self.unknown) / self.poses if self.poses else 0.0

    def as_dict(self) -> dict[str, Any]:
        """Return the fields and `wrong_share`, for JSON and CSV.

        Infinite values become None and are named in the note.
        """
        found = {**asdict(self), "front": list(self.front), "wrong_share": self.wrong_share}
        endless = [
            f"{name} is infinite"
            for name, value in found.items()
            if isinstance(value, float) and math.isinf(value)
        ]
        found["note"] = "; ".join(filter(None, (self.note, *endless)))
        return {
            name: None if isinstance(value, float) and not math.isfinite(value) else value
            for name, value in found.items()
        }


class Report(NamedTuple):
    """Results of all measurements.

    scene: description of the measured scene.
    facts: numbers about the scene and the machine, for JSON and the page.
    """

    scene: str
    rows: list[Row]
    facts: dict[str, Any]


COLUMNS = (*(field.name for field in fields(Row)), "wrong_share")

# Name of an error -> axis label, and attribute of a row.
ERRORS = {
    "doorway": ("doorway error [mm]", "doorway_mm"),
    "leak": ("leak, 99th percentile [mm]", "leak_p99_mm"),
    "wrong": ("wrong or unknown verdicts [share]", "wrong_share"),
    "distance": ("largest distance error [mm]", "distance_max_mm"),
}


USER_ERRORS = ("doorway", "leak")

# Times that differ by less than this factor count as equal: times of one archive built twice
# differed by 6 % on a busy machine.
TIME_TOLERANCE = 1.1


def compare_verdicts(
    row: Row, contact: Bools, unknown: Bools, exact: Bools, *, tangent: bool = False
) -> None:
    """Enter into the row how many verdicts (k,) differ from the exact ones."""
    early = int((contact & ~exact & ~unknown).sum())
    late = int((~contact & exact & ~unknown).sum())
    if tangent:
        row.tangent, row.tangent_early, row.tangent_late = len(exact), early, late
        row.tangent_unknown = int(unknown.sum())
    else:
        row.poses, row.early, row.late, row.unknown = len(exact), early, late, int(unknown.sum())


def compare_distances(row: Row, found: Floats, exact: Floats) -> None:
    """Enter into the row the errors of distances (k,) [m].

    Infinite distances, where no pair was found, are left out.
    """
    both = np.isfinite(found) & np.isfinite(exact)
    row.distance_missing = int((~np.isfinite(found) & np.isfinite(exact)).sum())
    if both.any():
        off = np.abs(found[both] - exact[both]) * 1e3
        row.distance_max_mm, row.distance_mean_mm = float(off.max()), float(off.mean())


def error_of(row: Row, error: str) -> float | None:
    """Return the size of an error of ERRORS; inf if nothing passes, None if it was not measured.

    A door that is too wide is as wrong as one that is too narrow. A ball stopped before the wall
    does not leak. Another radius model defines another scene, and its verdicts and distances are
    not wrong where they differ from those of `mean`. If a budget leaves answers unknown, the leak
    is None: an unknown answer stops the ball, not the wall.
    """
    if error == "leak" and row.unknown:
        return None
    if error in ("wrong", "distance") and (row.knob == RADIUS or not row.poses):
        return None
    value = getattr(row, ERRORS[error][1])
    if value is None:
        return None
    return max(float(value), 0.0) if error == "leak" else abs(float(value))


def pareto_front(places: Sequence[tuple[float, ...]]) -> list[bool]:
    """Return which (time, error, ...) are on the Pareto front.

    One tuple beats another if it is as fast, as good in every error, and better in at least one of
    all. Times within the factor TIME_TOLERANCE of each other count as equal: such differences are noise.
    """

    def beats(other: tuple[float, ...], one: tuple[float, ...]) -> bool:
        as_good = all(bad <= size for bad, size in zip(other[1:], one[1:], strict=True))
        better = other[0] * TIME_TOLERANCE < one[0] or other[1:] != one[1:]
        return as_good and better and other[0] <= one[0] * TIME_TOLERANCE

    return [not any(beats(other, one) for other in places) for one in places]


def mark_pareto_fronts(rows: Sequence[Row], knobs: Sequence[str]) -> None:
    """Mark the rows of `knobs` on the Pareto front of each error, and of both USER_ERRORS."""
    for name, errors in (*((error, (error,)) for error in ERRORS), ("doorway and leak", USER_ERRORS)):
        known = []
        for row in rows:
            sizes = [error_of(row, error) for error in errors]
            if row.knob in knobs and row.mean_us is not None and None not in sizes:
                known.append((row, (row.mean_us, *(size for size in sizes if size is not None))))
        for (row, _), best in zip(known, pareto_front([place for _, place in known]), strict=True):
            if best:
                row.front = (*row.front, name)


def knobs(rows: Iterable[Row]) -> list[str]:
    """Return the knobs, in the order of the rows."""
    return list(dict.fromkeys(row.knob for row in rows))
