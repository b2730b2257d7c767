"""Test the two ways to call a kernel: from Python, and from another kernel."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from solidcloud.schemas.kernels.compiling import njit
from solidcloud.schemas.kernels.morton import morton_code, morton_encode

pytestmark = pytest.mark.skipif(
    os.environ.get("NUMBA_DISABLE_JIT") == "1", reason="interpreted kernels are plain functions"
)

CODE = """
import json
import numpy as np
from solidcloud.schemas.kernels.morton import morton_code, morton_encode
codes = morton_encode(np.array([[1, 2, 3], [7, 0, 5]], np.uint64))
print(json.dumps({
    "codes": codes.tolist(),
    "outer": sum(morton_encode.stats.cache_misses.values()),
    "inner": [sum(found.values()) for found in morton_code.inner.stats[1:]],
}))
"""


def start(cache: Path) -> dict[str, object]:
    """Return what a process that calls `morton_encode` prints."""
    done = subprocess.run(
        [sys.executable, "-P", "-c", CODE],
        env=os.environ | {"NUMBA_CACHE_DIR": str(cache)},
        capture_output=True,
        text=True,
        check=True,
        timeout=240,
    )
    found: dict[str, object] = json.loads(done.stdout)
    return found


@njit()
def half(value):  # type: ignore[no-untyped-def]
    """Return half of a value; raise ValueError below 0."""
    if value < 0:
        raise ValueError("expected a value of at least 0")
    return value / 2


@njit()
def quarter(value):  # type: ignore[no-untyped-def]
    """Return a quarter of a value."""
    return half(half(value))


def test_a_kernel_has_the_same_result_for_python_and_for_a_kernel() -> None:
    assert half(3.0) == 1.5
    assert quarter(3.0) == 0.75
    x, y, z = np.uint64(1), np.uint64(2), np.uint64(3)
    assert morton_code(x, y, z) == morton_encode(np.array([[x, y, z]]))[0] == 53


def test_a_kernel_raises_what_an_inner_kernel_raises() -> None:
    with pytest.raises(ValueError, match="at least 0"):
        quarter(-1.0)


def test_code_for_other_kernels_is_stored(tmp_path: Path) -> None:
    """Compile one kernel again; what it calls is read from the cache."""
    codes = [53, 333]
    assert start(tmp_path) == {"codes": codes, "outer": 1, "inner": [0, 1]}  # hits, misses
    (stored,) = tmp_path.glob("solidcloud-kernels/*.morton_encode-*")
    stored.unlink()
    assert start(tmp_path) == {"codes": codes, "outer": 1, "inner": [1, 0]}
    assert start(tmp_path) == {"codes": codes, "outer": 0, "inner": [0, 0]}
