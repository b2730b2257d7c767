"""Walks of one scan, recorded, replayed and measured."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from measurement.contact_definition import Judge
from numpy.typing import NDArray
from solidcloud.builder.sources.scan_files import find_scan_files, open_scans
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.scene import Scene

from .floor_heights import FeetHeights, feet_heights, summary
from .frame_times import FrameTimes, times_summary
from .persons import Person
from .route_walk import AVATAR, Walked, first_pose, record_walk, replay_walk, scene_text
from .routes import Route, Scan
from .stuck_reason import stuck_reason

Floats = NDArray[np.float64]


class MeasuredWalk(NamedTuple):
    """A walk and its figures.

    figures: plain values, for JSON.  feet: (k,) height of the feet of each frame [m].
    heights: of the feet over the floor.
    """

    walked: Walked
    figures: dict[str, Any]
    feet: Floats
    heights: FeetHeights


def scan_points(file: Path) -> Floats:
    """Return the finite points (n, 3) of a scan, world [m], as the readers give them."""
    scans = [scan for each in find_scan_files([file]) for scan in open_scans(each)]
    points = np.concatenate([block.xyz for scan in scans for block in scan.blocks()])
    return points[np.isfinite(points).all(axis=1)]


def write_scene(archive: Path, scan: Scan) -> Path:
    """Write the scene file of a scan's archive beside it; return its path."""
    file = archive.with_suffix(".toml")
    file.write_text(scene_text(archive.resolve(), scan), "utf-8")
    return file


def measure_walk(
    file: Path, scan: Scan, route: Route, person: Person, points: Floats, folder: Path, every: int = 10
) -> MeasuredWalk:
    """Walk a route, record and replay it, and measure all but times.

    file: the scene file.  points: (n, 3), of the scan [m].  folder: for the log.
    every: of so many poses, one is also judged by the definition of contact.
    """
    log = folder / f"{file.stem}-{route.name.replace(' ', '-')}.log"
    with Scene.open(file) as scene:
        walked = record_walk(scene, scan, route, person, file, log)
    replayed = replay_walk(file, log)
    with Scene.open(file) as scene:
        radius = float(scene.add_avatar(AVATAR, person.points, person.radius).radius)
        verdicts = scene.collide(AVATAR, walked.poses).verdict
        info = scene.archives[0]
        with info.take() as opened:
            header = opened.store.archive.header
            judge = Judge(points, header.lattice.origin, header.lattice.step, scene.info().radius)
        feet = walked.poses[:, scan.up, 3] + person.points[:, 2].min() - radius
        reason = None
        if walked.why != "reached":
            reason = stuck_reason(scene, scan, walked, float(feet[-1]), points)
    places = walked.poses[:, :3, 3].copy()
    places[:, scan.up] = feet
    heights = feet_heights(points, places, scan.up)
    judged = walked.poses[::every]
    figures = {
        "route": route.name,
        "fits": route.fits,
        "frames": len(walked.poses),
        "outcome": walked.why,
        "waypoints": [walked.ended, len(route.legs)],
        "end_m": walked.poses[-1, :3, 3].round(4).tolist(),
        "goal_m": list(route.legs[-1].to),
        "frames along walls": int(walked.touching().sum()),
        "frames on ground": sum(bool(s.ground is not None and s.ground.on_ground) for s in walked.states),
        "poses in contact": int((verdicts != Verdict.CLEAR).sum()),
        "in contact by definition": [
            sum(judge.touches(person.points, radius, pose) for pose in judged),
            len(judged),
        ],
        "replay": replayed,
        "feet over median": summary(heights.median),
        "feet over bumps": summary(heights.bumps),
    }
    if reason is not None:
        figures["reason"] = reason
    return MeasuredWalk(walked, figures, feet, heights)


def measure_times(
    file: Path, scan: Scan, walks: Sequence[tuple[Route, MeasuredWalk]], person: Person, turns: int
) -> dict[str, Any]:
    """Measure the frames of walks. Add the figures of each to its own; return those of all."""
    costs = []
    with FrameTimes(file, person) as times:
        for route, walk in walks:
            cost, same = times.measure(walk.walked, first_pose(scan, route), turns)
            costs.append(cost)
            walk.figures["times"] = {**times_summary([cost]), "same poses": same}
    return times_summary(costs)
