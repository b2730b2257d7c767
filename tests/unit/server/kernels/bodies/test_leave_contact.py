"""What rules points and nodes out changes no bit of the heights and times that motions in contact use."""

import numpy as np
from solidcloud.server.avatars.avatar_model import make_avatar
from solidcloud.server.kernels.bodies import leave_contact as kernel


def test_heights_by_the_tree_are_those_of_all_centres(rng: np.random.Generator) -> None:
    for count in (1, 70, 3000):
        points = rng.normal(0.0, 0.4, (count, 3)) + np.array([7.0, -3.0, 0.5])
        body, found = make_avatar(points, 0.02).reference, np.empty(len(kernel.DIRECTIONS))
        kernel.find_heights(body, kernel.DIRECTIONS, found)
        x, y, z = points.T
        naive = [((a * x + b * y) + c * z).max() for a, b, c in kernel.DIRECTIONS]
        assert found.tolist() == naive


def test_points_beside_the_way_meet_nothing(rng: np.random.Generator) -> None:
    """Every point is examined if the avatar's box is without end."""
    centres = rng.uniform(-0.3, 0.3, (400, 3))
    body = make_avatar(centres, 0.02).reference
    points, reach = rng.uniform(-1.0, 1.0, (5000, 3)), rng.uniform(0.03, 0.05, 5000)
    box, none = np.array([centres.min(axis=0), centres.max(axis=0)]), np.zeros(5000, bool)
    met = 0
    for length in (0.0, 0.04, 0.5):
        found = []
        for each in (box, np.array([[-np.inf] * 3, [np.inf] * 3])):
            times, own = np.empty(5000), np.zeros((5000, 3))
            way, planes = np.array([length, -length / 2, 0.0]), np.empty((0, kernel.PLANE))
            kernel.meet_points(body, each, points, reach, none, planes, way, times, own)
            found.append(times.tobytes() + own.tobytes())
            met += int((times <= 1.0).sum())
        assert found[0] == found[1]
    assert met > 100
