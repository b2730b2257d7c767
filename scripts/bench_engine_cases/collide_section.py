"""Section `collide`: stateless, one core, the walk and its classes of poses, against every peer."""

import time

import numpy as np
from measurement.query_poses import PoseSet, classes, free_space, gaps, jittered
from solidcloud.server.report.common.bench_results import Part, ratio
from solidcloud.server.report.common.machine import Clock, say

from .bench_context import Bench
from .compared_sides import BRUTE, CAPT, COLLIDE, SCIPY, TABLE, compare_set, evenly

CASE = "façade"
WALK, FAR, NEAR, CONTACT = "walk", "far", "clear, near", "contact"
FAR_POSES = 600
TABLE_PART, CAPT_PART, MAX_FAR_US, MAX_CONTACT_US = 0.25, 0.15, 2.0, 10.0


def pose_sets(bench: Bench) -> list[PoseSet]:
    """Return the walk, its classes, and far poses where the walk has none."""
    place = bench.facade
    walk = bench.walk
    contact = place.contact(walk)
    apart = np.zeros(len(walk))
    clear = np.flatnonzero(~contact)
    apart[clear] = gaps(place.tree, bench.avatar, place.local(walk[clear]), place.case.distance)
    masks = classes(contact, apart)
    sets = [PoseSet(WALK, walk, "feet 3 cm above the floor, 30 frames a second")]
    sets += [
        PoseSet(f"walk, {name}", walk[mask], f"of the walk: {name}")
        for name, mask in masks.items()
        if mask.any()
    ]
    if not masks[FAR].any():
        say("the walk holds no far poses: they are made")
    points = place.case.points
    bounds = np.array([points.min(axis=0), points.max(axis=0)])
    made = free_space(place.tree, bounds, bench.avatar, place.case.distance, bench.rng, FAR_POSES, 0.5)
    made.poses[:, :3, 3] += place.case.origin
    return [*sets, made]


def run(bench: Bench, clock: Clock) -> Part:
    """Time all sets."""
    part = Part("collide")
    place = bench.facade
    sets = pose_sets(bench)
    part.remarks += place.settings()
    clock.restart()
    for k, poses in enumerate(sets):
        # The walk comes first, with the requested number of repetitions; the rest share the
        # remaining time.
        compare_set(part, CASE, place, poses, bench.loops, clock, bench.rng, 0.6 if k == 0 else 0.5)
    walk = f"{CASE}, {WALK}"
    contact = place.contact(bench.walk)
    some = np.concatenate([evenly(bench.walk[contact], 1), evenly(bench.walk[~contact], 1)])
    say("brute force, one pose in contact and one clear")
    part.add(walk, BRUTE, COLLIDE, place.brute(some), "µs", len(some))
    for name, scene in place.scenes.items():
        singles = []
        scene.collide("avatar", bench.walk[:1])
        for _ in clock.loops(min(bench.loops, 5), 0.3):
            frames = [np.ascontiguousarray(pose[None]) for pose in jittered(bench.walk, bench.rng)]
            begin = time.perf_counter()
            for frame in frames:
                scene.collide("avatar", frame)
            singles.append((time.perf_counter() - begin) / len(frames) * 1e6)
        single = part.add(walk, name, "one call a pose", singles, "µs", len(bench.walk))
        whole = part.value(walk, name, COLLIDE)
        assert whole is not None
        part.add(walk, name, "single-call overhead", single - whole, "µs")
    _goals(part, list(place.scenes))
    return part


def _goals(part: Part, ours: list[str]) -> None:
    walk = f"{CASE}, {WALK}"
    for name in ours:
        mean = part.value(walk, name, COLLIDE)
        for key, peer, share in (("table", TABLE, TABLE_PART), ("capt", CAPT, CAPT_PART)):
            measured = ratio(mean, part.value(walk, peer, COLLIDE))
            part.goal(f"collide {key}", f"collide, walk: mean / {peer} ({name})", measured, share, "x")
        far = [f.value for f in part.figures if f.side == name and f.case.endswith(FAR) and f.what == COLLIDE]
        part.goal("collide far", f"collide, far poses ({name})", max(far, default=None), MAX_FAR_US, "µs")
        touching = part.value(f"{CASE}, walk, {CONTACT}", name, COLLIDE)
        part.goal(
            "collide contact",
            f"collide, colliding poses of the walk ({name})",
            touching,
            MAX_CONTACT_US,
            "µs",
        )
        scipy = ratio(part.value(walk, SCIPY, COLLIDE), mean)
        if scipy is not None:
            part.remarks.append(f"{SCIPY} takes {scipy:,.0f} times as long as {name}")
