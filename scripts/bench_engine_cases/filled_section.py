"""Section `filled`: closed meshes as avatars, filled and hollow, in turn on the same poses.

The walk displaced, by class: clear and near, and in contact; and the walk raised, far from the
scan. Times are processor time. It runs only on request (--only filled).
"""

import time

import numpy as np
import trimesh
from measurement.query_poses import FAR, Floats, classes
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.report.common.bench_results import Part
from solidcloud.server.report.common.machine import Clock
from solidcloud.server.report.common.paired_times import mean_ratio
from solidcloud.server.scene import Scene

from .bench_context import Bench

DISPLACED = 0.2  # along each axis [m]
RAISED = 30.0  # [m]
PAIRS = 20
FILLED, HOLLOW = "filled", "hollow"


def run(bench: Bench, clock: Clock) -> Part:
    """Time `collide` and `distance` of a person, a hull of a robot, a ball and a cube."""
    part = Part("filled")
    scene = bench.stack.enter_context(Scene.open(bench.archives[8]))
    displaced = bench.walk.copy()
    displaced[:, :3, 3] += bench.rng.uniform(-DISPLACED, DISPLACED, (len(displaced), 3))
    raised = bench.walk.copy()
    raised[:, 2, 3] += RAISED
    for name, mesh in _meshes().items():
        for kind in (FILLED, HOLLOW):
            info = scene.add_avatar(f"{name}, {kind}", mesh, hollow=kind == HOLLOW)
            part.add(name, kind, "points", float(info.points), "")
        apart = scene.distance(f"{name}, {FILLED}", displaced, FAR).signed_distance
        masks = classes(scene.collide(f"{name}, {FILLED}", displaced).verdict == Verdict.CONTACT, apart)
        for what, poses in (
            ("clear, near", displaced[masks["clear, near"]]),
            ("contact", displaced[masks["contact"]]),
            ("far", raised),
        ):
            if len(poses):
                _compare(part, scene, name, what, poses)
        clock.look_around()
    return part


def _meshes() -> dict[str, trimesh.Trimesh]:
    """Return meshes by name, their feet at the origin."""
    person = trimesh.creation.capsule(height=1.25, radius=0.25)
    hull = trimesh.creation.box((1.2, 0.8, 1.0))
    meshes = {"person": person, "hull": hull}
    meshes |= {"ball": trimesh.creation.icosphere(4, 0.5), "cube": trimesh.creation.box((1.0, 1.0, 1.0))}
    for mesh in meshes.values():
        mesh.apply_translation((0.0, 0.0, -mesh.bounds[0, 2]))
    return meshes


def _compare(part: Part, scene: Scene, name: str, what: str, poses: Floats) -> None:
    """Add the times and visits of both kinds, and their ratio."""
    for query, ask in (
        ("collide", lambda kind: scene.collide(f"{name}, {kind}", poses)),
        ("distance", lambda kind: scene.distance(f"{name}, {kind}", poses, FAR)),
    ):
        answers = {kind: ask(kind) for kind in (HOLLOW, FILLED)}
        touches = [answers[kind].verdict == Verdict.CONTACT for kind in (HOLLOW, FILLED)]
        assert (touches[0] <= touches[1]).all(), "what touches the surface touches the filled body"
        spent = np.empty((PAIRS, 2))
        for row in spent:
            for at, kind in enumerate((HOLLOW, FILLED)):
                begin = time.thread_time()
                ask(kind)
                row[at] = time.thread_time() - begin
        for kind, at in ((HOLLOW, 0), (FILLED, 1)):
            case = f"{name}, {what}"
            part.add(case, kind, query, float(np.median(spent[:, at])) / len(poses) * 1e6, "µs", len(poses))
            part.add(case, kind, f"{query}, node visits", float(answers[kind].node_visits.mean()), "")
        for value, number in mean_ratio(spent[:, 1] / spent[:, 0])._asdict().items():
            part.add(case, "filled / hollow", f"{query}, {value}", number, "")
