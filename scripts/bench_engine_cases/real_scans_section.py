"""Section `scans`: real scans, each with a walk over its floor and poses near its surfaces; every side."""

import os
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from measurement.measured_archives import build, stored_points
from measurement.query_poses import PoseSet, near_surfaces, random_poses
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.errors import BadDataError
from solidcloud.server.report.common.bench_results import Part
from solidcloud.server.report.common.floor_walk import floor_walk
from solidcloud.server.report.common.machine import Clock, say

from .bench_context import Bench
from .compared_sides import OURS, Place, compare_set

REAL_SCANS = ("pumpA.e57", "lone_star.copc.laz", "campus_scan_a.ply")
NEAR_POSES = 240
LONELY = 0.3  # [m]


def scan_files() -> list[Path]:
    """Return the scans of REAL_SCANS that exist in the folder that SOLIDCLOUD_SCANS names."""
    folder = os.environ.get("SOLIDCLOUD_SCANS")
    return [path for name in REAL_SCANS if folder and (path := Path(folder) / name).exists()]


def run(bench: Bench, clock: Clock) -> Part:
    """Build each scan with the defaults, and time every side on it."""
    part = Part("scans")
    files = scan_files()
    if len(files) < len(REAL_SCANS):
        there = ", ".join(path.name for path in files) or "none"
        part.missing.append(f"of {', '.join(REAL_SCANS)}: {there} in the folder that SOLIDCLOUD_SCANS names")
    for file in files:
        say(file.name)
        _one(bench, Clock(clock.seconds / len(files), clock.others), part, file)
    return part


def _one(bench: Bench, clock: Clock, part: Part, file: Path) -> None:
    folder = bench.folder / f"scan-{file.stem}"
    folder.mkdir()
    archive = build(file, folder / "archive", step=None)
    with ExitStack() as stack:
        walk = walk_set(bench, archive)
        place = Place({OURS: archive}, bench.avatar, walk.poses, bench.program, folder / "peers", stack)
        info = place.scene.info()
        part.remarks.append(
            f"{file.name}: {info.points:,} points, {info.voxels} voxels, lattice {info.lattice_step:g} m"
        )
        part.remarks += [f"{file.name}: {line}" for line in place.settings()]
        sets = [walk, near_set(bench, place)]
        clock.restart()
        for k, poses in enumerate(sets):
            compare_set(part, file.name, place, poses, bench.loops, clock, bench.rng, 0.8 / (len(sets) - k))


def walk_set(bench: Bench, archive: Path) -> PoseSet:
    """Return a walk where the scan has a floor, else poses near its surfaces."""
    with Archive(archive) as opened:
        origin = np.array(opened.header.lattice.origin)
    points = stored_points(archive) + origin
    try:
        return PoseSet(
            "walk", floor_walk(points)[1], "straight through the middle, over the lowest dense layer"
        )
    except BadDataError as error:
        say(f"no walk: {error}")
        poses = random_poses(bench.rng, points, bench.avatar, NEAR_POSES, LONELY)
        return PoseSet(
            "no floor", poses, f"turned at random, a point within {LONELY:g} m of a point of the scan"
        )


def near_set(bench: Bench, place: Place) -> PoseSet:
    """Return poses near surfaces, world frame."""
    poses = near_surfaces(
        place.tree, place.case.points, bench.avatar, place.case.distance, bench.rng, NEAR_POSES
    )
    poses.poses[:, :3, 3] += place.case.origin
    return poses
