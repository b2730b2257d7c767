"""Test that simulated scans have noise along the ray, shadows, falling density and lost returns."""

from functools import cache

import numpy as np
import pytest
from solidcloud.builder.synthetic.facade import build_facade
from solidcloud.builder.synthetic.scanner import (
    LATTICE,
    RayScene,
    ScannerPose,
    SimulatedScan,
    plan_stations,
    simulate_scan,
)
from solidcloud.builder.synthetic.shapes import Parts

FORECOURT = ScannerPose((0.8, -13.0, 1.7), 0.3)


@cache
def world() -> RayScene:
    return RayScene(build_facade().mesh)


@cache
def scanned(place: ScannerPose = FORECOURT, quota: int = 60_000) -> SimulatedScan:
    step, quotas = plan_stations(world(), [place], quota)
    return simulate_scan(world(), place, step, quotas[0], (2012, 1))


@pytest.mark.parametrize("quota", [1_000, 7_777, 60_000])
def test_scan_has_exactly_its_quota_on_the_lattice(quota: int) -> None:
    made = scanned(FORECOURT, quota)
    assert made.xyz.shape == (quota, 3)
    assert np.abs(made.xyz / LATTICE - np.rint(made.xyz / LATTICE)).max() < 1e-6
    assert made.intensity.shape == (quota,)
    assert made.intensity.std() > 0


def test_same_key_same_points_and_another_key_others() -> None:
    step, quotas = plan_stations(world(), [FORECOURT], 5_000)
    one, two, other = (
        simulate_scan(world(), FORECOURT, step, quotas[0], key) for key in ((1, 2), (1, 2), (1, 3))
    )
    assert np.array_equal(one.xyz, two.xyz)
    assert not np.array_equal(one.xyz, other.xyz)


def test_range_noise_on_a_wall_is_two_millimetres() -> None:
    made, wall = scanned(), build_facade().truth.wall("cloister")
    p = made.xyz
    on = (np.abs(p[:, 0] - wall.offset) < 0.03) & (p[:, 1] > wall.low) & (p[:, 1] < wall.high)
    on &= (p[:, 2] > 0.2) & (p[:, 2] < wall.z_high - 0.2)
    ray = p[on] - FORECOURT.position
    cosine = np.abs(ray[:, 0]) / np.linalg.norm(ray, axis=1)
    # Off the plane, the noise along the ray shows by the cosine of the incidence.
    along = (p[on, 0] - wall.offset) / cosine
    assert on.sum() > 1_000
    assert np.std(along) == pytest.approx(0.002, rel=0.08)
    assert abs(np.mean(along)) < 2e-4


def test_columns_cast_shadows() -> None:
    column = build_facade().truth.column("forecourt left")
    p = scanned().xyz[:, :2] - FORECOURT.position[:2]
    to = np.array([column.x, column.y]) - FORECOURT.position[:2]
    distance = np.linalg.norm(to)
    along = p @ to / distance
    aside = np.abs(p @ np.array([-to[1], to[0]]) / distance) / along * distance
    low = scanned().xyz[:, 2] < FORECOURT.position[2]
    behind = low & (along > distance + column.radius + 1.6)
    assert (behind & (aside < column.radius - 0.02)).sum() == 0
    assert (behind & (aside > column.radius + 0.1) & (aside < 2 * column.radius)).sum() > 10


@pytest.mark.parametrize("edges", ["upright", "level"])
def test_some_returns_are_mixed_between_two_depths(edges: str) -> None:
    """Panels half a metre before a wall: their edges leave points in the air between, and few of them."""
    parts = Parts()
    parts.box((-9.0, 9.0), (4.5, 4.6), (-9.0, 9.0))
    # Many slats: one edge alone may fall between two columns of the grid.
    for low in np.arange(-3.0, 6.0, 0.71):
        x, z = (low, low + 0.37), (-20.0, 20.0)
        parts.box(x if edges == "upright" else z, (4.0, 4.1), z if edges == "upright" else x)
    place = ScannerPose((0.0, 0.0, 1.7), 0.0)
    made = simulate_scan(RayScene(parts.mesh()), place, np.deg2rad(0.25), 100_000, (6,))
    y = made.xyz[:, 1]
    # The panels end at 4.1; what hangs between them and the wall is mixed.
    air = (y > 4.12) & (y < 4.48)
    assert 15 < air.sum() < 0.01 * len(y)
    assert (y[air] < 4.3).any() and (y[air] > 4.3).any()
