"""The archive of six scans, as built and as a copy."""

import shutil
from pathlib import Path

import pytest
from six_scans import build_six


@pytest.fixture(scope="session")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An archive of six scans (six_scans.py). Not to be changed."""
    return build_six(tmp_path_factory.mktemp("built"))


@pytest.fixture
def copy(built: Path, tmp_path: Path) -> Path:
    """A copy of `built` to be broken."""
    return Path(shutil.copytree(built, tmp_path / "archive"))
