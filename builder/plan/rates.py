"""Measured rates of builds: time by stage, bytes per point, memory.

rates.json holds the packaged rates, which `scripts/bench_build --write-rates` writes;
measure_rates.py measures those of this machine.
"""

import json
import math
from dataclasses import asdict, dataclass
from importlib import resources
from itertools import pairwise
from typing import NamedTuple

from ...schemas.errors import CorruptError
from ..build_limits import RADIUS_SAMPLE

RATES_NAME = "rates.json"
VERSION = 1


class StageRate(NamedTuple):
    """Cost of a stage.

    start: constant [s].  serial: per point, not shared [s].  parallel: per point, of one core [s].
    first: additional cost of each of the first RADIUS_SAMPLE points, of one core [s]. At most that
    many points have their closest points searched, and part of other stages behaves the same way.
    """

    start: float
    first: float
    serial: float
    parallel: float

    def seconds(self, points: float, jobs: int) -> float:
        """Return the time [s] for `points` points with `jobs` workers."""
        first = min(points, RADIUS_SAMPLE) * self.first
        return self.start + points * self.serial + (first + points * self.parallel) / jobs


@dataclass(frozen=True, slots=True, kw_only=True)
class Rates:
    """Measured rates of builds.

    machine: type of the measured machine.  cores: their number.  rests_on: what was measured.
    stages: name -> StageRate, in the order of a build.  workers: starting the processes of more
    than one job [s].
    read: format -> seconds per point, reading alone, on one core.  passes: number of times a build
    reads its scans.
    archive: (pitch, bytes per point), ascending. The pitch is the square root of the surface area
    per point, divided by the lattice step.
    process, worker, point: memory [bytes] of the first process, of each other process, and of each
    point until --memory is reached.
    disk: write rate of the disk [bytes/s].  density: points/m^2 of the generated façade of 587,923
    points.
    crossed: number of voxels divided by area / voxel^2.
    """

    machine: str
    cores: int
    rests_on: str
    stages: dict[str, StageRate]
    workers: float
    read: dict[str, float]
    passes: int
    archive: list[tuple[float, float]]
    process: float
    worker: float
    point: float
    disk: float
    density: float
    crossed: float

    def bytes_a_point(self, ratio: float) -> float:
        """Return the archive's bytes per point for a pitch of `ratio` lattice steps.

        They are linear in the logarithm of the pitch, as the number of bits is.
        """
        known = [(math.log2(at), size) for at, size in self.archive]
        at = math.log2(max(ratio, 1e-3))
        pairs = list(pairwise(known))
        (x0, y0), (x1, y1) = next((p for p in pairs if at <= p[1][0]), pairs[-1])
        # At least one byte: nodes and cells alone take that.
        return max(1.0, y0 + (y1 - y0) * (at - x0) / (x1 - x0))


def load_rates(text: str | None = None) -> Rates:
    """Return the packaged rates, or those of a text. Raise CorruptError if they cannot be read."""
    if text is None:
        text = (resources.files(__package__) / RATES_NAME).read_text(encoding="utf-8")
    try:
        found = json.loads(text)
        if found.pop("version") != VERSION:
            raise ValueError("unsupported version")
        found["stages"] = {name: StageRate(**stage) for name, stage in found["stages"].items()}
        found["archive"] = [(float(at), float(size)) for at, size in found["archive"]]
        rates = Rates(**found)
        if len(rates.archive) < 2 or "las" not in rates.read:
            raise ValueError("too few figures")
        return rates
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise CorruptError(
            f"{RATES_NAME}: {error}, expected what scripts/bench_build --write-rates writes: measure again"
        ) from None


def dump_rates(rates: Rates) -> str:
    """Return rates as the text of rates.json."""
    stages = {name: stage._asdict() for name, stage in rates.stages.items()}
    return json.dumps({"version": VERSION, **asdict(rates), "stages": stages}, indent=1) + "\n"
