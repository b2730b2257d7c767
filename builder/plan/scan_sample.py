"""Quick sampling of scans for an estimate: number of points, surface area, number of voxels.

Headers state the number of points and their bounds, but not the surface area. Some points of each
scan are therefore read, which takes a few seconds. Scans that can seek are sampled in many places,
others at their beginning.
"""

import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.voxel_grid import MAX_COORDINATE, MIN_STEP, make_lattice, voxel_edge
from ...schemas.errors import ScanError
from ..config import BuildConfig
from ..sources.common.scan import Scan
from ..sources.lattice_step import choose_step
from ..sources.scan_files import InputFile, open_input_files
from ..sources.scan_warnings import ScanFacts, find_warnings
from .build_plan import BuildPlan, SceneStats, estimate
from .packed_sample import BrokenScanError, Packed, packed_sample
from .rates import Rates, load_rates

# Edges [m] of the cubes that measure surface area. The first edge is used with which a cube has at
# least POINTS_A_CUBE points. It is then far larger than the distance between points, and should be
# far smaller than a room.
CUBES = (0.25, 0.5, 1.0, 2.0)
POINTS_A_CUBE = 8
# Total number of samples (looks) over all scans, and points of each; each decodes a chunk of LAZ,
# 50,000 points.
LOOKS, LOOK_POINTS = 512, 2048
# One in this many sampled points is kept.
SOME = 8
# Points sampled from a scan that cannot seek, and the time limit [s] after which no further scan is
# sampled.
FIRST_POINTS = 1 << 17
SECONDS = 10.0
# A file whose header does not declare its points, mostly text, is assumed to have at least one
# point per this many bytes.
TEXT_BYTES = 30
# Most scans left out that are named.
MAX_NAMED = 5


class _Sample(NamedTuple):
    """Sample at one place.

    points: their number.  held: edge [m] -> (k,) int64 keys of non-empty cubes.
    some: (m, 3) [m], one point in SOME.
    """

    points: int
    held: dict[float, NDArray[np.int64]]
    some: NDArray[np.float64]


def _keys(xyz: NDArray[np.float64], edge: float) -> NDArray[np.int64]:
    """Return hash keys of the cubes of an edge that hold points (n, 3).

    Rare collisions are harmless.
    """
    at = np.floor(xyz / edge).astype(np.int64)
    return np.unique(
        at[:, 0] * 73_856_093 ^ at[:, 1] * 19_349_663 * 4_093 ^ at[:, 2] * 83_492_791 * 8_388_593
    )


class _Grid(NamedTuple):
    """Grids to count in. edge: of voxels [m].  origin: (3,) [m] of cubes and voxels."""

    edge: float
    origin: NDArray[np.float64]

    def look(self, xyz: NDArray[np.float64]) -> _Sample:
        """Sample points (n, 3) [m]: find the cubes that hold them."""
        xyz = xyz[(np.abs(xyz) <= MAX_COORDINATE).all(axis=1)] - self.origin
        held = {edge: _keys(xyz, edge) for edge in {*CUBES, self.edge}}
        return _Sample(len(xyz), held, xyz[::SOME] + self.origin)


def estimate_distinct(looks: Sequence[NDArray[np.int64]]) -> float:
    """Estimate a lower bound on the number of distinct keys from samples (Chao 1987, incidence).

    The numbers of keys seen in one sample only, and in two, indicate how many were seen in none.
    """
    seen = Counter(key for look in looks for key in look.tolist())
    once = sum(count == 1 for count in seen.values())
    twice = sum(count == 2 for count in seen.values())
    share = (len(looks) - 1) / len(looks) if looks else 0.0
    return len(seen) + share * once * (once - 1) / (2 * (twice + 1))


class _ScanSample(NamedTuple):
    """Samples of one scan. points: number in the scan.

    all_over: samples lie everywhere in the scan.
    """

    points: int
    looks: list[_Sample]
    all_over: bool


# Represents a scan that cannot be read and is left out.
_UNREADABLE = _ScanSample(0, [], True)


def _sample_scan(scan: Scan, looks: int, grid: _Grid) -> _ScanSample:
    """Sample a scan: read some of its points, and their number from its header."""
    count = scan.declared_count
    if scan.seekable and count:
        if count <= looks * LOOK_POINTS:
            found = [grid.look(block.xyz) for block in scan.blocks(LOOK_POINTS)]
            return _ScanSample(count, found, True)
        starts = np.linspace(0, count - LOOK_POINTS, looks).astype(np.int64).tolist()
        found = [
            grid.look(block.xyz)
            for start in starts
            for block in scan.blocks(LOOK_POINTS, start, start + LOOK_POINTS)
        ]
        return _ScanSample(count, found, True)
    found, read, whole = [], 0, True
    for block in scan.blocks(1 << 14):
        found.append(grid.look(block.xyz))
        read += len(block.xyz)
        if read >= FIRST_POINTS:
            whole = False
            break
    if count is None:
        # Only the length of the file is known.
        count = read if whole else max(read, scan.path.stat().st_size // TEXT_BYTES)
    return _ScanSample(count, found, whole)


def sample_scene(
    inputs: Sequence[InputFile], config: BuildConfig, rates: Rates | None = None, *, quick: bool = False
) -> SceneStats:
    """Sample opened scans to describe a build of them; pack some blocks of points.

    quick: read only a few points, and pack none.  rates: None: the packaged rates.
    Raise ScanError if no scan has a point, and for a broken scan unless `skip_bad` is set.
    """
    lost = [each.fault for each in inputs if each.fault]
    scans = [scan for each in inputs for scan in each.scans]
    if lost and not config.skip_bad:
        raise ScanError(f"{lost[0]} (--skip-bad leaves such scans out)")
    facts = [ScanFacts(scan) for scan in scans]
    step, _ = choose_step([each for each in facts if not each.scan.fault], config.resolution, config.voxel)
    voxel = voxel_edge(config.voxel, step)
    bounds = _bounds(scans)
    # Without bounds in the headers, the origin of the lattice is not known, and the voxel borders
    # differ from those of the build.
    grid = _Grid(voxel, np.zeros(3) if bounds is None else bounds[0])
    begin, blind = time.perf_counter(), 0
    seen: list[_ScanSample] = []
    for scan in scans:
        if time.perf_counter() - begin > SECONDS and seen:
            blind += 1
            seen.append(_ScanSample(scan.declared_count or 0, [], False))
            continue
        try:
            seen.append(_sample_scan(scan, max(4, LOOKS // len(scans)), grid))
        except ScanError as error:
            if not config.skip_bad:
                raise
            lost.append(str(error))
            seen.append(_UNREADABLE)
    packed = None
    while True:
        points, area = _points_and_area(seen)
        if quick:
            break
        try:
            packed = _packed(scans, seen, bounds, points / area, step, config, rates or load_rates())
            break
        except BrokenScanError as error:
            if not config.skip_bad:
                raise
            lost.append(str(error))
            seen[[scan is error.scan for scan in scans].index(True)] = _UNREADABLE
    voxels = _total(seen, voxel)
    looked = sum(look.points for each in seen for look in each.looks)
    formats: Counter[str] = Counter()
    for scan, each in zip(scans, seen, strict=True):
        formats[scan.format] += each.points
    assumed = [f"surface and voxels as in a sample of {looked:,} of {points:,} points"]
    if blind:
        assumed.append(f"{blind:,} scans not sampled are like the others")
    if unsaid := sum(scan.declared_count is None for scan in scans):
        assumed.append(f"{unsaid:,} files do not declare their number of points: one per {TEXT_BYTES} bytes")
    assumed += [f"without a scan that cannot be read: {fault}" for fault in lost[:MAX_NAMED]]
    if len(lost) > MAX_NAMED:
        assumed.append(f"without {len(lost) - MAX_NAMED:,} more scans that cannot be read")
    if packed is not None:
        assumed.append(
            f"bytes per point as in {packed.points:,} points packed as in a build; {packed.share:.0%} of all were read"
        )
        if packed.voxels is not None:
            voxels = float(packed.voxels)
    return SceneStats(
        points=points,
        scans=len(scans),
        largest=max(each.points for each in seen),
        input_bytes=sum(path.stat().st_size for path in {scan.path for scan in scans}),
        formats=formats,
        step=step,
        area=area,
        voxels=(voxel, max(1.0, min(voxels, points))),
        extent=None if bounds is None else float((bounds[1] - bounds[0]).max()),
        assumed=tuple(assumed),
        packed=None if packed is None else packed.bytes_a_point,
        warnings=(
            *(item.note for item in inputs if item.note),
            *(warning.text for warning in find_warnings(facts, config.radius, step)),
        ),
    )


def _points_and_area(seen: Sequence[_ScanSample]) -> tuple[int, float]:
    """Return the number of points and their surface area [m^2].

    Raise ScanError if there are none.
    """
    points = sum(each.points for each in seen)
    if not points:
        raise ScanError("no scan holds a point, expected some: check the files")
    for edge in CUBES:
        area = max(1.0, _total(seen, edge)) * edge**2
        if area * POINTS_A_CUBE <= points * edge**2:
            break
    return points, area


def _packed(
    scans: Sequence[Scan],
    seen: Sequence[_ScanSample],
    bounds: NDArray[np.float64] | None,
    density: float,
    step: float,
    config: BuildConfig,
    rates: Rates,
) -> Packed | None:
    """Pack a sample of the scans; return None if they cannot be built with these options."""
    some = [look.some for each in seen for look in each.looks]
    if not any(map(len, some)):
        return None
    if not (step >= MIN_STEP and round(config.voxel / step) >= 1):
        return None
    low = np.min(np.concatenate(some), axis=0) if bounds is None else bounds[0]
    # A scan that was not sampled, or is broken, is not read.
    used = [(scan, each.points) for scan, each in zip(scans, seen, strict=True) if each.points and each.looks]
    all_over = all(each.all_over for each in seen)
    return packed_sample(
        [scan for scan, _ in used],
        [points for _, points in used],
        make_lattice(low, step, config.voxel),
        density,
        np.concatenate(some) if all_over else None,
        config,
        rates,
    )


def _total(seen: Sequence[_ScanSample], edge: float) -> float:
    """Estimate the number of cubes of an edge that hold points, including unsampled cubes."""
    through = [look for each in seen if each.all_over for look in each.looks]
    if through and sum(look.points for look in through) >= sum(each.points for each in seen if each.all_over):
        found = float(len(np.unique(np.concatenate([look.held[edge] for look in through]))))
    else:
        found = estimate_distinct([look.held[edge] for look in through])
    for each in seen:
        if each.looks and not each.all_over:
            # Only its beginning was sampled; the rest is assumed to extend as far in proportion.
            own = len(np.unique(np.concatenate([look.held[edge] for look in each.looks])))
            found += own * each.points / max(1, sum(look.points for look in each.looks))
    looked = sum(each.points for each in seen if each.looks)
    return found * sum(each.points for each in seen) / max(1, looked)


def _bounds(scans: Sequence[Scan]) -> NDArray[np.float64] | None:
    """Return the bounds (2, 3) [m] of all scans by their headers; None if one declares none."""
    bounds = [scan.bounds for scan in scans if scan.bounds is not None]
    if not bounds or len(bounds) < len(scans):
        return None
    return np.stack([np.min([b[0] for b in bounds], axis=0), np.max([b[1] for b in bounds], axis=0)])


def plan_build(
    paths: Sequence[Path],
    config: BuildConfig,
    target: Path,
    rates: Rates | None = None,
    *,
    quick: bool = False,
) -> BuildPlan:
    """Return the estimate of building scans, folders of them or a list. quick: see `sample_scene`.

    Raise ScanError and BadRequestError as a build would, as far as a sample can detect the error.
    """
    rates = rates or load_rates()
    inputs = open_input_files(paths, config.spacing, drop_classes=config.drop_classes)
    scene = sample_scene(inputs, config, rates, quick=quick)
    return estimate(scene, config, rates, target)
