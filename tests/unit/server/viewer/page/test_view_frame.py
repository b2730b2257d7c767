"""Test the frame of the page: near the origin, z up, and back to the world."""

import numpy as np
import pytest
from solidcloud.server.viewer.page.view_frame import ViewFrame

MAP = [[4_465_000.25, 5_330_000.5, 510.0], [4_465_040.0, 5_330_060.0, 530.0]]


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 1, 0), (0, -2, 0), (1, 0, 0), (0.2, -0.3, 0.9), (0, 0, -1)])
def test_frame_has_z_up_is_right_handed_and_goes_back(up: tuple[float, ...]) -> None:
    frame = ViewFrame(MAP, up)
    assert np.allclose(frame.axes @ frame.axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(frame.axes) == pytest.approx(1.0)
    assert np.allclose(frame.directions(np.array(up) / np.linalg.norm(up)), (0, 0, 1))
    places = np.array(MAP)
    assert np.abs(frame.points(places)).max() < 60
    assert np.allclose(frame.to_world(frame.points(places)), places, rtol=0, atol=1e-8)


def test_points_keep_their_precision_at_map_coordinates() -> None:
    frame = ViewFrame(MAP)
    place = np.array([4_465_012.3456, 5_330_001.2345, 512.0001])
    assert np.allclose(frame.to_world(frame.points(place).astype(np.float32)), place, rtol=0, atol=5e-6)


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 1, 0), (0.2, -0.3, 0.9)])
@pytest.mark.parametrize("yaw", [-3.0, np.pi / 2])
def test_standing_avatar_faces_its_yaw_and_stands_along_up(up: tuple[float, ...], yaw: float) -> None:
    frame = ViewFrame(MAP, up)
    pose = frame.standing(MAP[0], yaw)
    assert np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)
    assert np.allclose(pose[:3, 2], np.array(up) / np.linalg.norm(up))
    assert frame.yaw(pose) == pytest.approx(yaw)
    assert np.allclose(frame.pose(pose)[:3, 3], frame.points(MAP[0]))


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 1, 0), (0.2, -0.3, 0.9)])
def test_poses_go_to_the_frame_and_back(up: tuple[float, ...]) -> None:
    frame = ViewFrame(MAP, up)
    poses = np.stack([frame.standing(place, yaw) for place, yaw in zip(MAP, (0.3, -2.0), strict=True)])
    here = np.stack([frame.pose(pose) for pose in poses])
    assert np.allclose(frame.poses_to_world(here), poses, rtol=0, atol=1e-8)
