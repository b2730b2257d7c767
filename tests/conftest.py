"""What every test may ask for. Tests see the solidcloud that is installed, never the checkout's folders."""

import os
import shutil
import tempfile
from pathlib import Path

import numpy as np
import pytest

SEED = 2012

# Before anything imports numba: its cache does not notice an edit in another file, nor a changed imported
# constant, so it starts empty, for this process and for those it starts. Set it to keep one.
_OWN_CACHE = "NUMBA_CACHE_DIR" not in os.environ
if _OWN_CACHE:
    os.environ["NUMBA_CACHE_DIR"] = tempfile.mkdtemp(prefix="solidcloud-numba-")


def pytest_unconfigure() -> None:
    """Remove the cache of this run."""
    if _OWN_CACHE:
        shutil.rmtree(os.environ.pop("NUMBA_CACHE_DIR", ""), ignore_errors=True)


def pytest_report_header() -> list[str]:
    """What decides the outcome beside the code."""
    kernels = "interpreted" if os.environ.get("NUMBA_DISABLE_JIT") == "1" else "compiled"
    bounds = ", indices checked" if os.environ.get("NUMBA_BOUNDSCHECK") == "1" else ""
    scans = os.environ.get("SOLIDCLOUD_SCANS", "none: tests of them are skipped")
    return [f"kernels: {kernels}{bounds}", f"real scans (SOLIDCLOUD_SCANS): {scans}"]


@pytest.fixture
def rng() -> np.random.Generator:
    """Random numbers, the same in every run."""
    return np.random.default_rng(SEED)


@pytest.fixture(scope="session")
def real_scans() -> Path:
    """The folder of real scans; skips where SOLIDCLOUD_SCANS names none."""
    folder = os.environ.get("SOLIDCLOUD_SCANS")
    if not folder:
        pytest.skip("SOLIDCLOUD_SCANS names no folder of real scans")
    return Path(folder)
