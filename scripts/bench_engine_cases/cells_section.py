"""Section `cells`: the plain octree with several cell sizes, and cells merged to equal tree heights.

This is the future work of [Fig12] section 8, and the reason for the default of
`BuildConfig.cell_points`. It runs only on request (--only cells). Its poses are the same in every
repetition: nothing is kept between calls.
"""

from solidcloud.server.report.common.bench_results import Part
from solidcloud.server.report.common.machine import Clock, say
from solidcloud.server.report.common.paper_case import PAPER_VOXEL, STEP, made_case
from solidcloud.server.report.walk.cell_comparison import compare_cells

from .bench_context import Bench
from .compared_sides import COLLIDE


def run(bench: Bench, clock: Clock) -> Part:
    """Build a façade for each plan, in voxels of two sizes, and time the walk in each."""
    part = Part("cells")
    for voxel in (PAPER_VOXEL, 8.0):
        scratch = bench.folder / f"cells-{voxel:g}"
        scratch.mkdir()
        case = made_case(scratch, voxel)
        group = f"voxel {voxel:g} m"
        # Raises when two plans give different answers.
        for plan in compare_cells(case, scratch, max(1, bench.loops), say):
            heights = ", ".join(f"{cells} of height {levels}" for levels, cells in plan.heights.items())
            part.add(group, plan.name, COLLIDE, plan.loops / len(case.poses) * 1e6, "µs", len(case.poses))
            part.add(group, plan.name, "node visits a pose", plan.node_visits, "")
            part.add(group, plan.name, "point tests a pose", plan.point_tests, "")
            part.add(group, plan.name, "resident", plan.resident_bytes_a_point, "bytes/point")
            part.add(group, plan.name, "archive", plan.bytes_a_point, "bytes/point")
            part.remarks.append(f"{group}, {plan.name}: {heights}")
        clock.look_around()
    part.remarks.append(f"lattice {STEP * 1e3:g} mm; {clock.spent:.0f} s")
    return part
