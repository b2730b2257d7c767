"""The scans of interrupted builds."""

import os
from pathlib import Path

import pytest
from interrupted_builds import two_scans


@pytest.fixture
def scans(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Two scans, one of which is read in three ranges; two shards are made of them."""
    monkeypatch.setattr(os, "fsync", lambda _: None)  # the power stays on in these tests
    return two_scans(tmp_path, monkeypatch)
