"""Test `solidcloud loadtest` with a real server, users of their own processes, and a real page."""

import json
from pathlib import Path

import numpy as np
import pytest
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.pipeline import build_archive
from solidcloud.server.cli.main import run


@pytest.mark.slow
def test_a_load_test_of_any_archive(tmp_path: Path) -> None:
    x, y = np.meshgrid(np.arange(0, 16, 0.1), np.arange(0, 8, 0.1))
    np.savetxt(tmp_path / "hall.xyz", np.column_stack([x.ravel(), y.ravel(), 0 * x.ravel()]), fmt="%.3f")
    build_archive([tmp_path / "hall.xyz"], tmp_path / "hall", BuildConfig(jobs=1, voxel=4.0))
    options = ["--users", "2", "--seconds", "2", "--policies", "lru", "--kinds", "stroll,adversary"]
    code = run(["loadtest", str(tmp_path / "hall"), "-o", str(tmp_path / "out"), "--only", "kinds", *options])
    found = json.loads((tmp_path / "out" / "load.json").read_text())
    assert code == 0, found["sections"]
    assert [ran["kind"] for ran in found["runs"]] == ["stroll", "adversary"]
    assert all(ran["figures"]["unanswered"] == 0 and ran["wrong"] == 0 for ran in found["runs"])
    page = (tmp_path / "out" / "load.html").read_text()
    assert "Bytes over time" in page and "refresh" not in page
