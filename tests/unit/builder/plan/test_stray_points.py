"""Compare the stray points of scans with brute force, by scan, at their poses, in their units and axes."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import synthetic_scans
from numpy.typing import NDArray
from solidcloud.builder.plan import stray_points as rule
from solidcloud.builder.plan.stray_points import EDGE, HangingPoints, find_stray_points
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


@pytest.mark.parametrize("number", range(12))
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


def test_a_scan_says_how_many_groups_and_where_the_largest_is(tmp_path: Path) -> None:
    stray = np.array([[0.52, 0.52, 1.02], [0.53, 0.53, 1.03], [0.54, 0.54, 1.04], [0.22, 0.82, 0.52]])
    found = find_stray_points(entries_of(tmp_path, floor(), np.concatenate([stray, floor()[:100]])))
    assert found.scans[0] == HangingPoints(676, 0, 0, 0, None)
    scan = found.scans[1]
    assert scan and scan == HangingPoints(104, 4, 2, 3, scan.place)
    assert scan.place == pytest.approx((0.53, 0.53, 1.03), abs=EDGE / 2)
    assert scan.share == 4 / 104


def test_another_scan_may_give_the_floor_or_the_surface(tmp_path: Path) -> None:
    dust = np.array([[0.5, 0.5, 1.0]])
    wall = np.stack(np.meshgrid([0.55], np.arange(0.0, 1.0, 0.03), np.arange(0.0, 1.5, 0.03)), axis=-1)
    assert counts(entries_of(tmp_path / "a", dust)) == [0]
    assert counts(entries_of(tmp_path / "b", dust, floor())) == [1, 0]
    assert counts(entries_of(tmp_path / "c", dust, floor(), wall.reshape(-1, 3))) == [0, 0, 0]


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


def test_far_scans_are_counted_too(tmp_path: Path) -> None:
    """Map coordinates, with a point at the origin first."""
    placed = np.concatenate([floor(), [[0.5, 0.5, 1.0]]]) + np.array([500_000.0, 4_000_000.0, 100.0])
    assert counts(entries_of(tmp_path, np.concatenate([np.zeros((1, 3)), placed]))) == [1]


def test_scans_that_are_broken_or_not_used_are_left_out(tmp_path: Path) -> None:
    scan = np.concatenate([floor(), [[0.5, 0.5, 1.0]]])
    entries = entries_of(tmp_path, scan, scan + np.array([5.0, 0.0, 0.0]), scan + np.array([9.0, 0.0, 0.0]))
    entries[1] = replace(entries[1], use=False)
    path = entries[2].path
    path.write_bytes(path.read_bytes()[:-7])
    entries[2] = inspect_scans([path])[0]
    assert counts(entries) == [1, -1, -1]
    # One that breaks behind its header.
    text = tmp_path / "late.xyz"
    text.write_text("0 0 0\n" * 10 + "1 2\n")
    late = inspect_scans([text])
    found = find_stray_points([entries[0], *late])
    assert late[0].fault or (found.scans[1] is None and "late.xyz" in found.faults[1])


def test_scans_without_points_are_no_error(tmp_path: Path) -> None:
    entries = entries_of(tmp_path, np.empty((0, 3)), np.full((3, 3), np.nan), floor())
    found = find_stray_points([entry for entry in entries if not entry.fault])
    assert found.advice is None and not found.faults
    assert find_stray_points([]) == ([], {}, None)


def test_outliers_leave_out_what_is_said_and_moving_is_proposed_where_scans_overlap(tmp_path: Path) -> None:
    dust = np.array([[0.2, 0.2, 1.0], [0.8, 0.8, 1.4], [0.8, 0.81, 1.4]])
    found = find_stray_points(entries_of(tmp_path / "a", np.concatenate([floor(), dust])))
    assert found.advice == (3, (EDGE, 2), 3, 0, None)
    far = floor() + np.array([50.0, 0.0, 0.0])
    found = find_stray_points(entries_of(tmp_path / "b", np.concatenate([floor(), dust]), far))
    assert found.advice and found.advice.moving is None
    found = find_stray_points(entries_of(tmp_path / "c", np.concatenate([floor(), dust]), floor() + 0.001))
    assert found.advice and found.advice.moving == rule.MOVING


def test_the_count_is_proposed_that_leaves_out_most_and_costs_least(
    tmp_path: Path, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    parts = floor(1.5, 0.05), rng.uniform(0.0, 1.5, (60, 3)), rng.uniform(0.5, 0.8, (40, 3))
    scan = np.round(np.concatenate(parts), 4)
    entries = entries_of(tmp_path, scan)
    (hanging,) = judge([scan], rule.FEW)
    cubes = np.floor(scan / EDGE).astype(int)
    near = np.array([(np.abs(cubes - cube) <= 1).all(axis=1).sum() for cube in cubes])
    mine = np.isin(np.arange(len(scan)), list(hanging))
    edge = {tuple(cube) for cube in cubes[:961].tolist()}
    while True:  # the group of the floor
        more = {tuple(c) for c in cubes.tolist() if any(max(abs(np.subtract(c, e))) <= 1 for e in edge)}
        if more == edge:
            break
        edge = more
    surface = np.array([tuple(cube) in edge for cube in cubes.tolist()])
    sums = {}
    for count in set(near[mine].tolist()):
        left, lost = (near[mine] <= count).sum(), (rule.DISC_SHARE * near[surface] < count).sum()
        sums[count] = left, lost, left / mine.sum() - rule.LOSS_WEIGHT * lost / surface.sum()
    for most in (1.0, 0.01, 0.001):
        monkeypatch.setattr(rule, "MOST_LOST", most)
        advice = find_stray_points(entries).advice
        assert advice and advice.outliers and advice.points == mine.sum()
        left, lost, benefit = sums[advice.outliers[1]]
        assert (advice.left_out, advice.lost) == (left, lost) and lost <= most * surface.sum()
        assert benefit == max(each[2] for each in sums.values() if each[1] <= most * surface.sum())


def test_outliers_are_not_proposed_where_surfaces_are_as_thin(tmp_path: Path) -> None:
    heap = np.random.default_rng(2).uniform(0.41, 0.49, (60, 3)) + np.array([0.0, 0.0, 0.5])
    found = find_stray_points(entries_of(tmp_path, np.concatenate([floor(3.0, 0.09), heap])))
    assert found.advice == (60, None, 0, 0, None)


def test_memory_is_that_of_cubes() -> None:
    table = rule.CubeTable()
    for _ in range(50):
        table.count(np.random.default_rng(1).uniform(0.0, 0.5, (20_000, 3)))
    assert table.known == 125 and len(table.counts) == 1 << 10 and table.counts.sum() == 1_000_000


def test_progress_is_that_of_points(tmp_path: Path) -> None:
    told: list[object] = []

    class Told:
        """Progress that notes its reports."""

        def start(self, stage: str, total: int, unit: str, costs: object = None) -> None:
            told.append((stage, total, unit))

        def advance(self, amount: int) -> None:
            told.append(amount)

        def finish(self) -> None:
            told.append("end")

    find_stray_points(entries_of(tmp_path, floor(), floor()[:100]), Told())
    assert told == [("read", 776, "points"), 676, 100, "end"]
