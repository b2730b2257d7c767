"""Section `scans`: real scans, each with a walk over its floor and with poses near its surfaces; every side."""

import os
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from solidcloud.schemas.errors import BadDataError
from solidcloud.server.report.floor_walk import floor_walk

from .archives import build, stored_points
from .context import Bench
from .machine import Clock, say
from .poses import PoseSet, random_poses
from .results import Part
from .sides import OURS, Place, compare_set

REAL_SCANS = ("pumpA.e57", "lone_star.copc.laz", "campus_scan_a.ply")
NEAR_POSES = 600
# A point of the figure lies at most so far from a point of the scan [m].
NEAR = 0.3


def scan_files() -> list[Path]:
    """The scans that are here: those of REAL_SCANS in the folder that SOLIDCLOUD_SCANS names."""
    folder = os.environ.get("SOLIDCLOUD_SCANS")
    return [path for name in REAL_SCANS if folder and (path := Path(folder) / name).exists()]


def run(bench: Bench, clock: Clock) -> Part:
    """Build each scan with the defaults, and time every side on it."""
    part = Part("scans")
    files = scan_files()
    if len(files) < len(REAL_SCANS):
        there = ", ".join(path.name for path in files) or "none"
        part.missing.append(f"of {', '.join(REAL_SCANS)}: {there} in the folder that SOLIDCLOUD_SCANS names")
    for k, file in enumerate(files):
        share = clock.left / (len(files) - k)
        say(f"{file.name}")
        _one(bench, Clock(share), part, file)
    return part


def _one(bench: Bench, clock: Clock, part: Part, file: Path) -> None:
    folder = bench.folder / f"scan-{file.stem}"
    folder.mkdir()
    archive = build(file, folder / "archive", step=None)
    with ExitStack() as stack:
        sets = pose_sets(bench, archive)
        place = Place({OURS: archive}, bench.avatar, sets[0].poses, bench.program, folder / "peers", stack)
        info = place.scene.info()
        part.remarks.append(
            f"{file.name}: {info.points:,} points, {info.voxels} voxels, lattice {info.lattice_step:g} m"
        )
        part.remarks += [f"{file.name}: {line}" for line in place.settings()]
        for k, poses in enumerate(sets):
            compare_set(part, file.name, place, poses, bench.loops, clock, bench.rng, 0.8 / (len(sets) - k))


def pose_sets(bench: Bench, archive: Path) -> list[PoseSet]:
    """A walk where the scan has a floor to walk on, and poses near its surfaces."""
    from solidcloud.schemas.archive import Archive

    with Archive(archive) as opened:
        origin = np.array(opened.header.lattice.origin)
    local = stored_points(archive)
    points = local + origin
    near = random_poses(bench.rng, local, bench.avatar, NEAR_POSES, NEAR)
    near[:, :3, 3] += origin
    sets = [
        PoseSet("near surfaces", near, f"turned at random, a point within {NEAR:g} m of a point of the scan")
    ]
    try:
        walk = floor_walk(points)[1]
    except BadDataError as error:
        say(f"no walk: {error}")
        return sets
    return [PoseSet("walk", walk, "straight through the middle, over the lowest dense layer"), *sets]
