"""Avatars that walk on the floor of fake_server.py over zenoh, and their expected positions."""

from contextlib import contextmanager

import numpy as np
from floor import DEADLINE, POINTS
from solidcloud.server.client import Client

REST = np.nextafter(-0.375, 1.0)  # height at which POINTS with a radius of 0.125 rest on the floor


def pose_at(x, z, y=0.0):
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return pose


def outcome(pose):
    """Return the expected pose: where the floor stops an avatar."""
    there = pose.copy()
    there[2, 3] = max(pose[2, 3], REST)
    return there


@contextmanager
def walking(endpoint, name="al", **fields):
    """Connect a client with one avatar; yield its session."""
    with Client(endpoint, scene="floor", timeout=DEADLINE) as client:
        client.add_avatar(name, POINTS, 0.125)
        with client.session(name) as session:
            yield session
