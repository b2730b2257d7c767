"""Hard case of another family of processors; a test's number is its row in NUMERICS.md."""

import json
import os
import subprocess
import sys
from pathlib import Path

import archive_cases
import mixed_requests
import pytest
import synthetic_scans

INTERPRETED = os.environ.get("NUMBA_DISABLE_JIT") == "1"
# All queries take twice as long to compile: tests/determinism/test_replies.py asks them.
ASKED = ("collide", "raycast", "sweep")


@pytest.mark.case(
    40,
    "collide, rays and sweeps compiled for a generic processor without extensions: the same reply bytes",
    compiled_only="it compiles twice",
)
@pytest.mark.skipif(INTERPRETED, reason="it compiles twice")
@pytest.mark.timeout(600)
def test_case_40_a_generic_processor_gives_the_same_bytes(tmp_path: Path) -> None:
    """Without its extensions a processor has narrower vectors, and no instruction that adds a product."""
    points = synthetic_scans.make_scan(*mixed_requests.SCAN)
    case = archive_cases.build(
        tmp_path, points, voxel=0.3, leaf=8, cell_points=20, models=frozenset({"mean", "local", "border"})
    )
    here = mixed_requests.checksums(case.archive, mixed_requests.requests(700, *ASKED), 1, 1 << 26)
    kernels = tmp_path / "kernels"
    path = os.pathsep.join([str(Path(mixed_requests.__file__).parent), os.environ.get("PYTHONPATH", "")])
    settings = {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": "", "NUMBA_CACHE_DIR": str(kernels)}
    done = subprocess.run(
        [sys.executable, "-W", "ignore", mixed_requests.__file__, str(case.archive), "700", *ASKED],
        env=os.environ | {"PYTHONPATH": path} | settings,
        capture_output=True, text=True, check=True, timeout=500,
    )  # fmt: skip
    assert any(each.is_file() for each in kernels.rglob("*")), "compiled by that process"
    assert len(here) > 250 and len(set(here)) > len(here) * 0.8
    assert json.loads(done.stdout) == here
