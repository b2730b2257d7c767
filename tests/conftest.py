"""What every test may ask for. Tests see the solidcloud that is installed, never the checkout's folders."""

import atexit
import json
import os
import shutil
import signal
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

SEED = 2012
# What scripts/ consist of is tested too. Appended, so that nothing there hides a module of the tests.
sys.path.append(str(Path(__file__).parents[1] / "scripts"))

# Under nohup SIGINT is ignored, which processes that tests start, and interrupt, would inherit.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Before anything imports numba: compiled kernels are kept in a new folder, for this process and for those it starts, so
# that every run compiles all of them. Set NUMBA_CACHE_DIR to keep them: what an edit changes is compiled anew.
_OWN_CACHE = "NUMBA_CACHE_DIR" not in os.environ
if _OWN_CACHE:
    os.environ["NUMBA_CACHE_DIR"] = tempfile.mkdtemp(prefix="solidcloud-numba-")

# Servers leave the keys of their replies there, and clients look for them there; not among the user's own.
os.environ["XDG_RUNTIME_DIR"] = _RUNTIME = tempfile.mkdtemp(prefix="solidcloud-run-")
atexit.register(shutil.rmtree, _RUNTIME, ignore_errors=True)


def pytest_addoption(parser: pytest.Parser) -> None:
    """Where to write what became of the hard cases."""
    parser.addoption(
        "--cases", metavar="FILE", help="write the tests marked `case` and their outcomes as JSON"
    )


def pytest_configure(config: pytest.Config) -> None:
    """Watch the hard cases where asked to."""
    if path := config.getoption("--cases"):
        config.pluginmanager.register(CaseReport(Path(path)))


class CaseReport:
    """Every test marked `case`, run or not, and what became of it: a JSON object by test function.

    number, text: the marker's.  marks: names of its other markers.  outcomes: of its runs, one a
    parameter set; none where it was not run.  skipped: why it was.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.cases: dict[str, dict[str, Any]] = {}

    @pytest.hookimpl(tryfirst=True)  # before -m leaves any out
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Note every case that exists."""
        for item in items:
            if mark := item.get_closest_marker("case"):
                number, text = mark.args
                self.cases.setdefault(
                    item.nodeid.partition("[")[0],
                    {
                        "number": number,
                        "text": text,
                        "marks": sorted({m.name for m in item.iter_markers()} - {"case", "parametrize"}),
                        "outcomes": [],
                        "skipped": "",
                    },
                )

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Note how a run ended: its call, or what kept it from one."""
        case = self.cases.get(report.nodeid.partition("[")[0])
        if case is None or (report.when != "call" and report.passed):
            return
        case["outcomes"].append(report.outcome)
        if report.skipped and isinstance(report.longrepr, tuple):
            case["skipped"] = report.longrepr[2].removeprefix("Skipped: ")

    def pytest_sessionfinish(self) -> None:
        """Write it all."""
        self.path.write_text(json.dumps(self.cases, indent=1))


def pytest_unconfigure() -> None:
    """Remove the cache of this run."""
    if _OWN_CACHE:
        shutil.rmtree(os.environ.pop("NUMBA_CACHE_DIR", ""), ignore_errors=True)


def pytest_report_header() -> list[str]:
    """What decides the outcome beside the code."""
    kernels = "interpreted" if os.environ.get("NUMBA_DISABLE_JIT") == "1" else "compiled"
    many = os.environ.get("SOLIDCLOUD_SAMPLES") == "many"
    bounds = ", indices checked" if os.environ.get("NUMBA_BOUNDSCHECK") == "1" else ""
    scans = os.environ.get("SOLIDCLOUD_SCANS", "none: tests of them are skipped")
    samples = (
        f"samples (SOLIDCLOUD_SAMPLES): {'many' if many else 'few; many are those that documents state'}"
    )
    return [f"kernels: {kernels}{bounds}", samples, f"real scans (SOLIDCLOUD_SCANS): {scans}"]


@pytest.fixture
def rng() -> np.random.Generator:
    """Random numbers, the same in every run."""
    return np.random.default_rng(SEED)


@pytest.fixture
def builds_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Build archives in this process, interpreted where it is: for tests of the builder.

    See tests/support/compiled_builds.py.
    """
    monkeypatch.setattr("compiled_builds.here", True)


@pytest.fixture(scope="session")
def real_scans() -> Path:
    """The folder of real scans; skips where SOLIDCLOUD_SCANS names none."""
    folder = os.environ.get("SOLIDCLOUD_SCANS")
    if not folder:
        pytest.skip("SOLIDCLOUD_SCANS names no folder of real scans")
    return Path(folder)
