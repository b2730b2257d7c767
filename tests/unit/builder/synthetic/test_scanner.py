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
