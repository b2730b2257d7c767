"""Test `solidcloud plan` from its command line: its output and its errors."""

import json

import pytest
from solidcloud.server.cli.main import run


def test_a_number_of_points_is_planned_for(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["plan", "--points", "1e9", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["points"] == 10**9 and found["scans"] == 714
    assert found["spool_bytes"] == 12 * 10**9
    assert 2e9 < found["archive_bytes"] < 6e9
    assert sum(found["stages"].values()) == pytest.approx(found["seconds"])


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        ([], 2, "expected either scans or --points"),
        (["--points", "many"], 2, "--points 'many': expected a number"),
        (["--points", "0"], 2, "--points '0': expected a number"),
        (["--points", "1e9", "somewhere"], 2, "expected either scans or --points"),
        (["somewhere", "--density", "3"], 2, "--density and --scans need --points"),
        (["--points", "1e9", "--density", "0"], 2, "--density 0.0: expected a positive number"),
        (["--points", "1e9", "--voxel", "-1"], 2, "--voxel -1.0"),
        (["no-such-folder"], 3, "no-such-folder"),
    ],
)
def test_what_cannot_be_planned_is_refused(
    arguments: list[str], code: int, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["plan", *arguments]) == code
    assert said in capsys.readouterr().err
