"""Test the leak of generated walls of known spacing, against brute force and their known geometry."""

from pathlib import Path

import archive_cases
import numpy as np
import pytest
import radius_class_archives
from numpy.typing import NDArray
from solidcloud.builder.synthetic.places import WallPlaces
from solidcloud.server.report.common.wall_leak import leak_depths
from solidcloud.server.scene import Scene

PROBE = 0.05
RADIUS = 0.012


def wall(spacing: float, half: int) -> NDArray[np.float64]:
    """Return a square grid (n, 3) on the plane y = 0, facing -y.

    It has 2 half + 1 points a side, one at the origin.
    """
    x, z = np.meshgrid(np.arange(-half, half + 1) * spacing, np.arange(-half, half + 1) * spacing)
    return np.column_stack([x.ravel(), np.zeros(x.size), z.ravel()])


def places(points: NDArray[np.float64]) -> WallPlaces:
    """Return places on the plane y = 0, facing -y."""
    return WallPlaces(points, np.tile([0.0, -1.0, 0.0], (len(points), 1)), np.ones(len(points)))


@pytest.mark.parametrize("model", ["mean:0.5", "mean", "mean:3", "local", "local+border:2"])
def test_depths_of_a_random_wall_are_those_of_brute_force(tmp_path: Path, model: str) -> None:
    """Test a noisy wall of random density far from the origin.

    A second sheet far behind changes nothing.
    """
    rng = np.random.default_rng(2012)
    flat = np.column_stack([rng.uniform(-1, 1, 900), rng.normal(0, 0.002, 900), rng.uniform(-1, 1, 900)])
    flat = np.rint(np.concatenate([flat, flat + np.array([0, 0.4, 0])]) * 1e4) / 1e4
    spots = np.column_stack([rng.uniform(-0.8, 0.8, 300), np.zeros(300), rng.uniform(-0.8, 0.8, 300)])
    origin = np.array([300.0, -5000.0, 40.0])
    archive = archive_cases.build(
        tmp_path, flat + origin, voxel=8.0, radius=RADIUS, models=frozenset({"mean", "local", "border"})
    ).archive
    with Scene.open(archive) as scene:
        found = leak_depths(scene, places(spots + origin), radius_model=model)
        low = np.array(scene.info().origin) - origin
    steps, units = radius_class_archives.stored_radii(archive, model)
    points, reach = steps * 1e-4 + low, PROBE + units * 2.0**-26
    assert len(points) == len(flat) and (len(np.unique(units)) > 1) == ("local" in model)
    for spot, at in zip(spots, found, strict=True):
        under = reach**2 - (points[:, 0] - spot[0]) ** 2 - (points[:, 2] - spot[2]) ** 2
        near = (under >= 0) & (points[:, 1] < 0.1)
        # The centre moves from -y; the first sphere that it touches on its path stops it.
        first = (points[near, 1] - np.sqrt(under[near])).min() if near.any() else np.inf
        expected = min(first + PROBE, 2 * PROBE)
        assert at == pytest.approx(expected, abs=3e-6)
