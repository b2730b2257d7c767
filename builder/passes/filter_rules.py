"""Rules of the filter pass, in lattice steps: which points are left out. All are off by default.

Three rules, each exact in integers of the lattice:

- `moving (R, SCANS)`: leave out a point if fewer than SCANS other scans have a point within R of
  it, although SCANS other scans have points within 8 R. Those scans saw the place, but not the
  point, as happens to objects that move while overlapping scans are made. If fewer than SCANS other
  scans have points within 8 R, the point stays, because too few scans could have seen it.
- `outliers (R, COUNT)`: leave out a point if fewer than COUNT other distinct points lie within R.
- `thin STEP`: of each cube of STEP, rounded to whole lattice steps, keep one point: the one nearest
  to the centre of the cube; among equally near ones the first in Morton order within the cube, then
  by scan, intensity, colour and class. If STEP is the lattice step, exact duplicates become one point. Every point
  left out lies less than sqrt(3) STEP from the point kept in its cube.

`moving` and `outliers` both examine all points as scanned, so neither depends on the other. A point
that both leave out is counted as moving. `thin` then selects among the remaining points.

Distances are inclusive and compared as integers: R is taken as the decimal number as written,
divided by the step as a decimal number. Cubes are counted from the origin of the lattice and may
span voxels; points in the surrounding voxels are then included. The selection is therefore a
function of the points, their scans and the options, not of the voxel size, the order of scans, jobs
or memory. At most one voxel edge around a point is examined: a rule that needs more is refused by
name.
"""

from fractions import Fraction
from math import isqrt
from typing import NamedTuple

from ...schemas.archive.voxel_grid import Lattice
from ...schemas.errors import BadRequestError
from ..config import BuildConfig

# Reasons why a point was left out, as `info` shows them.
MOVING, OUTLIER, THINNED = "moving", "outliers", "thinned"

# Radius within which `moving` checks whether other scans saw the place, as a multiple of its
# distance.
SEEN = 8
# Most scans that `moving` counts per point: 16 bytes each.
MAX_SCANS_ASKED = 16


class Reach(NamedTuple):
    """Distance and number of a rule.

    squared: squared distance [steps^2].  steps: the distance, rounded down [steps].  number: see
    the rule.
    """

    squared: int
    steps: int
    number: int


class Rules(NamedTuple):
    """Rules in lattice steps; None if a rule is off.

    seen: SEEN times the distance of `moving`.  thin: edge of a cube.
    """

    moving: Reach | None
    seen: Reach | None
    outliers: Reach | None
    thin: int | None


def _reach(option: str, metres: float, number: int, lattice: Lattice, wider: int = 1) -> Reach:
    """Convert `wider` times a distance to lattice steps.

    Raise BadRequestError if the distance is less than a lattice step or more than a voxel.
    """
    ratio = Fraction(repr(metres)) / Fraction(repr(lattice.step)) * wider
    squared = int(ratio * ratio)
    if squared < 1:
        raise BadRequestError(
            f"{option} {metres:g}: expected at least the lattice step, {lattice.step:g} m: give a larger distance"
        )
    if isqrt(squared) > lattice.voxel_steps:
        around = f", examines {metres * wider:g} m around each point" if wider > 1 else ""
        raise BadRequestError(
            f"{option} {metres:g}{around}: expected at most a voxel, {lattice.voxel_size:g} m: give a smaller distance "
            "or a larger --voxel"
        )
    return Reach(squared, isqrt(squared), number)


def make_rules(config: BuildConfig, lattice: Lattice) -> Rules:
    """Convert the rules to lattice steps.

    Raise BadRequestError for rules impossible on this lattice.
    """
    moving = seen = outliers = thin = None
    if config.moving is not None:
        distance, scans = config.moving
        if scans > MAX_SCANS_ASKED:
            raise BadRequestError(f"--moving {distance:g},{scans}: expected 1 to {MAX_SCANS_ASKED} scans")
        moving = _reach("--moving", distance, scans, lattice)
        seen = _reach("--moving", distance, scans, lattice, SEEN)
    if config.outliers is not None:
        outliers = _reach("--outliers", *config.outliers, lattice)
    if config.thin is not None:
        thin = max(1, round(Fraction(repr(config.thin)) / Fraction(repr(lattice.step))))
        if thin > lattice.voxel_steps:
            raise BadRequestError(
                f"--thin {config.thin:g}: expected at most a voxel, {lattice.voxel_size:g} m: give less or a larger "
                "--voxel"
            )
    return Rules(moving, seen, outliers, thin)
