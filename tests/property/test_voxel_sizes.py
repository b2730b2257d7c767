"""Every answer of the same scan in voxels of three sizes is the same, bit for bit, and so is the pair it names."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import archive_cases
import naive_sweep
import numpy as np
import pytest
from numpy.typing import NDArray
from sample_sizes import sample
from solidcloud.schemas.wire.answers import Cost, SweepAnswers, Verdict
from solidcloud.schemas.wire.arrays import array_fields
from solidcloud.server.scene import Scene

SIZES = (1.0, 3.3, 8.0)
STEP = archive_cases.BINARY_STEP
RADIUS = 0.125
MODELS = (None, "local", "border")
# Columns that count work.
COSTS = ("voxels_missing", "node_visits", "point_tests", "steps")


def scan(rng: np.random.Generator, kind: str) -> NDArray[np.float64]:
    """Return points (n, 3) [m] in 10 m, on both sides of the borders of all voxels."""
    if kind == "grid":  # many pairs are equally far apart, and many points have the same x
        around = np.stack(np.meshgrid(*[np.arange(8) * 0.25 - 0.875] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        points = np.concatenate([around + at for at in ([1, 1, 1], [3.25, 3.25, 3.25], [8, 8, 8])])
    else:
        points = np.concatenate([rng.normal(at, 0.5, (500, 3)) for at in (1.0, 3.3, 8.0)])
    ends = np.array([[-0.5, -0.5, -0.5], [10.0, 10.0, 10.0]])
    return np.rint(np.concatenate([np.clip(points, -0.5, 10.0), ends]) / STEP) * STEP


def body(rng: np.random.Generator) -> NDArray[np.float64]:
    """Return points (m, 3) [m]: scattered ones, and pairs that are equally far from points between them."""
    corners = np.stack(np.meshgrid(*[[-0.25, 0.25]] * 3), axis=-1).reshape(-1, 3)
    return np.concatenate([corners, rng.uniform(-0.4, 0.4, (30, 3))])


def poses(rng: np.random.Generator, points: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Return poses (count, 4, 4) near scan points: half at rest in the grid, half turned anyhow."""
    found = np.tile(np.eye(4), (count, 1, 1))
    found[:, :3, 3] = points[rng.integers(len(points), size=count)]
    found[::2, :3, 3] = np.rint(found[::2, :3, 3] / 0.125) * 0.125
    for pose in found[1::2]:
        pose[:3, :3] = archive_cases.random_rotation(rng)
        pose[:3, 3] += rng.normal(size=3) * 0.3
    return found


def ask_all(scene: Scene, seed: int, points: NDArray[np.float64]) -> Iterator[tuple[str, Cost]]:
    """Ask every question with every radius model, and return each answer with a name."""
    rng = np.random.default_rng(seed)
    scene.add_avatar("body", body(rng), 0.0625)
    at = poses(rng, points, 24)
    to = at.copy()
    to[:, :3, 3] += rng.normal(size=(24, 3)) * 0.5
    to[1::3, :3, :3] = [archive_cases.random_rotation(rng) for _ in to[1::3]]
    away = to.copy()
    away[:, :3, 3] += rng.normal(size=(24, 3)) * 4
    journey = away.copy()
    journey[:, :3, 3] += rng.normal(size=(24, 3)) * 40
    places = np.concatenate([at[:, :3, 3], points[:12], points[:12] + [0, 0.125, 0], rng.uniform(0, 9, (12, 3))])
    ways = np.concatenate([np.tile(np.eye(3), (10, 1)), rng.normal(size=(30, 3))])
    for model in MODELS:
        own: dict[str, Any] = {} if model is None else {"radius_model": model}
        for name, answer in {
            "collide": lambda: scene.collide("body", at, 0.03125, **own),
            "distance": lambda: scene.distance("body", at, 2.0, **own),
            "contacts": lambda: scene.contacts("body", at, 50, 0.03125, **own),
            "clusters": lambda: scene.contacts("body", at, 7, 0.0, 0.3, **own),
            "sweep": lambda: scene.sweep("body", at, to, **own),
            "arrivals": lambda: scene.sweep("body", away, at, **own),
            "journeys": lambda: scene.sweep("body", journey, at, **own),
            "raycast": lambda: scene.raycast(places, ways, 9.0, **own),
            "within": lambda: scene.within(places, 1.5, **own),
            "objects": lambda: scene.objects([("body", pose, 1, 0xFFFFFFFF) for pose in at], **own),
        }.items():  # fmt: skip
            yield f"{name} {model}", answer()
