"""Archives of a few points, poses near them, and their expected verdicts, for tests of the engine."""

import math
from pathlib import Path
from typing import Any, NamedTuple

import naive
import numpy as np
import synthetic_scans
from kept_archives import build_or_copy
from numpy.typing import NDArray
from solidcloud.builder.config import BuildConfig
from solidcloud.server.scene import Scene

# 2^-10 m. A product of metres and a power of two is exact in float64, and so are the shifts and
# products of lattice points.
BINARY_STEP = 2.0**-10


class Case(NamedTuple):
    """An archive and the points it was built from. points: (n, 3) float64, world [m]."""

    archive: Path
    points: NDArray[np.float64]

    def judge(
        self, avatar: NDArray[np.float64], radius: float, poses: NDArray[np.float64], margin: float = 0.0
    ) -> NDArray[np.bool_]:
        """Return the expected contact (k,) of the avatar under each pose, by definition."""
        with Scene.open(self.archive) as scene:
            info = scene.info()
        found = (self.points, np.array(info.origin), info.lattice_step, info.radius)
        return naive.collide(*found, avatar, radius, poses, margin)


def build(folder: Path, points: NDArray[np.float64], **options: Any) -> Case:
    """Build an archive of points (n, 3) [m] in a new folder inside `folder`, with one job."""
    number = sum(1 for _ in folder.iterdir())
    scan = synthetic_scans.write_ply(folder / f"{number}.ply", points)
    options = {"voxel": 0.5, "resolution": 1e-4, "radius": 0.01, "jobs": 1} | options
    build_or_copy([scan], folder / f"archive{number}", BuildConfig(**options))
    return Case(folder / f"archive{number}", points)


def ask(
    case: Case,
    avatar: NDArray[np.float64],
    radius: float,
    poses: NDArray[np.float64],
    margin: float = 0.0,
    **options: Any,
) -> NDArray[np.uint8]:
    """Return the verdicts (k,) of a scene that is opened for this one query."""
    with Scene.open(case.archive, **options) as scene:
        scene.add_avatar("avatar", avatar, radius)
        answers = scene.collide("avatar", poses, margin)
        scene.residency.check()
    return answers.verdict


def random_rotation(rng: np.random.Generator) -> NDArray[np.float64]:
    """Return a random rotation (3, 3), uniform: that of a unit quaternion with four normal components."""
    q = rng.normal(size=4)
    w, x, y, z = q / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def pose_of(turn: NDArray[np.float64], shift: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the pose (4, 4) of a rotation (3, 3) and a translation."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, shift
    return pose


def near_poses(
    rng: np.random.Generator,
    points: NDArray[np.float64],
    avatar: NDArray[np.float64],
    count: int,
    farthest: float,
) -> NDArray[np.float64]:
    """Return poses (count, 4, 4) that put an avatar point within `farthest` [m] of a scan point."""
    poses = []
    for _ in range(count):
        turn = random_rotation(rng)
        away = rng.normal(size=3)
        away *= rng.uniform(0, farthest) / np.linalg.norm(away)
        at = points[rng.integers(len(points))] + away
        poses.append(pose_of(turn, at - turn @ avatar[rng.integers(len(avatar))]))
    return np.array(poses).reshape(-1, 4, 4)


def least_reach(
    case: Case, avatar: NDArray[np.float64], pose: NDArray[np.float64], origin: Any, step: float
) -> tuple[int, bool]:
    """Return the least reach, exact units, at which a pose is in contact.

    Also returns whether the nearest pair is then tangent.
    """
    b = naive.scan_units(naive.lattice_of(case.points, origin, step), step)
    square = naive.least_square(naive.placed_units(avatar, pose, origin), b)
    root = math.isqrt(square)
    tangent = root * root == square
    return (root if tangent else root + 1), tangent
