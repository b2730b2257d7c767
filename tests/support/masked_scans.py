"""Two scans and two boxes, and scenes without the points in the boxes, for tests of masked stores."""

import hashlib
from functools import partial
from pathlib import Path
from typing import Any

import archive_cases
import numpy as np
import radius_class_archives
import synthetic_scans
from kept_archives import build_or_copy
from numpy.typing import NDArray
from solidcloud.builder.config import BuildConfig
from solidcloud.schemas.scene.effect_table import ThroughBox
from solidcloud.server.archives.masked_store import MaskedStore
from solidcloud.server.scene import Scene

STEP = archive_cases.BINARY_STEP


# Voxels of half a metre, points from 0 to 2 m on each axis: 0.5 and 1 are borders between voxels.
OPTIONS: dict[str, Any] = {
    "voxel": 0.5, "resolution": STEP, "radius": 0.01, "jobs": 1, "leaf": 8, "degree": 3, "cell_points": 24,
    "models": frozenset({"mean", "local", "border"}), "keep": frozenset({"scan", "intensity"}),
}  # fmt: skip
BODY = np.array([[0.0, 0, 0], [0.11, 0, 0], [0.0, 0.21, 0], [0.05, 0.05, 0.1]])
# These points give every archive the same lattice and bounds, whatever is left out between them.
ENDS = np.array([[0.0, 0, 0], [2.0, 2.0, 2.0]])
DOOR = ThroughBox("door", (0.375, 0.25, 0.25), (0.625, 1.125, 0.875))
ROOM = ThroughBox("room", (1.0, 1.0, 0.5), (1.5, 1.5, 1.0))


def on_lattice(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the points moved onto the lattice, so that no build moves them."""
    return np.rint(points / STEP) * STEP


def two_scans() -> list[NDArray[np.float64]]:
    """Return a scan of scattered points and a scan of a corner.

    Some points lie on the borders of the boxes and in both scans.
    """
    first = on_lattice(synthetic_scans.make_scan("noise", 5, 500))
    second = on_lattice(synthetic_scans.make_scan("corner", 6, 300))
    edges = np.array(
        [DOOR.low, DOOR.high, ROOM.low, ROOM.high, [0.375, 0.5, 0.875], [0.376953125, 0.25, 0.5]]
    )
    just_out = np.array([[0.625 + STEP, 0.5, 0.5], [0.5, 0.25 - STEP, 0.5], [0.5, 0.5, 0.875 + STEP]])
    return [np.vstack([ENDS, first, edges, just_out]), np.vstack([ENDS, second, edges])]


def in_boxes(points: NDArray[np.float64], boxes: tuple[ThroughBox, ...]) -> NDArray[np.bool_]:
    """Return which points are in the boxes, point by point, for an archive at the identity."""
    return np.array(
        [
            any(all(low <= c <= high for low, c, high in zip(b.low, p, b.high, strict=True)) for b in boxes)
            for p in points.tolist()
        ]
    )


def build(folder: Path, parts: list[NDArray[np.float64]]) -> Path:
    """Build an archive of scans whose points have classes and intensities by position alone."""
    folder.mkdir()
    files: list[Path] = []
    digests = [b""]
    for i, xyz in enumerate(parts):
        # Scans are numbered by the hashes of their files: the points are rotated until the numbers
        # are in order.
        for turn in range(64):
            points = np.roll(xyz, turn, axis=0)
            intensity = np.floor(points.sum(axis=1) * 64).astype(np.float32)
            file = synthetic_scans.write_ply(folder / f"{i}.ply", points, intensity)
            digest = hashlib.sha256(file.read_bytes()).digest()
            if digest > digests[-1] and (i > 0 or digest[0] < 64):
                break
        files.append(file)
        digests.append(digest)
    assert digests == sorted(digests)
    with radius_class_archives.any_classes():
        build_or_copy(files, folder / "archive", BuildConfig(**OPTIONS))
    return folder / "archive"


def open_without(archive: Path, *boxes: ThroughBox, pose: Any = None, **options: Any) -> Scene:
    """Open a scene without the points in the boxes."""
    masked = partial(MaskedStore, boxes=[(box.low, box.high) for box in boxes], pose=pose)
    return Scene.open(archive, "hall", open_store=masked, **options)
