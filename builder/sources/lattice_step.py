"""Lattice step of a dataset: as given, as all scans share it, or one that fits the points."""

from collections.abc import Sequence

import numpy as np

from ...schemas.archive.units import MIN_STEP
from .common.scan import SourceLattice
from .scan_warnings import MEASURED_SCANS, ScanFacts, spread

# Steps for scans that state none [m]. There are few, so that an estimate of the spacing by headers
# mostly leads to the same step as the points. The first is a twentieth of a terrestrial scanner's
# range noise; no step is below MIN_STEP.
STEPS = (1e-4, 5e-5, 2e-5, 1e-5, 5e-6, 2e-6, MIN_STEP)
# Distance between neighbouring points in steps, at least. Rounding then moves a point by at most
# 9 % of it. The slack keeps the first step for points on a grid of 1 mm, whose differences are
# rounded.
POINT_STEPS, SLACK = 10, 1e-3


def choose_step(facts: Sequence[ScanFacts], resolution: float | None, voxel: float) -> tuple[float, str]:
    """Return the lattice step [m] of scans that are built together, and its source.

    The source is "given" for `resolution`, "sources" for the step that all scans share, if it is at
    least MIN_STEP and at most `voxel` [m], otherwise "default": the largest of STEPS of which
    POINT_STEPS fit between neighbouring points of the densest scan.
    """
    if resolution is not None:
        return resolution, "given"
    shared = shared_step([each.scan.lattice for each in facts])
    if shared is not None and MIN_STEP <= shared <= voxel:
        return shared, "sources"
    # The survey has measured the scans without a lattice; of the others some are estimated.
    some = set(spread(len(facts), MEASURED_SCANS))
    spacings = [
        spacing
        for number, each in enumerate(facts)
        if (each.is_measured or number in some) and (spacing := each.spacing)
    ]
    most = min(spacings, default=np.inf) * (1 + SLACK) / POINT_STEPS
    return next((step for step in STEPS if step <= most), MIN_STEP), "default"


def shared_step(lattices: Sequence[SourceLattice | None]) -> float | None:
    """Return the step of the lattice that contains all sources, or None.

    The sources need the same scale, and offsets that differ by whole steps.
    """
    if not lattices or any(lattice is None for lattice in lattices):
        return None
    first = lattices[0]
    assert first is not None
    step = first.scale[0]
    for lattice in lattices:
        assert lattice is not None
        if any(scale != step for scale in lattice.scale):
            return None
        apart = (np.array(lattice.offset) - np.array(first.offset)) / step
        # Offsets are decimal text rounded to float64, which explains differences of a millionth of
        # a step. Larger differences mean another lattice.
        if (
            not np.isfinite(apart).all()
            or (np.abs(apart - np.rint(apart)) > 1e-6 * np.maximum(1, np.abs(apart) * 1e-9)).any()
        ):
            return None
    return float(step)
