"""Test the office: equal seeds make equal files, and its strays are where the truth says."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from solidcloud.builder.sources.scan_files import open_scans
from solidcloud.builder.synthetic import office
from solidcloud.builder.synthetic.office import CLEARANCE, DUST, make_office, solid_distances
from solidcloud.builder.synthetic.truth import read_office_truth


@pytest.fixture(autouse=True)
def few_points(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(office, "POINTS", 4000)


def points_of(*paths: Path) -> list[NDArray[np.float64]]:
    """Return the points of each scan of some files."""
    scans = [scan for path in paths for scan in open_scans(path)]
    return [np.concatenate([block.xyz for block in scan.blocks()]) for scan in scans]


def test_same_seed_same_bytes_and_another_seed_others(tmp_path: Path) -> None:
    one, two = (make_office(tmp_path / name) for name in ("a", "b"))
    other = make_office(tmp_path / "c", seed=6)
    assert [path.name for path in one.paths] == ["station_0001.laz", "station_0002.laz"]
    for first, second, third in zip(one.paths, two.paths, other.paths, strict=True):
        assert first.read_bytes() == second.read_bytes() != third.read_bytes()
    assert one.truth.read_bytes() == two.truth.read_bytes()


def test_strays_are_the_last_points_and_clear_of_solids(tmp_path: Path) -> None:
    made = make_office(tmp_path / "office")
    truth = read_office_truth(made.truth)
    scans = points_of(*made.paths)
    assert made.points == truth.points == sum(map(len, scans))
    assert [station.points for station in truth.stations] == [len(xyz) for xyz in scans]
    strays = [(each, scans[each.station - 1][each.first : each.first + each.count]) for each in truth.strays]
    assert sum(each.count for each in truth.strays) == truth.points - 4000
    assert sum(len(xyz) for each, xyz in strays if each.kind == "dust") == DUST
    for each, xyz in strays:
        assert len(xyz) == each.count and solid_distances(xyz).min() > CLEARANCE - 1e-3
        assert each.first + each.count <= len(scans[each.station - 1])
    (person,) = [xyz for each, xyz in strays if each.kind == "person"]
    # It leaves no way for a body 0.4 m wide.
    assert truth.door.width == 1.0 and np.ptp(person[:, 0]) > 0.45 and len(person) > 300
    assert max(truth.door.x_right - person[:, 0].max(), person[:, 0].min() - truth.door.x_left) < 0.3
