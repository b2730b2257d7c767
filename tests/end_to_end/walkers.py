"""Avatars that walk the made floor of fake_server.py over zenoh, and where it lets them get to."""

from contextlib import contextmanager

import numpy as np
from floor import DEADLINE, POINTS
from solidcloud.server.client import Client

REST = np.nextafter(-0.375, 1.0)  # where POINTS with a radius of 0.125 come to rest on the floor


def pose_at(x, z, y=0.0):
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return pose


def outcome(pose):
    """The judge: where the floor lets an avatar get to."""
    there = pose.copy()
    there[2, 3] = max(pose[2, 3], REST)
    return there


@contextmanager
def walking(endpoint, name="al", **fields):
    """A client with one avatar, and its session."""
    with Client(endpoint, scene="floor", timeout=DEADLINE) as client:
        client.add_avatar(name, POINTS, 0.125)
        with client.session(name) as session:
            yield session
