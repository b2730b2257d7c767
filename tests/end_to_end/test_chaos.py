"""Test six seconds of scripts/chaos. Limits that depend on the machine's speed are generous."""

import json
import subprocess
import sys
from pathlib import Path

SCRIPTS = Path(__file__).parents[2] / "scripts"


def test_no_answer_is_wrong_whatever_is_done_to_server_and_clients() -> None:
    command = [sys.executable, SCRIPTS / "chaos", "--seconds", "6", "--clients", "6"]
    command += ["--points", "10000", "--requests", "90", "--voxel", "1"]
    # With this seed the first fault kills the server.
    done = subprocess.run(
        [*command, "--seed", "22", "--recovery", "60", "--stop", "30"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode in (0, 1), done.stderr
    found = json.loads(done.stdout)
    assert done.returncode == 0, json.dumps(found, indent=1) + done.stderr
    assert found["violations"] == [] and found["wrong"] == found["clear_away"] == 0
    assert found["right"] > 500 and found["servers"] >= 2 and found["done"]["kill server"] >= 1
