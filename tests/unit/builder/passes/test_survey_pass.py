"""The first pass: counts, bounds and faults of scans, in ranges or at once, and one lattice for all sources."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import solidcloud.builder.passes.survey_pass as survey_module
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.passes.survey_pass import (
    Survey,
    choose_lattice,
    dump_part,
    hash_file,
    join_ranges,
    load_part,
    ranges,
    survey_range,
)
from solidcloud.builder.sources.common.scan import Scan, ScanBlock, SourceLattice
from solidcloud.builder.sources.scan_files import open_scans
from solidcloud.schemas.errors import ScanError, SolidcloudError
from synthetic_scans import make_scan, write_las


def survey_scan(scan: Scan) -> Survey:
    """Survey one scan in this process."""
    parts = [survey_range(unit) for unit in ranges(scan, scan.declared_count or 0)]
    return join_ranges(scan, parts, hash_file(scan.path))


class Listed(Scan):
    """A scan of points in memory, in blocks of a size of its own."""

    def __init__(self, path: Path, xyz: np.ndarray, size: int, fails_after: int | None = None) -> None:
        super().__init__(path, "text")
        self.xyz, self.size, self.fails_after = xyz, size, fails_after

    def _read(self, block_points: int) -> Iterator[ScanBlock]:
        for start in range(0, len(self.xyz), self.size):
            if self.fails_after is not None and start >= self.fails_after:
                raise ScanError(f"{self.path}: broke off")
            xyz = self.xyz[start : start + self.size]
            yield ScanBlock(xyz, np.arange(start, start + len(xyz), dtype=np.float32))


def listed(folder: Path, xyz: np.ndarray, size: int = 50, fails_after: int | None = None) -> Listed:
    """A scan with a file that can be hashed."""
    path = folder / "listed.xyz"
    path.write_bytes(b"any")
    return Listed(path, xyz, size, fails_after)


def test_points_that_are_all_unusable_were_somewhere(tmp_path: Path) -> None:
    scan = listed(tmp_path, np.full((4, 3), np.nan))
    survey = survey_scan(scan)
    assert "holds no usable point, expected at least one" in survey.fault
    assert (survey.empty, survey.region) == (False, None)
    scan.bounds = np.array([[0.0, 0, 0], [1.0, 1, 1]])
    assert np.array_equal(survey_scan(scan).region, [[-0.01] * 3, [1.01] * 3])


def test_a_scan_that_breaks_off_may_have_covered_header_and_points(tmp_path: Path) -> None:
    xyz = make_scan("noise", 1, 300)
    scan = listed(tmp_path, xyz, fails_after=200)
    survey = survey_scan(scan)
    assert (survey.count, survey.region, survey.empty) == (0, None, False)
    assert "broke off" in survey.fault
    low, high = xyz[:200].min(axis=0), xyz[:200].max(axis=0)
    scan.bounds = np.array([low + 0.001, high + 9.0])  # rounded, but not by more
    region = survey_scan(scan).region
    assert region is not None
    assert np.array_equal(region, [low + 0.001 - 0.01, high + 9.0 + 0.01])
    scan.bounds = np.array([low + 0.5, high + 9.0])
    assert survey_scan(scan).region is None, "a point lies outside: the header's bounds are wrong"


def test_a_scan_that_seeks_is_surveyed_in_ranges(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    xyz = write_las(tmp_path / "a.las", np.random.default_rng(1).integers(-1000, 1000, (50, 3)))
    (scan,) = open_scans(tmp_path / "a.las")
    assert [(unit.start, unit.stop, unit.points) for unit in ranges(scan, 50)] == [(0, 50, 50)]
    monkeypatch.setattr(survey_module, "RANGE_POINTS", (20, 30))
    assert [(unit.start, unit.stop, unit.points) for unit in ranges(scan, 0)] == [
        (0, 20, 20),
        (20, 40, 20),
        (40, 50, 10),
    ]
    assert [unit.start for unit in ranges(scan, 25 * survey_module.RANGES)] == [0, 25]
    assert [unit.start for unit in ranges(scan, 10**12)] == [0, 30]
    parts = [load_part(dump_part(survey_range(unit))) for unit in ranges(scan, 0)]
    assert [part.count for part in parts] == [20, 20, 10]
    survey = join_ranges(scan, parts, hash_file(scan.path))
    assert (survey.count, survey.fault, survey.parts) == (50, "", tuple(parts))
    assert np.array_equal([survey.low, survey.high], [xyz.min(axis=0), xyz.max(axis=0)])


@pytest.mark.parametrize("error", [MemoryError("std::bad_alloc"), OSError(12, "no")])
@pytest.mark.parametrize("where", ["survey_range", "hash_file"])
def test_that_memory_ran_out_is_no_fault_of_the_scan(
    where: str, error: Exception, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Starved(Listed):
        def _read(self, block_points: int) -> Iterator[ScanBlock]:
            yield from super()._read(block_points)
            raise error

    scan = Starved(listed(tmp_path, np.ones((4, 3))).path, np.ones((4, 3)), 50)
    monkeypatch.setattr("hashlib.sha256", lambda *_: (_ for _ in ()).throw(error))
    with pytest.raises(SolidcloudError, match=r"listed\.xyz: out of memory.*give fewer --jobs") as caught:
        survey_range(ranges(scan, 4)[0]) if where == "survey_range" else hash_file(scan.path)
    assert not isinstance(caught.value, ScanError)


# --- the lattice ------------------------------------------------------------------------------------------


def survey_on(folder: Path, lattice: SourceLattice | None, low: float = 0.0) -> Survey:
    """The survey of a scan whose source says this of its lattice."""
    scan = listed(folder, np.full((1, 3), low))
    scan.lattice = lattice
    return survey_scan(scan)


def grid(scale: float, offset: float = 0.0) -> SourceLattice:
    """A source's lattice, the same on each axis."""
    return SourceLattice((scale,) * 3, (offset,) * 3)


CHOICES = {
    "one lattice": ([grid(0.002), grid(0.002)], {}, 0.002, "sources"),
    "offsets apart by whole steps": ([grid(0.01), grid(0.01, 123456.78)], {}, 0.01, "sources"),
    "offsets apart by a part": ([grid(0.01), grid(0.01, 0.005)], {}, 1e-4, "default"),
    "other scales": ([grid(0.01), grid(0.001)], {}, 1e-4, "default"),
    "axes of other scales": ([SourceLattice((0.01, 0.01, 0.001), (0.0,) * 3)], {}, 1e-4, "default"),
    "one without": ([grid(0.01), None], {}, 1e-4, "default"),
    "none with": ([None], {}, 1e-4, "default"),
    "given": ([grid(0.01)], {"resolution": 0.005}, 0.005, "given"),
    "too fine to store": ([grid(1e-7)], {}, 1e-4, "default"),
    "too fine for the voxel": ([grid(2e-6)], {"voxel": 80.0}, 2e-6, "sources"),
    "coarser than a voxel": ([grid(10.0)], {}, 1e-4, "default"),
    "no number": ([grid(0.01), grid(0.01, float("nan"))], {}, 1e-4, "default"),
}


@pytest.mark.parametrize("name", CHOICES)
def test_the_sources_lattice_is_taken_where_they_share_one(name: str, tmp_path: Path) -> None:
    lattices, options, step, source = CHOICES[name]
    surveys = [survey_on(tmp_path, lattice, low=7.0 - i) for i, lattice in enumerate(lattices)]
    lattice, found = choose_lattice(surveys, [s.facts for s in surveys], BuildConfig(**options))
    assert (lattice.step, found) == (step, source)
    assert lattice.origin == (7.0 - (len(lattices) - 1),) * 3
