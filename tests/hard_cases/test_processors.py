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


@pytest.mark.case(
    40, "10,000 mixed requests compiled for a generic processor without any extension: the same reply bytes"
)
@pytest.mark.slow
@pytest.mark.timeout(1000)
def test_case_40_a_generic_processor_gives_the_same_bytes(tmp_path: Path) -> None:
    """Compile everything once more, which takes a minute or two.

    Without its extensions a processor has narrower vectors, and no instruction that adds a product.
    """
    points = synthetic_scans.make_scan(*mixed_requests.SCAN)
    case = archive_cases.build(
        tmp_path, points, voxel=0.3, leaf=8, cell_points=20, models=frozenset({"mean", "local", "border"})
    )
    here = mixed_requests.checksums(case.archive, mixed_requests.requests(10_000), 1, 1 << 26)
    path = os.pathsep.join([str(Path(mixed_requests.__file__).parent), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, "-W", "ignore", mixed_requests.__file__, str(case.archive), "10000"],
        env=os.environ | {"PYTHONPATH": path, "NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""},
        capture_output=True, text=True, check=True, timeout=900,
    )  # fmt: skip
    assert json.loads(done.stdout) == here
