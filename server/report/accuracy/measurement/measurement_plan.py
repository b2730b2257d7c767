"""Parameters of the accuracy report: the values of each knob and the number of measurements."""

from dataclasses import dataclass

from ...common.paper_case import PAPER_POINTS


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasurementPlan:
    """Settings to measure, one knob at a time, and the number of measurements of each.

    points: of the generated façade.  max_points: maximum number taken from a given archive.
    frames: poses of the walk, on which times are measured. Verdicts and distances are compared at
    these and at as many poses with random offsets from the walk.
    near_tangent: poses within a micrometre of touching.
    brute: poses at which the reference itself is checked, by a test of every pair of points.
    loops: timed repetitions of each setting, all settings in turn.
    chunk: consecutive poses timed as one call, for the percentiles: the time of a call with one
    pose would be mostly overhead.
    tolerances [m].  budgets [node visits].  steps: of the lattice [m].
    factors: on the radii of each radius model.  places: number of places where the leak is
    measured.
    made_models: radius models whose doorway error is measured on generated doors, which takes 12 to
    20 façades; empty: none.
    """

    points: int = PAPER_POINTS
    max_points: int = 1_000_000
    frames: int = 1200
    near_tangent: int = 400
    brute: int = 40
    loops: int = 5
    chunk: int = 12
    tolerances: tuple[float, ...] = (0.0, 1e-3, 2e-3, 5e-3, 1e-2, 2e-2, 5e-2, 1e-1)
    budgets: tuple[int, ...] = (30, 100, 300, 1000, 3000)
    steps: tuple[float, ...] = (1e-5, 1e-4, 1e-3, 1e-2)
    degrees: tuple[int, ...] = (4, 6, 8, 12, 16)
    leaves: tuple[int, ...] = (8, 16, 32)
    factors: tuple[float, ...] = (0.5, 1.0, 2.0)
    places: int = 2000
    made_models: tuple[str, ...] = ()


BRIEF = MeasurementPlan()
FULL = MeasurementPlan(
    frames=2400,
    near_tangent=4000,
    brute=400,
    loops=15,
    budgets=(10, 30, 100, 200, 300, 500, 1000, 2000, 3000, 10_000),
    degrees=(4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16),
    leaves=(4, 8, 12, 16, 24, 32),
    factors=(0.25, 0.5, 0.75, 1.0, 1.5, 2.0),
    places=20_000,
    made_models=("mean", "local", "border", "local+border"),
)
