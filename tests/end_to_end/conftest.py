"""Fixtures for tests without a scene of their own: the floor of fake_server.py, its server, a client."""

import socket

import pytest
from fake_server import FloorScene, floor_simulation
from solidcloud.server.client import Client
from solidcloud.server.zenoh_server.serve_loop import serving
from solidcloud.server.zenoh_server.server_config import ServerConfig


def _free_endpoint():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    return f"tcp/127.0.0.1:{port}"


@pytest.fixture(scope="session")
def free_endpoint():
    """Return a function that makes endpoints on free loopback ports."""
    return _free_endpoint


@pytest.fixture
def endpoint():
    return _free_endpoint()


@pytest.fixture
def scene():
    return FloorScene()


@pytest.fixture
def client(scene, endpoint):
    with serving([scene], ServerConfig(listen=endpoint)), Client(endpoint, scene="floor") as client:
        yield client


@pytest.fixture
def floor():
    return floor_simulation()


@pytest.fixture
def served(floor, endpoint):
    with serving([floor.scene], ServerConfig(listen=endpoint)):
        yield floor
