"""Compare the stray points of scans with brute force, by scan, at their poses, in their units and axes."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import synthetic_scans
from numpy.typing import NDArray
from solidcloud.builder.plan import stray_points as rule
from solidcloud.builder.plan.stray_points import EDGE, find_stray_points
from solidcloud.builder.sources.scan_files import inspect_scans
from solidcloud.builder.sources.scan_list import ScanEntry, read_scan_list, write_scan_list

Points = NDArray[np.float64]


def judge(scans: list[Points], few: int) -> list[set[int]]:
    """Return the hanging points of each scan, by the definition: every pair of points."""
    xyz = np.concatenate(scans)
    cubes = np.floor(xyz / EDGE).astype(int)
    apart = np.abs(cubes[:, None] - cubes[None])
    touch = (apart <= 1).all(axis=2)
    group = np.arange(len(xyz))
    while True:
        least = np.where(touch, group[None], len(xyz)).min(axis=1)
        if (least == group).all():
            break
        group = least
    sizes = np.bincount(group, minlength=len(xyz))
    small = sizes[group] < few
    lowest = np.array([cubes[group == group[k], 2].min() for k in range(len(xyz))])
    down = cubes[:, None, 2] - cubes[None, :, 2]
    above = (apart[:, :, :2] <= 1).all(axis=2) & (down > 0) & (down <= round(rule.DEPTH / EDGE))
    own = small & (cubes[:, 2] == lowest) & (above & ~small[None]).any(axis=1)
    hangs = small & np.isin(group, group[own])
    ends = np.cumsum([0, *map(len, scans)])
    return [set(np.flatnonzero(hangs[a:b]).tolist()) for a, b in pairwise(ends)]


def entries_of(folder: Path, *scans: Points) -> list[ScanEntry]:
    """Write scans as files; return their entries."""
    folder.mkdir(exist_ok=True)
    paths = [synthetic_scans.write_ply(folder / f"{k}.ply", xyz) for k, xyz in enumerate(scans)]
    return inspect_scans(paths)


def counts(entries: list[ScanEntry]) -> list[int]:
    return [scan.points if scan else -1 for scan in find_stray_points(entries).scans]


def floor(side: float = 1.0, apart: float = 0.04) -> Points:
    """Return a level floor at z = 0, from the origin; with the default there are 676 points."""
    along = np.arange(0.0, side + apart / 2, apart)
    return np.stack(np.meshgrid(along, along, [0.02]), axis=-1).reshape(-1, 3)


@pytest.mark.parametrize("number", range(3))
def test_hanging_points_are_those_of_brute_force(
    number: int, tmp_path: Path, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    few = int(rng.integers(3, 40))
    monkeypatch.setattr(rule, "FEW", few)
    size = np.array([2.0, 2.0, rng.uniform(0.5, 4.0)])
    scans = [
        rng.uniform(0.0, size, (int(rng.integers(1, 150)), 3)) - size / 2 for _ in range(rng.integers(1, 4))
    ]
    # Some are dense, so that there are floors.
    scans[0][::2] *= [1.0, 1.0, 0.02]
    # As the file stores them.
    scans = [np.round(xyz, 4) for xyz in scans]
    found = find_stray_points(entries_of(tmp_path / "scans", *scans))
    expected = judge(scans, few)
    assert [scan.points for scan in found.scans if scan] == [len(of) for of in expected]
    assert [scan.read for scan in found.scans if scan] == [len(xyz) for xyz in scans]
    assert (found.advice is not None) == any(expected)
    if found.advice:
        assert found.advice.points == sum(map(len, expected))


def test_scans_are_read_as_a_build_places_them(tmp_path: Path) -> None:
    """The file is in centimetres, y up, and lies elsewhere."""
    placed = np.concatenate([floor(), [[0.5, 0.5, 1.0], [0.51, 0.51, 1.01]]])
    written = placed[:, [0, 2, 1]] * [100.0, 100.0, -100.0] - [300.0, 0.0, 0.0]
    (entry,) = entries_of(tmp_path / "a", written)
    assert counts([entry]) == [0]
    pose = np.eye(4)
    pose[0, 3] = 3.0
    edited = replace(entry, units="cm", up="y", pose=pose)
    (scan,) = find_stray_points([edited]).scans
    assert scan and scan.points == 2 and scan.place == pytest.approx((0.5, 0.5, 1.0), abs=EDGE / 2 + 1e-3)
    assert counts([replace(edited, units="mm", scale=10.0)]) == [2]
    # The same from a list that was edited, which inspect reads.
    write_scan_list(tmp_path / "scans.toml", [edited])
    (listed,) = inspect_scans([tmp_path / "scans.toml"])
    assert (listed.units, listed.up, listed.count) == ("cm", "y", 678)
    assert np.array_equal(listed.pose, pose) and counts([listed]) == [2]
    assert read_scan_list(tmp_path / "scans.toml")[0].pose is not None
