"""Test which places lie outside a scan, and in which units they would lie inside."""

import numpy as np
import pytest
from solidcloud.server.cli.input.scan_bounds import (
    BodyPlaces,
    PointPlaces,
    RayPlaces,
    box_of,
    lying_outside,
    outside_line,
)

LOW, HIGH = np.array([-1.0, -2.0, 0.0]), np.array([4.0, 3.0, 5.0])


class Info:
    """The fields of a SceneInfo that are read."""

    def __init__(self, radius=0.0):
        self.bounds = [LOW.tolist(), HIGH.tolist()]
        self.radius = radius


def poses_at(places):
    poses = np.tile(np.eye(4), (len(places), 1, 1))
    poses[:, :3, 3] = places
    return poses


def bodies(places, *, half=0.5, radius=0.1, reach=0.0, to=None):
    """Return cubes at places, or in motion to other places."""
    box = np.array([[[-half] * 3, [half] * 3]])
    poses = poses_at(places)
    return BodyPlaces(box, np.array([radius]), reach, poses, poses if to is None else poses_at(to))


def lies(places, radius=0.0):
    """Return whether the only place lies outside."""
    info = Info(radius)
    leaves, verdicts = np.array([True]), np.array([0], np.uint8)
    return bool(lying_outside(places, leaves, verdicts, info)[0])


@pytest.mark.parametrize(
    ("x", "reach", "radius", "outside"),
    [
        (4.59, 0.0, 0.0, False),  # half a metre of body and a tenth of radius
        (4.61, 0.0, 0.0, True),
        (4.61, 0.02, 0.0, False),  # the reach intersects the bounds
        (4.61, 0.0, 0.02, False),  # the spheres of the scan extend beyond its points
        (3.9, 0.0, 0.0, False),  # part of it lies outside
    ],
)
def test_a_body_lies_outside_where_nothing_of_the_scan_is_in_reach(x, reach, radius, outside):
    assert lies(bodies([[x, 0.0, 1.0]], reach=reach), radius) is outside


def test_a_turned_body_is_held_by_its_box():
    turn = np.eye(4)
    angle = np.radians(45)
    turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    for x, outside in ((4.0 + 0.1 + 0.70, False), (4.0 + 0.1 + 0.72, True)):
        turn[:3, 3] = [x, 0.0, 1.0]
        poses = turn[None]
        body = BodyPlaces(np.array([[[-0.5] * 3, [0.5] * 3]]), np.array([0.1]), 0.0, poses, poses)
        assert lies(body) is outside


def test_no_point_of_a_turning_motion_leaves_the_box_that_is_judged(rng):
    """Sample screws of up to half a turn: all points stay in the box of the ends plus the bulge."""
    for _ in range(50):
        angle, radius = rng.uniform(0, np.pi), rng.uniform(0.1, 5)
        axis_at = rng.uniform(-3, 3, 2)

        def pose(turned, radius=radius, axis_at=axis_at):
            found = np.eye(4)
            c, s = np.cos(turned), np.sin(turned)
            found[:2, :2] = [[c, -s], [s, c]]
            found[:2, 3] = axis_at + radius * np.array([c, s])
            return found

        body = bodies([[0, 0, 0]])._replace(pose_from=pose(0)[None], pose_to=pose(angle)[None])
        corners = (body.boxes[0][[[i >> k & 1 for k in range(3)] for i in range(8)], range(3)]).T
        for part in np.linspace(0, angle, 9):
            for place in (pose(part)[:3, :3] @ corners + pose(part)[:3, 3:]).T:
                assert not body.outside(place - 1e-9, place + 1e-9)[0]


@pytest.mark.parametrize(
    ("origin", "direction", "reach", "outside"),
    [
        ([0, 0, 9], [0, 0, -2], 3.9, True),
        ([0, 0, 9], [0, 0, -2], 4.1, False),
        ([0, 0, 9], [0, 0, 1], 99, True),
        ([0, 0, 1], [0, 0, 1], 0, False),
        ([9, 9, 9], [1, 0, 0], 99, True),
        ([9, 1, 9], [-1, -1, -1], 99, True),  # passes the bounds at a distance
        ([7, 6, 8], [-1, -1, -1], 99, False),
    ],
)
def test_a_ray_lies_outside_where_it_does_not_meet_the_bounds(origin, direction, reach, outside):
    rays = RayPlaces(np.array([origin], float), np.array([direction], float), reach)
    assert lies(rays) is outside


def test_a_point_lies_outside_beyond_its_reach():
    assert lies(PointPlaces(np.array([[5.0, 4.0, 6.0]]), 1.73))
    assert not lies(PointPlaces(np.array([[5.0, 4.0, 6.0]]), 1.74))


def line(places):
    info = Info()
    k = len(places.pose_from)
    outside = lying_outside(places, np.ones(k, bool), np.zeros(k, np.uint8), info)
    return outside_line(places, outside, info, "poses")


def test_millimetres_are_found_out():
    walk = np.random.default_rng(3).uniform(LOW, HIGH, (12, 3))
    assert line(bodies(walk * 1000)) == (
        "12 of 12 poses lie outside the scan (its bounds: -1.000 -2.000 0.000 .. 4.000 3.000 5.000 m); "
        "divided by 1000 they would lie inside: expected metres, not millimetres?"
    )


def test_an_avatar_without_points_lies_where_its_origin_is():
    assert box_of(np.empty((0, 3))).tolist() == [[0, 0, 0], [0, 0, 0]]
    assert bodies(np.empty((0, 3))).outside(LOW, HIGH).tolist() == []
