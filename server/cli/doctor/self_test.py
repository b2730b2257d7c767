"""Self-test in a process of its own: build a small scan, query it, and compare with brute force.

    python -m solidcloud.server.cli.doctor.self_test FOLDER

Everything is done twice. The first time may compile kernels; the second takes the time of a machine
that has them. Prints the result as JSON.
"""

import json
import sys
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....builder.config import BuildConfig
from ....builder.pipeline import build_archive
from ....schemas.wire.answers import Verdict
from ...scene import Scene

_Floats = NDArray[np.float64]

_SCAN_POINTS, _AVATAR_POINTS, _POSES = 4000, 60, 150
_AVATAR_RADIUS, _REACH = 0.04, 15.0
# Rounding of a distance [m]; a pose as near to contact as this has either verdict.
_TOLERANCE = 1e-6
_ORIGIN = np.array([4000.0, -2000.0, 300.0])


class SelfTest(NamedTuple):
    """Result of the self-test.

    first_seconds, seconds: duration of the first and of the second time [s].
    points: of the scan.  poses: number of poses compared.  contacts: of them in contact.
    wrong: sentences about differences from brute force.
    """

    first_seconds: float
    seconds: float
    points: int
    poses: int
    contacts: int
    wrong: list[str]


def run_self_test(folder: Path) -> SelfTest:
    """Run the self-test with files in an existing empty folder."""
    rng = np.random.default_rng(2012)
    scan, avatar, poses = make_scan(rng), make_avatar(rng), make_poses(rng)
    path = folder / "scan.xyz"
    np.savetxt(path, scan, fmt="%.4f")
    answers, times = [], []
    for name in ("first", "second"):
        begin = time.perf_counter()
        build_archive([path], folder / name, BuildConfig(voxel=2.0, jobs=1, memory_bytes=512 << 20))
        with Scene.open(folder / name) as scene:
            scene.add_avatar("body", avatar, _AVATAR_RADIUS)
            radius = scene.info().radius
            verdict = scene.collide("body", poses).verdict
            answers.append((verdict, scene.distance("body", poses, _REACH).signed_distance))
        times.append(time.perf_counter() - begin)
    expected = brute_force(scan, avatar, poses, radius + _AVATAR_RADIUS)
    wrong = [fault for verdict, signed in answers for fault in compare(verdict, signed, expected)]
    return SelfTest(times[0], times[1], len(scan), len(poses), int((expected <= 0).sum()), wrong)


def make_scan(rng: np.random.Generator) -> _Floats:
    """Return the points of a floor, a wall and a pillar (n, 3) [m], in steps of 0.1 mm."""
    points = rng.uniform(-3, 3, (_SCAN_POINTS, 3))
    part = _SCAN_POINTS // 3
    points[:part, 2] = rng.normal(0, 0.003, part)
    points[part : 2 * part, 0] = 2.0
    around = rng.uniform(0, 2 * np.pi, _SCAN_POINTS - 2 * part)
    points[2 * part :, :2] = np.stack([0.3 * np.cos(around), 0.3 * np.sin(around)], axis=1) - 1.0
    return np.asarray(np.round(points, 4) + _ORIGIN)


def make_avatar(rng: np.random.Generator) -> _Floats:
    """Return the points of a ball (n, 3) [m]."""
    points = rng.normal(size=(_AVATAR_POINTS, 3))
    points *= 0.3 / np.linalg.norm(points, axis=1)[:, None]
    return np.asarray(points)


def make_poses(rng: np.random.Generator) -> _Floats:
    """Return poses (k, 4, 4) in and around the scan, with rotations."""
    poses = np.tile(np.eye(4), (_POSES, 1, 1))
    turned, _ = np.linalg.qr(rng.normal(size=(_POSES, 3, 3)))
    poses[:, :3, :3] = turned * np.sign(np.linalg.det(turned))[:, None, None]
    poses[:, :3, 3] = _ORIGIN + rng.uniform(-4, 4, (_POSES, 3))
    return poses


def brute_force(scan: _Floats, avatar: _Floats, poses: _Floats, radii: float) -> _Floats:
    """Return the signed distance (k,) of each pose [m], from every pair of points.

    radii: sum of the radii of a scan point and an avatar point [m].
    """
    found = np.empty(len(poses))
    for k, pose in enumerate(poses):
        placed = avatar @ pose[:3, :3].T + pose[:3, 3]
        squares = ((placed[:, None] - scan) ** 2).sum(axis=2)
        found[k] = np.sqrt(squares.min()) - radii
    return found


def compare(verdict: NDArray[np.uint8], signed: _Floats, expected: _Floats) -> list[str]:
    """Return sentences about the answers that differ from the expected signed distances."""
    decided = np.abs(expected) > _TOLERANCE
    verdicts = (verdict != np.where(expected <= 0, Verdict.CONTACT, Verdict.CLEAR)) & decided
    distances = ~(np.abs(signed - expected) <= _TOLERANCE)
    wrong = []
    if verdicts.any():
        wrong.append(f"collide: {verdicts.sum()} of {len(expected)} verdicts differ from brute force")
    if distances.any():
        wrong.append(f"distance: {distances.sum()} of {len(expected)} distances differ from brute force")
    return wrong


if __name__ == "__main__":
    print(json.dumps(run_self_test(Path(sys.argv[1]))._asdict()))
