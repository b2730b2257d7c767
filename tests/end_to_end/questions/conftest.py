"""Fixtures: the scene of corner.py, opened and served once for all tests of a file."""

import pytest
from corner import client_of, opened, served


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    with opened(tmp_path_factory.mktemp("corner")) as scene:
        yield scene


@pytest.fixture(scope="module")
def endpoint(scene):
    with served(scene) as endpoint:
        yield endpoint


@pytest.fixture
def client(endpoint):
    with client_of(endpoint) as client:
        yield client
