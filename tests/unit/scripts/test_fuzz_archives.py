"""Test scripts/fuzz_archives with some hundred forged archives, and that it finds a fault."""

import json
import subprocess
import sys
from pathlib import Path

SCRIPT = Path(__file__).parents[3] / "scripts" / "fuzz_archives"


def test_flipped_archives_are_refused_or_answered_right() -> None:
    """Test a share of the cases of `scripts/fuzz_archives --flips`."""
    command = [sys.executable, str(SCRIPT), "--flips", "--cases", "80", "--seed", "3", "--jobs", "1"]
    done = subprocess.run([*command, "--seconds", "10"], capture_output=True, text=True, check=False)
    assert done.stdout, done.stderr
    found = json.loads(done.stdout)
    assert found["faults"] == [] and done.returncode == 0
    assert found["outcomes"]["refused"] > 15 and found["outcomes"]["right"] > 15
    assert found["with_unknown"] > 7 and set(found["by_field"]) == {"index", "shard"}


def test_forged_archives_are_refused_or_answered_right() -> None:
    """Test a share of the 100,000 cases of scripts/fuzz_archives."""
    command = [sys.executable, str(SCRIPT), "--cases", "90", "--seed", "3", "--jobs", "1", "--seconds", "10"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.stdout, done.stderr
    found = json.loads(done.stdout)
    assert found["faults"] == [] and done.returncode == 0
    # The damage is neither always found by the first check nor too slight to be noticed.
    assert found["outcomes"]["refused"] > 30 and found["outcomes"]["found"] > 10
    assert found["outcomes"]["right"] > 10 and found["with_unknown"] > 5
    assert len(found["by_field"]) > 25
