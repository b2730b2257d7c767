"""First pass over scans: finds bounds, counts, hashes and faults, then chooses the common lattice.

A scan that can seek is surveyed in ranges of its points, in any process, and its file's SHA-256 in
another.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.units import MAX_SCANS
from ...schemas.archive.voxel_grid import MAX_COORDINATE, MIN_STEP, Lattice, make_lattice
from ...schemas.errors import BadRequestError, ScanError
from ..build_limits import RANGE_POINTS, RANGES
from ..config import BuildConfig
from ..kernels.points.spool_rows import closest_to, usable_bounds
from ..resume.kept_work import BuildDirectory, Work, run_unfinished
from ..resume.transaction import Transaction
from ..run.transient_errors import raise_transient
from ..sources.common.colours import CLASS, SYNTHETIC, WITHHELD, brightest
from ..sources.common.scan import BEYOND, NOT_FINITE, Scan, sha256_of
from ..sources.lattice_step import choose_step
from ..sources.scan_files import InputFile, trusted_bounds
from ..sources.scan_warnings import ScanFacts, beyond_text

# A header's bounds may be rounded: they are trusted if no point lies farther outside than this [m],
# and grow by it where they stand for points that cannot be read.
BOUNDS_WITHIN = 0.01
# Points of a scan whose closest points are searched. The median of so many distances varies by
# about a tenth; twice as many take half as long again. In a scan that can seek they are read at
# PLACES, each of which takes 6 ms in a LAZ file.
PROBES, PLACES = 32, 8


@dataclass(frozen=True, slots=True, eq=False)
class Survey:
    """Result of the first pass for one scan.

    scan: its reader.  sha256: of its file.  count: usable points.
    low, high: (3,) float64, bounds of these, world [m]; infinite if there are none.
    not_finite: number of points left out because they are not finite.
    fault: why the scan cannot be used, or "".
    region: (2, 3), box that a faulty scan may have covered, world [m]; None: not known.
    empty: whether the scan has no points to lose.  parts: results of its ranges.
    """

    scan: Scan | None
    path: Path
    sha256: str
    count: int
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    not_finite: int
    fault: str = ""
    region: NDArray[np.float64] | None = None
    empty: bool = False
    parts: "tuple[Part, ...]" = ()

    @property
    def facts(self) -> ScanFacts:
        """Return the properties of a usable scan that the survey has found."""
        assert self.scan is not None
        return ScanFacts(self.scan, np.stack([self.low, self.high]), self.count, self.spacing)

    @property
    def spacing(self) -> float | None:
        """Return the median distance of a point to its closest one [m]; None if it was not measured."""
        closest = np.min([part.closest for part in self.parts], axis=0) if self.parts else np.empty(0)
        found = closest[np.isfinite(closest)]
        return float(np.median(found)) if len(found) else None

    @property
    def brightest(self) -> float:
        """Return the greatest channel of the scan's colours, see `eight_bits`."""
        return max((part.brightest for part in self.parts), default=0.0)

    @property
    def dropped(self) -> dict[str, int]:
        """Return the points left out, by reason."""
        found = sum((Counter(part.dropped) for part in self.parts), Counter[str]())
        found[NOT_FINITE] += self.not_finite
        found[BEYOND] += self.beyond
        return {reason: count for reason, count in found.items() if count}

    @property
    def unclean(self) -> str:
        """Return in words how many points, or triangles, their coordinates exclude; "" for none."""
        words = {NOT_FINITE: "that are not finite", BEYOND: BEYOND}
        found = self.dropped
        return " and ".join(f"{found[each]} points {words[each]}" for each in words if each in found)

    @property
    def beyond(self) -> int:
        """Return how many points were left out because they are too far away."""
        return sum(part.beyond for part in self.parts)


@dataclass(frozen=True, slots=True)
class Part:
    """Result for a range of a scan. dropped: reason -> points that the reader left out.

    fault: why it could not be read to its end, or "".
    brightest: greatest channel of its colours, if they are kept.
    beyond: points that are finite and too far away.  farthest: greatest coordinate of these [m].
    closest: distance [m] of each probe of the scan to its closest point in the range, see
    `_Probes`.
    """

    start: int
    stop: int | None
    count: int
    low: tuple[float, ...]
    high: tuple[float, ...]
    not_finite: int
    dropped: dict[str, int]
    fault: str
    brightest: float = 0.0
    beyond: int = 0
    farthest: float = 0.0
    closest: tuple[float, ...] = ()


class RangeUnit(NamedTuple):
    """Range of a scan to survey; 0 to None for a scan that cannot seek.

    points: approximate number.
    """

    scan: Scan
    start: int
    stop: int | None
    points: int


def ranges(scan: Scan, points: int) -> list[RangeUnit]:
    """Cut a scan into ranges. points: approximate total of all scans; it sets their size."""
    count = scan.declared_count
    if not scan.seekable or not count:
        return [RangeUnit(scan, 0, None, count or 0)]
    least, most = RANGE_POINTS
    step = min(max(points // RANGES, least), most)
    return [
        RangeUnit(scan, start, min(start + step, count), min(step, count - start))
        for start in range(0, count, step)
    ]


class _Probes:
    """Some points of a scan, spread over it, and the distances to their closest points.

    Every range of a scan that can seek has the same probes, and the least distances of all ranges
    count. In any other scan every `stride`-th point is a probe, PROBES to twice as many in the end.
    These are not compared with the points of earlier blocks: if the order is random, the median
    distance is up to 1.4 times the true one. The distances depend on the scan alone. A scan that
    states a lattice has no probes, because its step is known.
    """

    def __init__(self, scan: Scan) -> None:
        """Read the probes of a scan that can seek; what cannot be read, the survey reports."""
        self.xyz, self.best = np.empty((3, 0)), np.empty(0)
        self.stride = 0 if scan.lattice or scan.seekable else 1
        if scan.seekable and not scan.lattice:
            count, run = scan.declared_count or 0, PROBES // PLACES
            places = np.unique(np.linspace(0, max(0, count - run), PLACES).astype(np.int64)).tolist()
            try:
                for at in places:
                    self._add([block.xyz for block in scan.blocks(run, at, min(at + run, count))])
            except ScanError as error:
                raise_transient(error, scan.path)

    def _add(self, found: list[NDArray[np.float64]]) -> None:
        """Add probes (n, 3)."""
        self.xyz = np.concatenate([self.xyz, *(xyz.T for xyz in found)], axis=1)
        self.best = np.append(self.best, np.full(self.xyz.shape[1] - len(self.best), np.inf))

    def compare(self, xyz: NDArray[np.float64], first: int) -> None:
        """Compare with points (n, 3) [m], of which the first has the number `first` in the scan."""
        if self.stride:
            while len(self.best) + len(range(-first % self.stride, len(xyz), self.stride)) > 2 * PROBES:
                self.stride *= 2
                self.xyz, self.best = self.xyz[:, ::2].copy(), self.best[::2].copy()
            self._add([xyz[-first % self.stride :: self.stride]])
        closest_to(xyz, self.xyz, MIN_STEP, self.best)


def survey_range(unit: RangeUnit) -> Part:
    """Read a range of a scan once. A faulty scan is a result; only transient errors are raised."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    count = seen = beyond = 0
    fault, greatest, farthest = "", 0.0, 0.0
    closest: list[float] = []
    try:
        probes = _Probes(unit.scan)
        for block in unit.scan.blocks(start=unit.start, stop=unit.stop):
            usable = usable_bounds(block.xyz, MAX_COORDINATE, low, high)
            count += usable
            probes.compare(block.xyz, seen)
            seen += len(block.xyz)
            if usable < len(block.xyz):
                finite = np.abs(block.xyz[np.isfinite(block.xyz).all(axis=1)])
                beyond += len(finite) - usable
                farthest = max(farthest, float(finite.max(initial=0.0)))
            greatest = max(greatest, brightest(block.rgb))
        closest = np.sqrt(probes.best).tolist()
    except ScanError as error:
        raise_transient(error, unit.scan.path)
        fault = str(error)
    return Part(
        unit.start,
        unit.stop,
        count,
        tuple(low.tolist()),
        tuple(high.tolist()),
        seen - count - beyond,
        dict(unit.scan.dropped),
        fault,
        greatest,
        beyond,
        farthest,
        tuple(closest),
    )


def dump_part(part: Part) -> dict[str, Any]:
    """Convert a part to its journal entry."""
    return asdict(part)


def load_part(noted: dict[str, Any]) -> Part:
    """Convert a journal entry to a part."""
    return Part(**noted | {name: tuple(noted[name]) for name in ("low", "high", "closest")})


def hash_file(path: Path) -> tuple[str, str]:
    """Return (SHA-256 of a file, ""), or ("", why it cannot be read)."""
    try:
        return sha256_of(path), ""
    except ScanError as error:
        raise_transient(error, path)
        return "", str(error)


def join_ranges(scan: Scan, parts: Sequence[Part], sha256: tuple[str, str]) -> Survey:
    """Combine the results of a scan's ranges and of `hash_file` to its survey."""
    low = np.min([part.low for part in parts], axis=0)
    high = np.max([part.high for part in parts], axis=0)
    count, not_finite = sum(part.count for part in parts), sum(part.not_finite for part in parts)
    digest, unread = sha256
    fault = unread or next((part.fault for part in parts if part.fault), "")
    if fault:
        return Survey(
            scan,
            scan.path,
            digest,
            0,
            low,
            high,
            not_finite,
            fault,
            _region(scan, low, high),
            False,
            tuple(parts),
        )
    # A scan whose points are withheld, or of a class that is left out, is empty by choice.
    chosen = any(reason.startswith((WITHHELD, SYNTHETIC, CLASS)) for part in parts for reason in part.dropped)
    beyond = sum(part.beyond for part in parts)
    if not count and beyond:
        others = f" and {not_finite:,} that are not finite" if not_finite else ""
        text = beyond_text(scan.units, max(part.farthest for part in parts), others)
        fault = f"{scan.path}: scan {scan.index} holds {beyond:,} {text}"
    elif not count and not chosen:
        fault = f"{scan.path}: scan {scan.index} holds no usable point, expected at least one: leave it out"
    lost = not_finite + beyond + sum(part.dropped.get(NOT_FINITE, 0) for part in parts)
    nothing_lost = count == 0 and lost == 0
    region = None if count or nothing_lost else _region(scan, low, high)
    return Survey(
        scan, scan.path, digest, count, low, high, not_finite, fault, region, nothing_lost, tuple(parts)
    )


def unopened_survey(path: Path, fault: str, region: NDArray[np.float64] | None = None) -> Survey:
    """Return the survey of a file that cannot be opened, or that holds no scan if `fault` is empty.

    region: (2, 3) world [m], where its points may have been; None: not known.
    """
    none = np.zeros(3)
    if not fault:
        fault = f"{path}: holds no scan, expected at least one: leave it out"
        return Survey(None, path, "", 0, none, none, 0, fault, None, empty=True)
    return Survey(None, path, "", 0, none, none, 0, fault, None if region is None else _grown(region))


def _region(scan: Scan, low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return where a scan with a fault may have had points: the bounds that its header declares.

    The result is None, not known, if there are no such bounds, or if a point read lies outside
    them, which shows that they are wrong.
    """
    bounds = trusted_bounds(scan)
    if bounds is None:
        return None
    region = _grown(bounds)
    return None if (low < region[0]).any() or (high > region[1]).any() else region


def _grown(bounds: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a header's bounds (2, 3), grown by what their rounding may have cut off."""
    return np.stack([bounds[0] - BOUNDS_WITHIN, bounds[1] + BOUNDS_WITHIN])


def choose_lattice(
    surveys: Sequence[Survey], facts: Sequence[ScanFacts], config: BuildConfig
) -> tuple[Lattice, str]:
    """Choose the lattice of a dataset. Return it and the source of its step, see `choose_step`.

    The origin is exactly the least coordinate on each axis. A scene moved by a shift that float64
    holds exactly is therefore quantised to the same integers (NUMERICS.md case 1). Raise
    BadRequestError for impossible sizes.
    """
    origin = np.min([s.low for s in surveys], axis=0)
    step, source = choose_step(facts, config.resolution, config.voxel)
    return make_lattice(origin, step, config.voxel), source


def survey_scans(
    inputs: Sequence[InputFile],
    about: int,
    build_dir: BuildDirectory,
    build: Transaction,
) -> tuple[list[Survey], list[Survey]]:
    """Read every scan once; return the usable scans, ordered by content, and the faulty ones."""
    inputs = sorted(inputs, key=lambda item: str(item.path))  # this order numbers the journal entries
    scans = [scan for item in inputs for scan in item.scans]
    files = [item.path for item in inputs if item.scans]
    units = [
        (f"survey/{number:06d}-{unit.start:012d}", unit)
        for number, scan in enumerate(scans)
        for unit in ranges(scan, about)
    ]
    hashing = [(f"survey/sha256-{number:06d}", path) for number, path in enumerate(files)]
    with build.stage("survey", sum(unit.points for _, unit in units), "points"):
        both: list[tuple[str, Path | RangeUnit]] = [*hashing, *units]
        work: Work[Path | RangeUnit, Any] = Work(_hash_or_survey, _dump_either, _load_either)
        found = run_unfinished(build_dir.journal, build.executor, work, both, build.progress, _points_of)
    sha256 = dict(zip(files, found, strict=False))
    surveys, at = [], len(hashing)
    for scan in scans:
        count = len(ranges(scan, about))
        surveys.append(join_ranges(scan, found[at : at + count], sha256[scan.path]))
        at += count
    surveys += [unopened_survey(item.path, item.fault, item.region) for item in inputs if not item.scans]
    good = sorted((s for s in surveys if not s.fault), key=_content_order)
    faulty = sorted((s for s in surveys if s.fault), key=_content_order)
    _check_surveys(good, faulty, inputs, build.config)
    return good, faulty


def _hash_or_survey(unit: Path | RangeUnit) -> Any:
    """Run a unit of the survey: hash a file, or read a range."""
    return survey_range(unit) if isinstance(unit, RangeUnit) else hash_file(unit)


def _dump_either(result: Any) -> Any:
    """Convert a result of the survey to its journal entry."""
    return list(result) if isinstance(result, tuple) else dump_part(result)


def _load_either(noted: Any) -> Any:
    """Convert a journal entry to a result of the survey."""
    return tuple(noted) if isinstance(noted, list) else load_part(noted)


def _points_of(unit: Path | RangeUnit) -> int:
    """Return the number of points that a unit of the survey reads."""
    return unit.points if isinstance(unit, RangeUnit) else 0


def _check_surveys(
    good: list[Survey], faulty: list[Survey], inputs: Sequence[InputFile], config: BuildConfig
) -> None:
    """Refuse scans that cannot be built with these options."""
    if faulty and not config.skip_bad:
        more = "" if len(faulty) == 1 else "".join(f"\n  {s.fault}" for s in faulty[1:])
        raise ScanError(
            f"{faulty[0].fault}{more} (--skip-bad leaves such scans out and marks their region unknown)"
        )
    if not any(s.count for s in good):
        first = inputs[0].path if inputs else "nothing"
        raise ScanError(f"{first}: no usable scan, expected at least one: check the files")
    if ("scan" in config.keep or config.filter_passes) and len(good) > MAX_SCANS:
        raise BadRequestError(
            f"--keep scan, or a filter, with {len(good)} scans: expected at most {MAX_SCANS}: build in parts"
        )
    unclean = [s for s in good if s.unclean]
    if unclean and config.strict:
        raise ScanError(
            f"{unclean[0].path}: {unclean[0].unclean}, expected none with --strict: clean the scan"
        )


def _content_order(survey: Survey) -> tuple[str, int, str]:
    """Return the sort key of a scan. It depends on content, so the order of paths has no effect."""
    return survey.sha256, survey.scan.index if survey.scan else -1, str(survey.path)
