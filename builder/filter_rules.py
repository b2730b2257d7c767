"""The rules of the filter stage, in lattice steps: which points are left out. Off unless asked for.

Three rules, each exact in integers of the lattice:

- `moving (R, SCANS)`: a point is left out where fewer than SCANS other scans have a point within R of it, although
  SCANS other scans have points within 8 R: they saw the place, and not it. What moved while scans that overlap were
  made is seen by one of them only. Where fewer than SCANS others came within 8 R it stays: none could have seen it.
- `outliers (R, COUNT)`: a point is left out where fewer than COUNT other distinct points lie within R.
- `thin STEP`: of each cube of STEP, rounded to whole lattice steps, one point stays: the one nearest to its middle, of
  equally near ones the first in Morton order within the cube, then by scan and intensity. With the lattice step itself
  exact duplicates become one. Whatever is left out lies less than sqrt(3) STEP from what stays of its cube.

`moving` and `outliers` both look at all points as they were scanned, so that neither depends on the other; what both
leave out is counted as moving. `thin` then chooses among what they leave.

Distances are inclusive, compared as integers: R is taken as the decimal number it is written as, over the step written
as one. Cubes are counted from the lattice's origin and may lie across voxels: who lives on the border is looked up in
the voxels around. So which points stay is a function of the points, their scans and the options; not of the voxels'
size, the order of scans, jobs or memory. No more than a voxel's edge around a point is looked at: a rule that needs
more is refused by name.
"""

from fractions import Fraction
from math import isqrt
from typing import Any, NamedTuple

import numpy as np

from ..schemas.errors import BadRequestError
from ..schemas.voxel_grid import Lattice
from .config import BuildConfig
from .spool import spool_dtype

# Why a point was left out, as `info` says it.
MOVING, OUTLIER, THINNED = "moving", "outliers", "thinned"

# How far from a point `moving` asks whether others saw the place, in its distance.
SEEN = 8
# Scans that `moving` remembers of a point: 16 bytes each.
MAX_SCANS_ASKED = 16


class Reach(NamedTuple):
    """A distance and a number. squared: of the distance [steps^2].  steps: of it, whole.  number: see the rule."""

    squared: int
    steps: int
    number: int


class Rules(NamedTuple):
    """What is left out, in lattice steps; None: not asked for. seen: `moving`'s wider reach.  thin: a cube's edge."""

    moving: Reach | None
    seen: Reach | None
    outliers: Reach | None
    thin: int | None


def is_filtered(config: BuildConfig) -> bool:
    """Whether any rule is asked for."""
    return not (config.thin is None and config.outliers is None and config.moving is None)


def filter_dtype(config: BuildConfig) -> np.dtype:
    """A row of the spool that the filters read: with the scan, which they need, and count by, whatever is kept."""
    names = spool_dtype(config).names or ()
    fields: list[tuple[Any, ...]] = [("local", "<i4", (3,)), ("scan_index", "<u2")]
    if "intensity" in names:
        fields.append(("intensity", "<f4"))
    return np.dtype(fields)


def filter_passes(config: BuildConfig) -> int:
    """How often all points are gone through: progress counts up to this many times their number."""
    return (config.moving is not None or config.outliers is not None) + (config.thin is not None)


def _reach(option: str, metres: float, number: int, lattice: Lattice, wider: int = 1) -> Reach:
    """`wider` times a distance. Raises BadRequestError where it is under a lattice step or over a voxel."""
    ratio = Fraction(repr(metres)) / Fraction(repr(lattice.step)) * wider
    squared = int(ratio * ratio)
    if squared < 1:
        raise BadRequestError(
            f"{option} {metres:g}: expected at least the lattice step, {lattice.step:g} m: give a larger distance"
        )
    if isqrt(squared) > lattice.voxel_steps:
        around = f", looks {metres * wider:g} m around each point" if wider > 1 else ""
        raise BadRequestError(
            f"{option} {metres:g}{around}: expected at most a voxel, {lattice.voxel_size:g} m: give a smaller distance "
            "or a larger --voxel"
        )
    return Reach(squared, isqrt(squared), number)


def make_rules(config: BuildConfig, lattice: Lattice) -> Rules:
    """The rules in lattice steps. Raises BadRequestError for what cannot be done on this lattice."""
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
