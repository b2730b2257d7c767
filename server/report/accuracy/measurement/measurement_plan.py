"""Parameters of the accuracy report: errors to allow, and the number of measurements."""

from dataclasses import dataclass

from ...common.paper_case import PAPER_POINTS


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasurementPlan:
    """Sizes and repetitions of the measurements.

    points: of the generated façade.
    frames: poses of the walk. Answers are compared at these, and at as many poses with random
    offsets from the walk.
    near_tangent: poses within a micrometre of touching.
    brute: poses at which the exact verdict is checked, by a test of every pair of points.
    tolerances: errors to allow [m].  rounds: timed calls of each setting in each of two passes.
    cells: of the distance fields [m].  field_cells: maximum number of cells of the finest.
    places: poses asked with nothing in memory.
    shares: of the decoded scene that fits in memory.  walked: maximum number of frames of that walk.
    frame_tolerances: of the effect `sweep` [m].
    factors: on the radii of each radius model.  walls: number of places where the leak is measured.
    made_models: radius models whose doorway error is measured on generated doors, which takes 12 to
    20 façades; empty: none.
    """

    points: int = PAPER_POINTS
    frames: int = 1200
    near_tangent: int = 200
    brute: int = 40
    tolerances: tuple[float, ...] = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3)
    rounds: int = 10
    cells: tuple[float, ...] = (0.02, 0.05, 0.1)
    field_cells: int = 12_000_000
    places: int = 24
    shares: tuple[float, ...] = (0.1, 0.01, 0.001)
    walked: int = 900
    frame_tolerances: tuple[float, ...] = (1e-5, 1e-4, 1e-3, 1e-2, 1e-1)
    factors: tuple[float, ...] = (0.5, 1.0, 2.0)
    walls: int = 2000
    made_models: tuple[str, ...] = ()


BRIEF = MeasurementPlan()
FULL = MeasurementPlan(
    frames=2400,
    near_tangent=4000,
    brute=400,
    tolerances=(0.001, 0.002, 0.003, 0.005, 0.01, 0.02, 0.03, 0.05, 0.1, 0.2, 0.3),
    rounds=30,
    places=100,
    walked=3000,
    factors=(0.25, 0.5, 0.75, 1.0, 1.5, 2.0),
    walls=20_000,
    made_models=("mean", "local", "border", "local+border"),
)
