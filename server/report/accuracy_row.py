"""A row of the accuracy report: one setting of one knob, what it costs and what it gets wrong."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

Bools = NDArray[np.bool_]
Floats = NDArray[np.float64]

# What is measured with the server's own engine, and what with the plain descent of kernels/descent.py: times of the
# two do not compare.
ENGINE, PLAIN = "engine", "plain descent"

# The knobs of the server's own engine.
TOLERANCE, BUDGET, RADIUS = "tolerance", "budget", "radius model"
SHEET = "radius model, a thin sheet with a door"
STEP, DEGREE, LEAF, NODES = "lattice step", "degree", "leaf size", "bounding volume"
# Behind a tolerance that comes without a budget: answered exactly.
ALONE = ", alone"
# What the charts of time against error show: degree and leaf size change no answer, and hardly any time.
SHOWN = (TOLERANCE, BUDGET, RADIUS, STEP, NODES)


@dataclass
class Row:
    """One setting. Figures that were not measured are None.

    knob, setting: what is turned, and to what.  value: the setting as a number, where it is one.  default: whether it
    is what a user gets who says nothing.  by: ENGINE or PLAIN.  scene: where it was measured.
    factor: of a radius model, on its radii; of a fixed figure, about what it is over the mean.
    mean_us, p50_us, p99_us: time of a pose [us], see accuracy_timing.py.  times: mean_us over that of the default
    setting beside which it was timed.  noise: see Timed.
    poses, early, late, unknown: of the judged poses, how many, and called contact where the judge says clear, the
    reverse, not answered.  tangent, tangent_early, tangent_late, tangent_unknown: the same of near-tangent poses.
    distance_max_mm, distance_mean_mm: |distance - exact distance| [mm].  distance_missing: poses where no pair was
    found though one is in reach.
    doorway_mm (inf: the figure cannot even stand in the door); leak_p50_mm, leak_p99_mm, leak_worst_mm, leak_share:
    what a user feels, see doorway.py and leak.py.  made_doorway_mm: the doorway by doors made, see made_doorway.py.
    archive_bytes, decode_ms: of a build.  node_tests, pair_tests: means over poses.
    front: against which errors no setting is both faster and better; of those that the charts show.  note: in words.
    """

    knob: str
    setting: str
    value: float | None = None
    default: bool = False
    by: str = ENGINE
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
        """Judged poses whose verdict is not the judge's, unknown ones among them; of one."""
        return (self.early + self.late + self.unknown) / self.poses if self.poses else 0.0

    def as_dict(self) -> dict[str, Any]:
        """For JSON and CSV: the fields, and the share that is wrong; None for what is infinite, named in the note."""
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


COLUMNS = (*(field.name for field in fields(Row)), "wrong_share")

# Name of an error -> what it is on an axis, and the attribute of a row.
ERRORS = {
    "doorway": ("doorway error [mm]", "doorway_mm"),
    "leak": ("leak, 99th percentile [mm]", "leak_p99_mm"),
    "wrong": ("wrong or unknown verdicts [share]", "wrong_share"),
    "distance": ("largest distance error [mm]", "distance_max_mm"),
}


FELT_ERRORS = ("doorway", "leak")

# Times that differ by less than this factor count as equal: of one archive built twice they did by 6 %, on a busy
# machine.
ALIKE = 1.1


def judge_verdicts(row: Row, contact: Bools, unknown: Bools, exact: Bools, *, tangent: bool = False) -> None:
    """Count into the row where verdicts (k,) differ from the exact ones."""
    early = int((contact & ~exact & ~unknown).sum())
    late = int((~contact & exact & ~unknown).sum())
    if tangent:
        row.tangent, row.tangent_early, row.tangent_late = len(exact), early, late
        row.tangent_unknown = int(unknown.sum())
    else:
        row.poses, row.early, row.late, row.unknown = len(exact), early, late, int(unknown.sum())


def judge_distances(row: Row, found: Floats, exact: Floats) -> None:
    """Measure into the row how far distances (k,) [m] are off; inf: no pair was found, and is left out."""
    both = np.isfinite(found) & np.isfinite(exact)
    row.distance_missing = int((~np.isfinite(found) & np.isfinite(exact)).sum())
    if both.any():
        off = np.abs(found[both] - exact[both]) * 1e3
        row.distance_max_mm, row.distance_mean_mm = float(off.max()), float(off.mean())


def error_of(row: Row, error: str) -> float | None:
    """An error of ERRORS, by its size, inf where nothing passes; None where it was not measured.

    A door too wide is as wrong as one too narrow; a ball stopped before the wall does not leak. Another radius model is
    another definition of the scene: that its verdicts and distances differ from the mean's is no error. What stops a
    ball where a budget leaves answers unknown is the budget: that is no wall that holds.
    """
    if error == "leak" and row.unknown:
        return None
    if error in ("wrong", "distance") and (row.knob == RADIUS or not row.poses):
        return None
    value = getattr(row, ERRORS[error][1])
    if value is None:
        return None
    return max(float(value), 0.0) if error == "leak" else abs(float(value))


def unbeaten(places: Sequence[tuple[float, ...]]) -> list[bool]:
    """Which of some (time, error, ...) no other beats: as fast and as good in every error, and better in one of all.

    Times within ALIKE of each other are the same: less than that is noise on any machine.
    """

    def beats(other: tuple[float, ...], one: tuple[float, ...]) -> bool:
        as_good = all(bad <= size for bad, size in zip(other[1:], one[1:], strict=True))
        better = other[0] * ALIKE < one[0] or other[1:] != one[1:]
        return as_good and better and other[0] <= one[0] * ALIKE

    return [not any(beats(other, one) for other in places) for one in places]


def mark_front(rows: Sequence[Row], knobs: Sequence[str]) -> None:
    """Mark, for each error, and for both of FELT_ERRORS at once, those rows of `knobs` that no other beats."""
    for name, errors in (*((error, (error,)) for error in ERRORS), ("doorway and leak", FELT_ERRORS)):
        known = []
        for row in rows:
            sizes = [error_of(row, error) for error in errors]
            if row.knob in knobs and row.mean_us is not None and None not in sizes:
                known.append((row, (row.mean_us, *(size for size in sizes if size is not None))))
        for (row, _), best in zip(known, unbeaten([place for _, place in known]), strict=True):
            if best:
                row.front = (*row.front, name)


def knobs(rows: Iterable[Row]) -> list[str]:
    """The knobs, in the order of the rows."""
    return list(dict.fromkeys(row.knob for row in rows))
