"""Test builds stopped at any moment: nothing invalid is visible, and a repeat gives the same archive.

scripts/kill_builds does this in a process without other threads, which may fork. These tests run a
small part of its cases.
"""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from kill_cases.system_call_stops import has_strace

SCRIPTS = Path(__file__).parents[2] / "scripts"


def kill_builds(folder: Path, *arguments: str) -> dict[str, Any]:
    """Run the script; return its figures."""
    done = subprocess.run(
        [sys.executable, SCRIPTS / "kill_builds", *arguments, "--voxel", "2", "--scratch", folder],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode in (0, 1), done.stderr
    found = json.loads(done.stdout)
    assert found["bad"] == 0 and done.returncode == 0, json.dumps(found, indent=1)
    return found


def test_builds_killed_at_random_end_as_one_that_was_not(tmp_path: Path) -> None:
    counts = kill_builds(tmp_path, "--forked", "3")["forked"]["counts"]
    assert counts["killed"] == 3 and counts["finished after kills"] >= 1


def test_a_build_stopped_at_file_operations_goes_on(tmp_path: Path) -> None:
    """Stop at one call of each name, by one of the faults."""
    if not has_strace():
        pytest.skip("strace is not installed, or may not trace here")
    counts = kill_builds(tmp_path, "--syscalls", "--few", "8")["syscalls"]["counts"]
    assert counts["KILL"] >= 1 and counts["EIO"] >= 1
    assert counts["finished after an injection"] == counts["points"] >= 5
