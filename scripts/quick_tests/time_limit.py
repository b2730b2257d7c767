"""pytest plugin: end the session at a time limit, and record which tests were collected and have ended.

The record is a file of lines that a killed session leaves readable: `collected NODEID`, `OUTCOME NODEID`.
"""

import os
import time
from pathlib import Path

import pytest

END, RECORD = float(os.environ["QUICK_TESTS_END"]), Path(os.environ["QUICK_TESTS_RECORD"])

_sessions: list[pytest.Session] = []


def _write(*lines: str) -> None:
    with RECORD.open("a") as file:
        file.writelines(f"{line}\n" for line in lines)


def pytest_collectreport(report: pytest.CollectReport) -> None:
    """Record a file that cannot be collected."""
    if report.failed:
        _write(f"failed {report.nodeid}")


def pytest_collection_finish(session: pytest.Session) -> None:
    """Record the tests to run."""
    _sessions.append(session)
    _write(*(f"collected {item.nodeid}" for item in session.items))


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Record the end of a test."""
    if report.when == "call" or report.outcome != "passed":
        _write(f"{report.outcome} {report.nodeid}")


def pytest_runtest_logfinish() -> None:
    """Run no further test once the time is up."""
    if time.time() >= END:
        _sessions[0].shouldstop = "time limit"
