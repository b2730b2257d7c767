"""Test the walk: rigid, continuous, above the floor, through the door, in contact where intended."""

from pathlib import Path

import laspy
import numpy as np
import pytest
from scipy.spatial import cKDTree
from solidcloud.builder.synthetic.facade import build_facade
from solidcloud.builder.synthetic.figure import figure_points
from solidcloud.builder.synthetic.scenes import make_facade
from solidcloud.builder.synthetic.walk import HALF_WIDTH, SOLE_HEIGHT, floor_height, walk_poses

TRUTH = build_facade().truth
FIGURE = figure_points()


def test_walk_is_continuous_at_a_humans_speed() -> None:
    _, poses = walk_poses(TRUTH)
    step = np.diff(poses[:, :3, 3], axis=0)
    assert np.linalg.norm(step[:, :2], axis=1).max() < 2.0 / 30
    assert 1.2 < 30 * np.linalg.norm(step, axis=1).mean() < 1.6
    heading = np.unwrap(np.arctan2(poses[:, 1, 1], poses[:, 0, 1]))
    assert np.abs(np.diff(heading)).max() < np.deg2rad(15)


def test_feet_are_three_centimetres_above_the_floor() -> None:
    _, poses = walk_poses(TRUTH)
    below = np.array([-0.39, -0.2, 0.0, 0.2, 0.39])
    reach = np.stack([poses[:, :2, 3] + along * poses[:, :2, 1] for along in below])
    floors = np.stack([floor_height(TRUTH, spots) for spots in reach])
    sole = poses[:, 2, 3] + FIGURE[:, 2].min()
    assert (sole - floors.max(axis=0)).min() > SOLE_HEIGHT - 1e-9
    flat = np.ptp(floors, axis=0) == 0
    assert np.median((sole - floors[0])[flat]) == pytest.approx(SOLE_HEIGHT, abs=1e-12)
    assert floors.max() == TRUTH.floor and floors.min() == 0.0


@pytest.mark.parametrize("width", [1.00, 2.40])
def test_walk_goes_through_the_open_door_both_ways(width: float) -> None:
    truth = build_facade(door=width).truth
    _, poses = walk_poses(truth)
    door = truth.door("main")
    x, y = poses[:, 0, 3], poses[:, 1, 3]
    within = (y > door.y_front) & (y < door.y_back)
    within &= np.abs(x) < 3
    assert (np.abs(x[within]) < width / 2 - HALF_WIDTH + 0.02).all()
    ways = poses[within, 1, 1]
    assert (ways > 0.9).any() and (ways < -0.9).any()
    # In along the middle.
    assert np.abs(x[within][ways > 0.9]).max() < 0.02


def test_a_tenth_of_the_walk_is_in_contact(tmp_path: Path) -> None:
    """On the paper's count of points; radii are half the mean closest-point distances ([Fig12])."""
    scene = make_facade(tmp_path / "hall.laz")
    cloud = np.asarray(laspy.read(scene.paths[0]).xyz)
    tree = cKDTree(cloud)
    sample = cloud[:: len(cloud) // 20_000]
    reach = (
        tree.query(sample, k=2)[0][:, 1].mean() / 2 + cKDTree(FIGURE).query(FIGURE, k=2)[0][:, 1].mean() / 2
    )
    assert reach < SOLE_HEIGHT - 0.003
    poses = walk_poses(TRUTH)[1][::10]
    placed = np.einsum("kij,nj->kni", poses[:, :3, :3], FIGURE) + poses[:, None, :3, 3]
    nearest = tree.query(placed, distance_upper_bound=0.1)[0].min(axis=1)
    touched = nearest <= reach
    assert 80 / 10 <= touched.sum() <= 150 / 10
    assert (nearest < 0.1).mean() > 0.8
    # It touches outside, in the door and in the nave.
    y = poses[touched, 1, 3]
    assert (y < -5).any() and ((y > 0) & (y < 1.2)).any() and (y > 5).any()
