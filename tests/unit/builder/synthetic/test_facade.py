"""Compare the façade with its ground truth: rays cast at the mesh, without noise, find the figures."""

import numpy as np
import pytest
from solidcloud.builder.synthetic.facade import NAVE_X, SILL, build_facade
from solidcloud.builder.synthetic.scanner import RayScene, ScannerPose


def ranges(
    scene: RayScene, position: tuple[float, float, float], azimuth: list[float], elevation: list[float]
):
    """Ranges [m] from a position along azimuths and elevations [rad]."""
    return scene.cast(ScannerPose(position, 0.0), np.array([azimuth]), np.array([elevation])).range[0]


@pytest.mark.parametrize("width", [0.50, 2.40])
def test_every_door_is_as_wide_as_its_truth(width: float) -> None:
    facade = build_facade(seed=3, door=width)
    scene = RayScene(facade.mesh)
    assert [round(door.width, 12) for door in facade.truth.doors] == [width, 0.90, 0.70]
    for door in facade.truth.doors:
        middle = (door.x_left + door.x_right) / 2
        for y in np.linspace(door.y_front + 0.01, door.y_back - 0.01, 5):
            for z in np.linspace(door.sill + 0.01, door.springing - 0.01, 5):
                right, left = ranges(scene, (middle, y, z), [0.0, np.pi], [0.0, 0.0])
                assert middle + right == pytest.approx(door.x_right, abs=2e-6)
                assert middle - left == pytest.approx(door.x_left, abs=2e-6)


def test_nothing_stands_in_an_open_door() -> None:
    facade = build_facade()
    scene = RayScene(facade.mesh)
    for door in facade.truth.doors:
        for x in np.linspace(door.x_left + 1e-4, door.x_right - 1e-4, 30):
            for z in np.linspace(door.sill + 1e-4, door.springing, 30):
                ahead = ranges(scene, (x, door.y_front - 1.4, z), [np.pi / 2], [0.0])[0]
                assert ahead > door.y_back - door.y_front + 1.4 + 1.0, (door.name, x, z)


def test_walls_are_the_planes_of_the_truth() -> None:
    facade = build_facade()
    scene = RayScene(facade.mesh)
    rng = np.random.default_rng(5)
    for wall in facade.truth.walls:
        for _ in range(50):
            along, z = rng.uniform(wall.low, wall.high), rng.uniform(wall.z_low + 0.01, min(wall.z_high, 2.2))
            before = wall.offset + 0.3 * wall.facing
            position = (before, along, z) if wall.axis == "x" else (along, before, z)
            outward = 0.0 if wall.axis == "x" else np.pi / 2
            toward = outward + (np.pi if wall.facing > 0 else 0.0)
            assert ranges(scene, position, [toward], [0.0])[0] == pytest.approx(0.3, abs=1e-5), wall.name


def test_facade_fits_the_papers_voxel() -> None:
    low, high = build_facade().mesh.bounds
    assert ((high - low) < 32).all()
    assert high[0] - low[0] > 16 and high[2] > 14
    assert high[1] > 8 and NAVE_X > 6 and SILL > 0
