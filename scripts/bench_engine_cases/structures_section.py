"""Section `structures`: the paper's structure against ours, degrees 4 to 16.

It runs only on request (--only structures). `scripts/walkthrough` reports more on each, frame by
frame, with the paper's own table; this section times them too. Its poses are the same in every
repetition: nothing is kept between calls.
"""

from solidcloud.server.report.common.bench_results import Part
from solidcloud.server.report.common.machine import Clock, say
from solidcloud.server.report.common.paper_case import PAPER_VOXEL, STEP, Case, made_case
from solidcloud.server.report.walk.walkthrough import DEGREES, build_structures, measure

from .bench_context import Bench
from .compared_sides import COLLIDE


def run(bench: Bench, clock: Clock) -> Part:
    """Build a façade for each degree and kind of node, and time the walk in each."""
    part = Part("structures")
    scratch = bench.folder / "structures"
    scratch.mkdir()
    case: Case = made_case(scratch, PAPER_VOXEL)
    structures = build_structures(case, DEGREES, scratch, say)
    # `measure` raises when two structures give different answers. It also walks frame by frame,
    # which takes minutes per loop.
    clock.look_around()
    measure(case, structures, max(1, min(bench.loops, 3)), say)
    clock.look_around()
    for s in structures:
        label = f"{s.kind}, degree {s.degree}"
        part.add("walk", label, COLLIDE, s.loops / len(case.poses) * 1e6, "µs", len(case.poses))
        part.add("walk", label, "node visits a pose", s.node_visits, "")
        part.add("walk", label, "point tests a pose", s.point_tests, "")
        part.add("walk", label, "resident", s.resident_bytes / s.points, "bytes/point", s.points)
    part.remarks.append(f"lattice {STEP * 1e3:g} mm, voxel {PAPER_VOXEL:g} m; {clock.spent:.0f} s")
    return part
