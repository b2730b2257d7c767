"""What the filters leave out, against every pair in Python's integers; whatever the voxels, runs, blocks and jobs."""

import os
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.passes import filter_pass as filters
from solidcloud.builder.passes.filter_pass import filtered_spool
from solidcloud.builder.passes.filter_rules import MOVING, OUTLIER, THINNED
from solidcloud.builder.resume.kept_work import Journal
from solidcloud.builder.resume.transaction import make_executor
from solidcloud.builder.run.executor import Silent
from solidcloud.builder.spool import spool_blocks as blocks
from solidcloud.builder.spool.run_files import filter_dtype, row_codes, spool_dtype
from solidcloud.builder.spool.spool import Spool
from solidcloud.schemas.archive.voxel_grid import Lattice, voxel_coordinates, voxel_keys
from solidcloud.schemas.errors import BadRequestError
from written_runs import write_run

INTERPRETED = os.environ.get("NUMBA_DISABLE_JIT") == "1"
STEP = 0.001
ALL = frozenset({"scan", "intensity"})


class Points:
    """Points on a lattice. at: (n, 3) int64.  scans: (n,).  intensities: (n,) float32."""

    def __init__(self, at: np.ndarray, scans: np.ndarray, intensities: np.ndarray) -> None:
        self.at, self.scans, self.intensities = at, scans, intensities

    def rows(self, which: np.ndarray | slice = slice(None)) -> list[tuple]:
        """As tuples, sorted."""
        columns = (*self.at[which].T.tolist(), self.scans[which].tolist(), self.intensities[which].tolist())
        return sorted(zip(*columns, strict=True))


def cloud(rng: np.random.Generator, n: int = 400, scans: int = 4) -> Points:
    """Clusters on both sides of voxel borders, duplicates, loners; scans that see a part each."""
    middle = rng.integers(-150, 150, (12, 3))
    at = middle[rng.integers(0, 12, n)] + rng.integers(-14, 15, (n, 3))
    at[: n // 8] = at[n // 8 : 2 * (n // 8)]  # duplicates, of other scans mostly
    at[-5:] = rng.integers(-400, 400, (5, 3))
    of = (rng.integers(0, scans, n) * (rng.random(n) < 0.8) + (at[:, 0] > 20)) % scans
    return Points(at, of, rng.integers(0, 3, n).astype(np.float32))


def spool_of(points: Points, folder: Path, voxel_steps: int, runs: int, rng: np.random.Generator) -> Spool:
    """The points as a spool of so many runs, in any order."""
    folder.mkdir()
    dtype = filter_dtype(BuildConfig(keep=ALL))
    voxels = points.at // voxel_steps
    rows = np.zeros(len(points.at), dtype)
    rows["local"] = points.at - voxels * voxel_steps
    rows["scan_index"], rows["intensity"] = points.scans, points.intensities
    lattice = Lattice((0.0, 0.0, 0.0), STEP, voxel_steps)
    for i, part in enumerate(np.array_split(rng.permutation(len(rows)), runs)):
        write_run(folder / f"{i:06d}.run", voxel_keys(voxels[part]), rows[part])
    return Spool(folder, dtype, lattice)


def contents(spool: Spool) -> Points:
    """All points of a spool."""
    at, scans, intensities = [], [], []
    for key in spool.keys.tolist():
        rows = np.concatenate(spool.rows(key))
        low = voxel_coordinates(np.array([key], np.uint64))[0] * spool.lattice.voxel_steps
        at.append(rows["local"] + low)
        names = rows.dtype.names or ()
        scans.append(rows["scan_index"] if "scan_index" in names else np.zeros(len(rows), int))
        intensities.append(rows["intensity"] if "intensity" in names else np.zeros(len(rows), np.float32))
    return Points(np.concatenate(at), np.concatenate(scans).astype(int), np.concatenate(intensities))


def run(spool: Spool, config: BuildConfig, folder: Path) -> tuple[Spool, filters.Counts]:
    folder.mkdir(exist_ok=True)
    with make_executor(config, 1) as executor:
        return filtered_spool(spool, config, folder, executor, Silent(), Journal(folder))


# --- the judge: every pair, Python's integers ------------------------------------------------------------


def near(points: Points, i: int, radius: str, wider: int = 1) -> list[int]:
    """The points within a radius [m] of point i, itself included."""
    reach2 = (Fraction(radius) / Fraction(str(STEP)) * wider) ** 2
    d2 = ((points.at - points.at[i]) ** 2).sum(axis=1)
    return [int(j) for j in np.flatnonzero(d2 <= int(reach2))]


def judged_outlier(points: Points, i: int, radius: str, count: int) -> bool:
    here = tuple(points.at[i].tolist())
    return len({tuple(points.at[j].tolist()) for j in near(points, i, radius)} - {here}) < count


def judged_moving(points: Points, i: int, radius: str, scans: int) -> bool:
    def others(wider: int) -> int:
        return len({int(points.scans[j]) for j in near(points, i, radius, wider)} - {int(points.scans[i])})

    return others(1) < scans <= others(8)


def spread(value: int) -> int:
    return sum((value >> bit & 1) << 3 * bit for bit in range(21))


def judged_thin(points: Points, steps: int) -> np.ndarray:
    """The points that stay (their indices); of equal ones any."""
    best: dict[tuple, tuple] = {}
    for i, at in enumerate(points.at.tolist()):
        cube = tuple(v // steps for v in at)
        inside = [v % steps for v in at]
        away = sum((2 * v - (steps - 1)) ** 2 for v in inside)
        code = sum(spread(v) << axis for axis, v in enumerate(inside))
        mine = (away, code, int(points.scans[i]), float(points.intensities[i]), i)
        best[cube] = min(best.get(cube, mine), mine)
    return np.array([found[-1] for found in best.values()])


VOXELS = [(1 << 12, 1, None), (100, 5, 16)]  # steps, runs, points held at a time


@pytest.fixture(params=VOXELS, ids=lambda p: f"{p[0]}steps-{p[1]}runs-{p[2]}held")
def layout(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> tuple[int, int]:
    steps, runs, held = request.param
    if held is not None:
        monkeypatch.setattr(blocks, "BLOCK_POINTS", held)
        monkeypatch.setattr(blocks, "BORDER_POINTS", held // 2)
        monkeypatch.setattr(filters, "UNIT_POINTS", 100)
    return steps, runs


def check(points: Points, expected: dict[str, np.ndarray], left: Spool, counts: filters.Counts) -> None:
    """What stays, and what was counted of each scan: expected: reason -> (n,) bool."""
    out = np.logical_or.reduce(list(expected.values()))
    assert contents(left).rows() == points.rows(~out)
    for reason, mask in expected.items():
        scans, numbers = np.unique(points.scans[mask], return_counts=True)
        assert counts.get(reason, {}) == dict(zip(scans.tolist(), numbers.tolist(), strict=True))


@pytest.mark.parametrize(("radius", "count"), [("0.006", 1), ("0.03", 9)])
def test_outliers_are_those_with_too_few_other_points_around(
    layout: tuple[int, int], radius: str, count: int, rng: np.random.Generator, tmp_path: Path
) -> None:
    points = cloud(rng)
    config = BuildConfig(keep=ALL, outliers=(float(radius), count), resolution=STEP)
    left, counts = run(spool_of(points, tmp_path / "a", *layout, rng), config, tmp_path / "b")
    out = np.array([judged_outlier(points, i, radius, count) for i in range(len(points.at))])
    assert 5 <= out.sum() < len(out)
    check(points, {OUTLIER: out}, left, counts)


@pytest.mark.parametrize(("radius", "scans"), [("0.0035", 2), ("0.0045", 3)])
def test_what_too_few_scans_saw_where_others_looked_is_moving(
    layout: tuple[int, int], radius: str, scans: int, rng: np.random.Generator, tmp_path: Path
) -> None:
    points = cloud(rng, 500)
    config = BuildConfig(keep=ALL, moving=(float(radius), scans))
    left, counts = run(spool_of(points, tmp_path / "a", *layout, rng), config, tmp_path / "b")
    out = np.array([judged_moving(points, i, radius, scans) for i in range(len(points.at))])
    assert 5 <= out.sum() < len(out) - 5
    check(points, {MOVING: out}, left, counts)


@pytest.mark.parametrize("steps", [1, 16])
def test_one_point_a_cube_stays_the_nearest_to_its_middle(
    layout: tuple[int, int], steps: int, rng: np.random.Generator, tmp_path: Path
) -> None:
    points = cloud(rng)
    config = BuildConfig(keep=ALL, thin=steps * STEP)
    left, counts = run(spool_of(points, tmp_path / "a", *layout, rng), config, tmp_path / "b")
    out = np.ones(len(points.at), bool)
    out[judged_thin(points, steps)] = False
    assert 5 <= out.sum() < len(out)
    assert contents(left).rows() == points.rows(~out)
    assert sum(counts[THINNED].values()) == out.sum()
    # The bound: whatever is left out lies less than sqrt(3) STEP from what stays.
    kept = contents(left).at
    for at in points.at[out]:
        assert int(((kept - at) ** 2).sum(axis=1).min()) <= 3 * (steps - 1) ** 2 < 3 * steps**2


@pytest.mark.interpreted
def test_rules_together_are_moving_and_outliers_of_all_points_then_thin_of_the_rest(
    layout: tuple[int, int], rng: np.random.Generator, tmp_path: Path
) -> None:
    points = cloud(rng, 250 if INTERPRETED else 400)
    config = BuildConfig(keep=ALL, moving=(0.003, 1), outliers=(0.008, 3), thin=0.005)
    left, counts = run(spool_of(points, tmp_path / "a", *layout, rng), config, tmp_path / "b")
    n = len(points.at)
    moving = np.array([judged_moving(points, i, "0.003", 1) for i in range(n)])
    outlier = np.array([judged_outlier(points, i, "0.008", 3) for i in range(n)]) & ~moving
    rest = np.flatnonzero(~moving & ~outlier)
    stays = Points(points.at[rest], points.scans[rest], points.intensities[rest])
    thinned = np.zeros(n, bool)
    thinned[rest] = True
    thinned[rest[judged_thin(stays, 5)]] = False
    assert moving.any() and outlier.any() and thinned.any()
    check(points, {MOVING: moving, OUTLIER: outlier, THINNED: thinned}, left, counts)


def test_rows_are_in_canonical_order_without_the_scan_where_it_is_not_kept(
    rng: np.random.Generator, tmp_path: Path
) -> None:
    points = cloud(rng)
    config = BuildConfig(keep=frozenset({"intensity"}), outliers=(0.03, 2))
    left, _ = run(spool_of(points, tmp_path / "a", 64, 3, rng), config, tmp_path / "b")
    assert left.dtype == spool_dtype(config) and "scan_index" not in (left.dtype.names or ())
    for key in left.keys.tolist():
        (rows,) = left.rows(key)
        order = np.lexsort((rows["intensity"], row_codes(rows)))
        assert np.array_equal(rows, rows[order])


def test_a_second_call_does_nothing_again(
    rng: np.random.Generator, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(filters, "UNIT_POINTS", 100)  # cut here, where units are planned
    points = cloud(rng)
    config = BuildConfig(outliers=(0.011, 4), thin=0.003)
    spool = spool_of(points, tmp_path / "a", 64, 3, rng)
    one, counts = run(spool, config, tmp_path / "one")
    whole = contents(one).rows()
    done: list[str] = []
    work = filters.filter_voxels
    monkeypatch.setattr(filters, "filter_voxels", lambda unit: done.append(unit.path.name) or work(unit))
    again, same = run(spool, config, tmp_path / "one")
    assert done == [] and same == counts
    lost = sorted(one.folder.glob("*.run"))[1]
    before = lost.read_bytes()
    lost.write_bytes(before[:-1])
    again, same = run(spool, config, tmp_path / "one")
    assert done == [lost.name] and same == counts and lost.read_bytes() == before
    assert contents(again).rows() == whole


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"outliers": (0.0005, 2)}, r"--outliers 0\.0005: expected at least the lattice step"),
        ({"outliers": (0.065, 2)}, r"--outliers 0\.065: expected at most a voxel, 0\.064 m"),
        (
            {"moving": (0.009, 1)},
            r"--moving 0\.009, examines 0\.072 m around each point: expected at most a voxel",
        ),
        ({"moving": (0.002, 17)}, r"--moving 0\.002,17: expected 1 to 16 scans"),
        ({"thin": 0.0646}, r"--thin 0\.0646: expected at most a voxel"),
        ({"outliers": (0.001, 10_000)}, "no point is left"),
    ],
)
def test_rules_that_cannot_be_done_are_refused_by_name(
    options: dict, said: str, rng: np.random.Generator, tmp_path: Path
) -> None:
    spool = spool_of(cloud(rng), tmp_path / "a", 64, 1, rng)
    with pytest.raises(BadRequestError, match=said):
        run(spool, BuildConfig(**options), tmp_path / "b")


def test_a_distance_is_the_decimal_number_it_is_written_as(tmp_path: Path, rng: np.random.Generator) -> None:
    # In float64 0.003 / 0.001 is exactly 3, 0.007 / 0.001 is 7.000000000000001 and 0.009 / 0.001 below 9.
    for steps in (3, 7, 9):
        at = np.array([[0, 0, 0], [steps, 0, 0]])
        points = Points(at, np.zeros(2, int), np.zeros(2, np.float32))
        spool = spool_of(points, tmp_path / f"a{steps}", 64, 1, rng)
        left, counts = run(spool, BuildConfig(outliers=(steps / 1000, 1)), tmp_path / f"b{steps}")
        assert len(contents(left).at) == 2 and counts == {}
