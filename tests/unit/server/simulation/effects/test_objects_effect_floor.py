"""Test pushes of objects that stand on a floor: flat or rough, in contact with it or just above it."""

from pathlib import Path

import numpy as np
import pytest
from movable_objects import AVATARS, MOVING, USER, free_of, item, where
from moving_bodies import INTERPRETED, at, staged
from numpy.typing import NDArray
from solidcloud.schemas.wire.answers import Verdict

# The archive's spheres have a radius of WALL in `staged`; a dense floor hides their shape.
SPACING = 0.2 if INTERPRETED else 0.04
RADIUS = 0.12 if INTERPRETED else 0.06
BOTTOM = 0.2  # of the crate, below its origin [m]
FRAMES, STEP = (4, 0.1) if INTERPRETED else (40, 0.02)


def floor(noise: float = 0.0, wall: float | None = None) -> NDArray[np.float64]:
    """Return points (n, 3) of a floor at z = 0. noise: [m].  wall: y of a wall along x [m]."""
    across = np.arange(-1.2, 2.4, SPACING)
    x, y = (axis.ravel() for axis in np.meshgrid(across, across))
    points = np.column_stack([x, y, np.zeros(x.size)])
    if wall is not None:
        x, z = (axis.ravel() for axis in np.meshgrid(across, np.arange(SPACING, 1.0, SPACING)))
        points = np.concatenate([points, np.column_stack([x, np.full(x.size, wall), z])])
    return points + np.random.default_rng(4).normal(scale=noise, size=points.shape) if noise else points


@pytest.mark.interpreted
@pytest.mark.parametrize("noise", [0.0, 0.002])
@pytest.mark.parametrize("above", [-0.008, 0.0015])
def test_an_object_that_touches_the_floor_is_pushed_along_it(
    tmp_path: Path, above: float, noise: float
) -> None:
    height = RADIUS + BOTTOM + above
    with staged(
        tmp_path, MOVING, floor(noise), avatars=AVATARS, objects=(item("crate", at(0.5, 0, height)),)
    ) as stage:
        body = stage.enter("c/u", USER, at(0, 0, height + 0.05))
        for _ in range(FRAMES):
            stage.step("c/u", (STEP, 0, 0))
            there = where(stage, "crate")
            assert abs(there[2, 3] - height) < 0.02, "it stays at the floor"
        assert body.pose[0, 3] > 0.95 * FRAMES * STEP
        assert there[0, 3] > body.pose[0, 3] + 0.3
        assert abs(there[1, 3]) < 1e-9 and free_of(stage, "crate")
        before = there[2, 3]
        stage.step("c/u", (STEP, 0, 0))
        assert abs(where(stage, "crate")[2, 3] - before) < 0.006


def test_an_object_that_touches_a_wall_is_pushed_along_it_but_not_into_it(tmp_path: Path) -> None:
    side = 0.3
    beside = side - RADIUS - BOTTOM + 0.002  # 2 mm deep in the wall
    objects = (item("crate", at(0.5, beside, RADIUS + BOTTOM - 0.001)),)
    with staged(tmp_path, MOVING, floor(wall=side), avatars=AVATARS, objects=objects) as stage:
        body = stage.enter("c/u", USER, at(0, beside - 0.02, RADIUS + 0.3))
        for _ in range(FRAMES):
            stage.step("c/u", (STEP, 0, 0))
        assert body.pose[0, 3] > 0.9 * FRAMES * STEP and where(stage, "crate")[0, 3] > body.pose[0, 3] + 0.3
        stood = where(stage, "crate")
        body.pose[:] = at(stood[0, 3], stood[1, 3] - 0.6, RADIUS + 0.3)
        for _ in range(FRAMES):
            stage.step("c/u", (0, STEP, 0))
        assert where(stage, "crate")[1, 3] < side - RADIUS - BOTTOM + 0.003, "no deeper into the wall"
        assert np.abs(where(stage, "crate")[:3, 3] - stood[:3, 3]).max() < 0.02


def test_an_object_too_deep_in_the_floor_or_before_a_step_is_not_pushed(tmp_path: Path) -> None:
    points = floor()
    points[:, 2] += np.where(points[:, 0] > 1.0, 0.06, 0.0)
    objects = (
        item("deep", at(0.5, 1.2, RADIUS + BOTTOM - 0.04)),
        item("crate", at(0.5, 0, RADIUS + BOTTOM + 0.002)),
    )
    with staged(tmp_path, MOVING, points, avatars=AVATARS, objects=objects) as stage:
        body = stage.enter("c/u", USER, at(0, 1.2, 0.4))
        for _ in range(FRAMES):
            stage.step("c/u", (STEP, 0, 0))
        assert np.array_equal(where(stage, "deep"), at(0.5, 1.2, RADIUS + BOTTOM - 0.04))
        body.pose[:] = at(0, 0, 0.4)
        for _ in range(FRAMES):
            stage.step("c/u", (STEP, 0, 0))
            assert stage.world.collide(AVATARS["crate"], where(stage, "crate")) == Verdict.CLEAR
        assert where(stage, "crate")[0, 3] < 1.0 - BOTTOM + 0.06 and where(stage, "crate")[2, 3] < 0.3
