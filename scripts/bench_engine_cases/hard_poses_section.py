"""Section `hard`: the façade with poses that are hard for a hierarchy; every side beside ours."""

import numpy as np
from measurement.query_poses import PoseSet, along_walls, feet_on_floor, free_space, inside_columns
from solidcloud.server.report.common.bench_results import Part
from solidcloud.server.report.common.machine import Clock, say

from .bench_context import Bench
from .collide_section import CASE
from .compared_sides import compare_set

COUNT = 300


def pose_sets(bench: Bench) -> list[PoseSet]:
    """Return the hard poses; the façade's own frame is the world."""
    place, avatar, rng = bench.facade, bench.avatar, bench.rng
    say("making the hard poses")
    points = place.case.points + place.case.origin
    clear = bench.walk[~place.contact(bench.walk)]
    distance = place.case.distance
    bounds = np.array([place.case.points.min(axis=0), place.case.points.max(axis=0)])
    free = free_space(place.tree, bounds, avatar, distance, rng, COUNT, 0.0)
    free.poses[:, :3, 3] += place.case.origin
    return [
        feet_on_floor(points, avatar, clear, distance, COUNT),
        along_walls(points, avatar, bench.truth, distance, rng, COUNT),
        inside_columns(bench.truth, rng, COUNT),
        free,
    ]


def run(bench: Bench, clock: Clock) -> Part:
    """Time every side on each set."""
    part = Part("hard")
    sets = pose_sets(bench)
    clock.restart()
    for k, poses in enumerate(sets):
        compare_set(part, CASE, bench.facade, poses, bench.loops, clock, bench.rng, 0.8 / (len(sets) - k))
    return part
