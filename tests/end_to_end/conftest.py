"""Fixtures that several files use: the floor of fake_server.py, its server, a client; a façade, a browser."""

import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fake_server import FloorScene, floor_simulation
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.pipeline import build_archive
from solidcloud.builder.synthetic.scenes import make_facade
from solidcloud.server.cli.scene_files.viewed_scene import archive_scene
from solidcloud.server.client import Client
from solidcloud.server.report.walk.server_process import served as served_process
from solidcloud.server.zenoh_server.serve_loop import serving
from solidcloud.server.zenoh_server.server_config import ServerConfig
from viewed_page import browsing


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


@pytest.fixture(scope="session")
def facade_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build a small façade; return its scene file, beside the folder `archive`.

    In its frame the cloister's wall is at x = -9, and the main door between x = -0.8 and 0.8 at
    y = 0 to 1.2.
    """
    folder = tmp_path_factory.mktemp("facade")
    make_facade(folder / "facade.laz", points=60_000)
    build_archive([folder / "facade.laz"], folder / "archive", BuildConfig(voxel=2.0, jobs=1))
    (folder / "viewer.toml").write_text(archive_scene(folder / "archive"))
    return folder / "viewer.toml"


@pytest.fixture(scope="session")
def facade_endpoint(facade_file: Path) -> Iterator[str]:
    """Serve the façade in another process."""
    with served_process(facade_file, None) as endpoint:
        yield endpoint


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    """Run a browser for all tests: a second one cannot start beside it in one thread."""
    with browsing() as browser:
        yield browser
