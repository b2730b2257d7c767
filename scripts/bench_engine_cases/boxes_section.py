"""Section `boxes`: nodes bounded by a slab only, or by a box where it is tighter.

The walk and the same poses displaced, on the façade as it stands, turned by 30 degrees about the
vertical, and tilted by 30 degrees as well. It runs only on request (--only boxes).
"""

from collections.abc import Iterator
from contextlib import contextmanager
from unittest import mock

import numpy as np
from measurement.measured_archives import build, stored_points
from measurement.query_poses import Floats
from solidcloud.schemas.archive.archive import Archive
from solidcloud.server.kernels.core.scene_arrays import ROW_WORDS
from solidcloud.server.report.common.bench_results import Part
from solidcloud.server.report.common.machine import Clock
from solidcloud.server.report.common.paired_times import mean_ratio, time_in_turn
from solidcloud.server.residency import voxel_store
from solidcloud.server.scene import Scene

from .bench_context import Bench

DISPLACED = 0.2  # of the displaced poses, along each axis [m]
PAIRS = 20
REACH = 0.5  # of `distance` [m]


def run(bench: Bench, clock: Clock) -> Part:
    """Build the façade in three attitudes, and time both kinds of nodes in each."""
    part, scratch = Part("boxes"), bench.folder / "boxes"
    scratch.mkdir()
    with Archive(bench.archives[8]) as archive:
        points = stored_points(bench.archives[8]) + archive.header.lattice.origin
    displaced = bench.walk.copy()
    displaced[:, :3, 3] += bench.rng.uniform(-DISPLACED, DISPLACED, (len(displaced), 3))
    for number, (attitude, turn) in enumerate(_attitudes().items()):
        scan = scratch / f"{number}.xyz"
        np.savetxt(scan, points @ turn[:3, :3].T, fmt="%.4f")
        built = build(scan, scratch / f"{number}")
        with _slabs_only():
            slabs = bench.stack.enter_context(Scene.open(built))
            slabs.add_avatar("avatar", bench.avatar)
            slabs.distance("avatar", turn @ displaced, REACH)
        boxes = bench.stack.enter_context(Scene.open(built))
        boxes.add_avatar("avatar", bench.avatar)
        for name, poses in (("walk", turn @ bench.walk), ("displaced", turn @ displaced)):
            _compare(part, f"{name}, {attitude}", slabs, boxes, poses)
        part.add(attitude, "boxes", "share of nodes", _share(boxes), "")
        clock.look_around()
    return part


def _attitudes() -> dict[str, Floats]:
    """Return the poses (4, 4) of the façade, by name."""
    angle = np.radians(30.0)
    about_z, about_x = np.eye(4), np.eye(4)
    about_z[:2, :2] = about_x[1:3, 1:3] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return {"as it stands": np.eye(4), "turned": about_z, "turned and tilted": about_x @ about_z}


@contextmanager
def _slabs_only() -> Iterator[None]:
    """Load voxels without boxes."""
    with mock.patch.object(voxel_store, "lay_boxes", lambda *_: None):
        yield


def _compare(part: Part, case: str, slabs: Scene, boxes: Scene, poses: Floats) -> None:
    """Add the times and visits of both scenes; raise AssertionError if an answer differs."""
    for query, ask in (
        ("collide", lambda scene: scene.collide("avatar", poses)),
        ("distance", lambda scene: scene.distance("avatar", poses, REACH)),
    ):
        first, second = ask(slabs), ask(boxes)
        assert (first.verdict == second.verdict).all()
        if query == "distance":
            assert (first.signed_distance == second.signed_distance).all()
        spent = time_in_turn([lambda ask=ask: ask(slabs), lambda ask=ask: ask(boxes)], PAIRS)
        ratio = mean_ratio(spent[:, 1] / spent[:, 0])
        for side, at, found in (("slabs", 0, first), ("boxes", 1, second)):
            part.add(case, side, query, float(np.median(spent[:, at])) / len(poses) * 1e6, "µs", len(poses))
            part.add(case, side, f"{query}, node visits", float(found.node_visits.mean()), "")
        for name, value in ratio._asdict().items():
            part.add(case, "boxes / slabs", f"{query}, {name}", value, "")


def _share(scene: Scene) -> float:
    """Return the share of the nodes in memory that have a box."""
    opened = scene.archives[0].take()
    arrays = opened.data.arrays
    marks = [
        arrays.words[rows + 7 : blocks : ROW_WORDS] for rows, blocks, _ in arrays.where.tolist() if rows >= 0
    ]
    share = float((np.concatenate(marks) < 0).mean())
    opened.release()
    return share
