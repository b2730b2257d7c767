"""Test builds stopped at any moment: nothing invalid is visible, and a repeat gives the same archive.

scripts/kill_builds does this in a process without other threads, which may fork. These tests run a
part of its cases.
"""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from kill_cases.stopped_build import NAME, Case, Tally, content, difference
from kill_cases.system_call_stops import Call, has_strace, one_of_each

SCRIPTS = Path(__file__).parents[2] / "scripts"


def kill_builds(folder: Path, *arguments: str) -> dict[str, Any]:
    """Run the script; return its figures."""
    done = subprocess.run(
        [sys.executable, SCRIPTS / "kill_builds", *arguments, "--scratch", folder],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode in (0, 1), done.stderr
    found = json.loads(done.stdout)
    assert found["bad"] == 0 and done.returncode == 0, json.dumps(found, indent=1)
    return found


def test_twenty_builds_killed_at_random_end_as_one_that_was_not(tmp_path: Path) -> None:
    """Kill 20 builds; builder/DESIGN.md records larger runs of the script."""
    found = kill_builds(tmp_path, "--forked", "20", "--rivals", "--voxel", "2")
    assert found["forked"]["counts"]["killed"] == 20
    assert found["forked"]["counts"]["finished after kills"] >= 5
    # The kills were spread over the whole build, not only over its beginning.
    assert len(found["forked"]["stages"]) >= 3
    assert (
        found["rivals"]["counts"]["two builders"]
        == found["rivals"]["counts"]["a builder after a killed one"]
        == 1
    )
    assert found["rivals"]["counts"]["milliseconds until refused"] < 1000


def test_a_build_stopped_at_a_call_of_each_kind_goes_on(tmp_path: Path) -> None:
    if not has_strace():
        pytest.skip("strace is not installed, or may not trace here")
    found = kill_builds(tmp_path, "--syscalls", "--few", "2", "--voxel", "2")["syscalls"]["counts"]
    assert min(found[fault] for fault in ("KILL", "INT", "EIO")) >= 7 and found["ENOSPC"] >= 5
    assert (
        found["finished after an injection"]
        == found["points"]
        == sum(found[fault] for fault in ("KILL", "INT", "EIO", "ENOSPC"))
    )


SABOTAGED = """
import os, sys
from pathlib import Path
sys.path.append(sys.argv[2])
import solidcloud.builder.pipeline as pipeline
from kill_cases.random_kills import ReferenceBuild, _after_kill
from kill_cases.stopped_build import Tally
from kill_cases.forked_command import build

def bit_by_bit(folder, target, *_):
    target.mkdir()
    os.rename(folder / "shards", target / "shards")
    os.kill(os.getpid(), 9)

reference, tally = ReferenceBuild(Path(sys.argv[1])), Tally()
pipeline.publish_folder = bit_by_bit
case = reference.case()
child = build(case.arguments(), case.folder.with_suffix(".log"))
_after_kill(case, child.status, child.said(), tally)
print(len(tally.bad), tally.bad[0]["faults"][0] if tally.bad else child.said())
"""


def test_a_builder_that_publishes_bit_by_bit_is_found_out(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", SABOTAGED, tmp_path, SCRIPTS],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    count, _, said = done.stdout.strip().partition(" ")
    assert count == "1" and "neither the new archive nor the old: missing index.h5" in said


@pytest.fixture
def case(tmp_path: Path) -> Case:
    """Return a small build: its target, and the archive that it must become."""
    for name, text in (("new", "new"), ("old", "old")):
        (tmp_path / name / "shards").mkdir(parents=True)
        (tmp_path / name / "index.h5").write_text(text)
        (tmp_path / name / "shards" / "0-000000.h5").write_text("points")
    return Case(tmp_path / "case", tmp_path, content(tmp_path / "new"))


def put(case: Case, name: str, text: str) -> None:
    path = case.target / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def test_part_of_an_archive_is_a_fault(case: Case) -> None:
    assert case.visible() == [] and not case.whole()
    put(case, "shards/0-000000.h5", "points")
    assert "neither the new archive nor the old: missing index.h5" in case.visible()[0]
    put(case, "index.h5", "new")
    assert case.visible() == [] and case.whole()
    put(case, "shards/0-000000.h5.tmp", "")
    assert "extra shards/0-000000.h5.tmp" in case.visible()[0] and not case.whole()
    (case.target / "shards/0-000000.h5.tmp").unlink()
    put(case, "index.h5", "old")
    assert "other index.h5" in case.visible()[0]


def test_an_old_archive_may_stand_there_or_aside_and_nowhere_else(case: Case, tmp_path: Path) -> None:
    case.put_old(tmp_path / "old")
    assert case.visible() == [] and "--overwrite" in case.arguments()
    case.target.rename(case.folder / f".{NAME}.old")
    assert case.visible() == [] and case.stage() == "between two renames"
    (case.folder / f".{NAME}.old" / "index.h5").unlink()
    assert "the old archive is gone" in case.visible()[0]


def test_what_is_left_behind_is_a_fault(case: Case) -> None:
    put(case, "index.h5", "new")
    put(case, "shards/0-000000.h5", "points")
    (case.folder / f".{NAME}.lock").touch()
    assert any(f"left behind: .{NAME}.lock" in fault for fault in case.finished())


def test_faults_are_kept_with_how_to_do_them_again() -> None:
    tally = Tally()
    tally.add("killed", [], seed=1)
    tally.add("killed", ["gone"], seed=1, kills=["call 3"])
    assert tally.summary() == {
        "counts": {"killed": 2},
        "stages": {},
        "bad": [{"what": "killed", "seed": 1, "kills": ["call 3"], "faults": ["gone"]}],
    }
    assert difference({"a": "1"}, {"a": "1"}) == "the same"


def test_few_calls_are_one_of_each_name() -> None:
    calls = [Call(name, number, "") for name in ("write", "fsync") for number in (1, 2, 3)]
    assert one_of_each(calls) == [calls[1], calls[4]]
