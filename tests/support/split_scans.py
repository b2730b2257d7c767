"""Archives of two halves of a scan and of the whole, for tests of several archives."""

import os
from functools import cached_property
from pathlib import Path
from typing import Any

import archive_cases
import numpy as np
import synthetic_scans
from numpy.typing import NDArray
from point_clouds import signed_permutations
from solidcloud.server.archives.placed_archive import PlacedArchive
from solidcloud.server.observability.request_stats import RequestStats
from solidcloud.server.scene import DEFAULT_BUDGET, Scene

STEP = archive_cases.BINARY_STEP


BODY = np.array([[0.0, 0, 0], [0.125, 0, 0], [0.0, 0.25, 0], [0.0625, 0.0625, 0.125]])
RADIUS = 0.02
OPTIONS: dict[str, Any] = {
    "resolution": STEP, "leaf": 8, "degree": 3, "cell_points": 24, "keep": frozenset({"scan"}),
}  # fmt: skip
INTERPRETED = os.environ.get("NUMBA_DISABLE_JIT") == "1"
COUNT = 12 if INTERPRETED else 60


def halves() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return two scans on one lattice.

    Points of each lie beside those of the other; no point is in both.
    """
    points = np.rint(
        np.vstack([synthetic_scans.make_scan("corner", 8, 300), synthetic_scans.make_scan("noise", 9, 300)])
        / STEP
    )
    points = np.unique(np.maximum(points, 1.0), axis=0) * STEP
    points = points[np.random.default_rng(3).permutation(len(points))]
    # The least coordinates of both are 0, so that both lattices begin there.
    first = np.vstack([[[0.0, 0, 0]], points[::2]])
    second = np.vstack([[[0.0, 1, 1], [1, 0.0, 1], [1, 1, 0.0]], points[1::2]])
    return first, second


class Built:
    """Archives of each half, and of both as two scans; built at first use."""

    def __init__(self, folder: Path) -> None:
        self.points, self._folder = halves(), folder

    @cached_property
    def first(self) -> Path:
        """Build the archive of one half."""
        return archive_cases.build(self._folder, self.points[0], **OPTIONS).archive

    @cached_property
    def second(self) -> Path:
        """Build the archive of the other half."""
        return archive_cases.build(self._folder, self.points[1], **OPTIONS).archive

    @cached_property
    def whole(self) -> Path:
        """Build the archive of both."""
        return archive_cases.build(self._folder, np.vstack(self.points), **OPTIONS).archive


def several(*archives: tuple[Path, Any], **options: Any) -> Scene:
    """Open a scene of archives at poses, with an avatar."""
    metrics, how = RequestStats(), {"budget_bytes": DEFAULT_BUDGET, **options}
    opened = [PlacedArchive(path, "hall", pose=pose, took=metrics.loaded, **how) for path, pose in archives]
    scene = Scene(opened, "hall", metrics)
    scene.add_avatar("al", BODY, RADIUS)
    return scene


def near(rng: np.random.Generator, points: NDArray[np.float64], count: int = COUNT) -> NDArray[np.float64]:
    """Return poses of any rotation, with translations on a lattice; some touch."""
    poses = archive_cases.near_poses(rng, points, BODY, count, 0.09)
    poses[:, :3, 3] = np.rint(poses[:, :3, 3] / STEP) * STEP
    return poses


def exact_pose(rng: np.random.Generator) -> NDArray[np.float64]:
    """Return a pose that float64 inverts exactly.

    It rotates by right angles and translates by lattice steps.
    """
    turns = signed_permutations()
    return archive_cases.pose_of(
        turns[rng.integers(len(turns))], np.rint(rng.uniform(-9, 9, 3) / STEP) * STEP
    )
