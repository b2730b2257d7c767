"""Doors in thin walls: a body that overlaps a jamb slides off it and through, if it fits."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from check_doors_cases.door_walks import RADIUS, DoorScene, DoorWalk, ideal_passes, open_door
from check_doors_cases.door_walls import DoorWall

# A sheet of points with a door, without noise and with 2 mm.
SHEETS = [DoorWall(0.9), DoorWall(0.9, noise=0.002)]


@pytest.fixture(scope="module", params=SHEETS, ids=["exact", "noise of 2 mm"])
def door(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[DoorScene]:
    with open_door(request.param, tmp_path_factory.mktemp("door"), np.random.default_rng(3)) as door:
        yield door


@pytest.mark.parametrize("overlap", [0.004, 0.06])
def test_a_body_that_overlaps_the_jamb_of_a_sheet_walks_through(door: DoorScene, overlap: float) -> None:
    walked = door.walk(DoorWalk(overlap, 0.0, 1.0))
    assert walked.passed, walked
    assert walked.touched == 0


@pytest.mark.parametrize("overlap", [0.05])
def test_a_body_that_walks_obliquely_to_the_jamb_walks_through(door: DoorScene, overlap: float) -> None:
    """The direction (0.5, 1) leads along the wall, away from the door."""
    assert door.walk(DoorWalk(overlap, float(np.arctan2(0.5, 1.0)), 1.0)).passed


def test_a_body_does_not_stick_inside_the_doorway(door: DoorScene) -> None:
    """It is pushed along (1, 0.6) from the middle of the door, against the jamb and past it."""
    x, y = door.push(np.array([0.0, -0.05]), np.array([1.0, 0.6]), 40)
    assert y > RADIUS, (x, y)


def test_a_body_wider_than_the_door_does_not_pass(tmp_path: Path) -> None:
    wall = DoorWall(0.49)
    walks = [DoorWalk(0.005, 0.0, 1.0)]
    assert not ideal_passes(wall, walks).any()
    with open_door(wall, tmp_path, np.random.default_rng(4)) as narrow:
        for walk in walks:
            walked = narrow.walk(walk)
            assert walked.end[1] < 0.0 and walked.touched == 0
