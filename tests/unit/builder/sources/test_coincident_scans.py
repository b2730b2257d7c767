"""Test the warning about a scan whose points all lie at one position."""

import json
from pathlib import Path

import numpy as np
import pye57
import pytest
from solidcloud.builder.sources.coincident_scans import coincident_scan
from solidcloud.builder.sources.scan_files import open_scans
from solidcloud.server.cli.main import run

WARNING = "all 300 points of scan 0 lie at one place, expected a surface"
LINE = "".join(f"{i * 0.1:.1f} 0 0\n" for i in range(40))


def zeros_e57(path: Path) -> Path:
    """What some exporters write: a range of 0, not marked as invalid, for every direction."""
    file = pye57.E57(str(path), mode="w")
    none = np.zeros(300)
    file.write_scan_raw({"cartesianX": none, "cartesianY": none, "cartesianZ": none})
    file.close()
    return path


def zeros_ply(path: Path) -> Path:
    """The same without bounds in a header."""
    columns = "".join(f"property float {axis}\n" for axis in "xyz")
    path.write_text(f"ply\nformat ascii 1.0\nelement vertex 300\n{columns}end_header\n" + "0 0 0\n" * 300)
    return path


@pytest.fixture(params=[zeros_e57, zeros_ply])
def zeros(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    return request.param(tmp_path / f"zeros.{request.param.__name__[-3:]}")


def test_alone_it_is_an_error_about_the_scan(
    zeros: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["build", str(zeros), "-o", str(tmp_path / "hall"), "--jobs", "1"]) == 3
    shown = capsys.readouterr().err
    assert f"error: {zeros}: {WARNING}" in shown and "--radius" not in shown
    assert not (tmp_path / "hall").exists()


def test_build_info_inspect_and_add_name_it(
    zeros: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "line.xyz").write_text(LINE)
    hall, later = tmp_path / "hall", tmp_path / "later"
    line = f"{zeros}: {WARNING}"
    assert run(["build", str(zeros), str(tmp_path / "line.xyz"), "-o", str(hall), "--jobs", "1"]) == 0
    assert f"warning: {line}" in capsys.readouterr().err
    assert run(["info", str(hall), "--json"]) == 0
    (warning,) = json.loads(capsys.readouterr().out)["warnings"]
    assert warning.startswith(line)
    assert run(["info", str(hall)]) == 0
    assert "300 points of scan 0 lie" in " ".join(capsys.readouterr().out.split())
    assert run(["inspect", str(tmp_path), "-o", str(tmp_path / "scans.toml")]) == 0
    assert f"warning: {line}" in capsys.readouterr().err
    assert run(["build", str(tmp_path / "line.xyz"), "-o", str(later), "--jobs", "1"]) == 0
    assert "warning" not in capsys.readouterr().err
    assert run(["add", str(later), str(zeros), "--jobs", "1"]) == 0
    assert f"warning: {line}" in capsys.readouterr().err


def test_a_single_point_and_a_surface_are_no_fault(tmp_path: Path) -> None:
    for name, text in (("one.xyz", "1 2 3\n"), ("line.xyz", LINE)):
        (tmp_path / name).write_text(text)
        (scan,) = open_scans(tmp_path / name)
        assert coincident_scan(scan) == ""
