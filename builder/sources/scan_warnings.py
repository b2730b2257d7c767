"""Warnings about scans that a build accepts although they are probably a mistake.

`inspect`, `plan` and `build` report: what a reader assumed (`Scan.notes`), units that files state,
a scan that is probably in millimetres or beyond the limit of coordinates, a gap between scans far
larger than the scans, the mesh of an avatar beside scans, and a radius that does not fit the
spacing of the points. The checks use the bounds of headers, and read a few points of a scan only if
these do not suffice. A warning is one line and never an error.
"""

from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.units import MAX_COORDINATE, MIN_STEP
from ...schemas.errors import ScanError
from .common.scan import BEYOND, Scan
from .placed_scan import METRES

# Points that are read of a scan without known bounds; and points whose closest points are searched.
FIRST_POINTS, SAMPLE_POINTS = 1 << 13, 1 << 10
# A scan of fewer points is a test file: its spacing means nothing.
FEW_POINTS = 50
# A scan at least this long [m] with points at least this far apart [m] is probably in millimetres:
# a storey is 2,500 mm high, and a laser scan's points are 2 to 50 mm apart.
LONG, SPARSE = 1000.0, 2.0
# So is a shorter scan, of at least this length [m], whose least extent is this share of its length:
# an object, because terrain and rooms with points so far apart are flatter.
OBJECT_LENGTH, OBJECT_SHARE = 50.0, 0.3
# In map coordinates the terrain may be long and its points far apart; but not as high as this [m],
# nor as high as this share of its length.
HIGH, STEEP = 1000.0, 0.03
# A scan is in map coordinates if its distance from the origin exceeds this multiple of its length.
ON_A_MAP = 3.0
# Scans belong to different places if the gap between them exceeds this multiple of the longest scan,
# and this length [m].
FAR_TIMES, FAR = 20.0, 100.0
# Least length assumed of a scan whose bounds are not known [m].
UNKNOWN_LENGTH = 1000.0
# Longest mesh that may be an avatar [m]; a figure without units is a few lengths high.
AVATAR_LENGTH = 6.0
# A radius fits points whose spacing lies between these multiples of it. Half the spacing is usual;
# the estimate of a spacing may be wrong by a factor of ten.
TOO_DENSE, TOO_SPARSE = 1 / 20, 40.0
# Two scans whose spacings differ by more than this factor do not fit one radius.
UNLIKE = 20.0
# A lattice is too coarse for points that are closer together than this many steps. Rounding moves a
# point by up to 0.87 steps, and the radius is half of the distance: four steps are 0.43 of it.
FEW_STEPS = 4
# Most scans whose spacing is estimated.
MEASURED_SCANS = 32


class ScanWarning(NamedTuple):
    """Warning about a scan. number: of the scan, from 0.  text: one line."""

    number: int
    text: str


class ScanFacts:
    """Properties of a placed scan; its points are read when a property needs them."""

    def __init__(
        self,
        scan: Scan,
        box: NDArray[np.float64] | None = None,
        count: int | None = None,
        spacing: float | None = None,
    ) -> None:
        """Describe a scan in metres with z up.

        box: (2, 3), the bounds of its points [m], if known better than by its header.
        count: number of its points, likewise.  spacing: see the property; None: not measured.
        """
        self.scan = scan
        self._box = scan.bounds if box is None else box
        self._count = scan.declared_count if count is None else count
        self._spacing = spacing

    @property
    def name(self) -> str:
        """Return the path, with the scan's number in its file unless it is the first."""
        return f"{self.scan.path}{f' [{self.scan.index}]' if self.scan.index else ''}"

    @property
    def is_mesh(self) -> bool:
        """Return whether the file is a mesh and not a scan."""
        return self.scan.format in ("mesh", "glb")

    @property
    def is_measured(self) -> bool:
        """Return whether `spacing` was measured, and is not an estimate."""
        return self._spacing is not None

    @property
    def whole(self) -> bool:
        """Return whether `box` holds all points."""
        return self._box is not None or len(self._first) < FIRST_POINTS

    @cached_property
    def box(self) -> NDArray[np.float64] | None:
        """Return the bounds (2, 3) [m] of the points, of the first ones if the header has no bounds."""
        if self._box is not None:
            return self._box if bool(np.isfinite(self._box).all()) else None
        if not len(self._first):
            return None
        return np.stack([self._first.min(axis=0), self._first.max(axis=0)])

    @property
    def length(self) -> float:
        """Return the greatest extent along an axis [m]; 0 if it is not known."""
        return 0.0 if self.box is None else float((self.box[1] - self.box[0]).max())

    @property
    def count(self) -> int:
        """Return the number of points, of those read if the header has none."""
        return len(self._first) if self._count is None else self._count

    @cached_property
    def spacing(self) -> float | None:
        """Return the approximate distance between neighbouring points [m]; None if it is not known.

        Unless it is measured, it is the lesser of two estimates, each of which may be too large:
        the median distance of a point to its closest one among points that follow one another in
        the file, and that of points spread over the surface of the box.
        """
        if self._spacing is not None:
            return self._spacing
        if self.box is None or self.count < FEW_POINTS:
            return None
        x, y, z = (self.box[1] - self.box[0]).tolist()
        count = self.count if self.whole else len(self._first)
        spread = np.sqrt(2 * (x * y + y * z + z * x) / count)
        found = closest_distances(self._middle)
        return float(min(spread, np.median(found))) if len(found) else None

    @cached_property
    def _first(self) -> NDArray[np.float64]:
        """Return the first points of the scan (n, 3) [m]; none if it cannot be read."""
        return _points(self.scan, 0, FIRST_POINTS)

    @property
    def _middle(self) -> NDArray[np.float64]:
        """Return points (n, 3) [m] that follow one another, from the middle of the scan if it can seek."""
        declared = self.scan.declared_count
        if self.scan.seekable and declared and declared > SAMPLE_POINTS:
            return _points(self.scan, (declared - SAMPLE_POINTS) // 2, SAMPLE_POINTS)
        return self._first[-SAMPLE_POINTS:]


def _points(scan: Scan, start: int, count: int, limit: float = MAX_COORDINATE) -> NDArray[np.float64]:
    """Return up to `count` points of a scan with coordinates within a limit; none if it cannot be read."""
    found, left = [np.empty((0, 3))], count
    stop = min(start + count, scan.declared_count) if scan.seekable and scan.declared_count else None
    try:
        for block in scan.blocks(count, start if stop else 0, stop):
            xyz = block.xyz[(np.abs(block.xyz) <= limit).all(axis=1)]
            found.append(xyz[:left])
            left -= len(found[-1])
            if left <= 0:
                break
    except ScanError:
        pass  # the build reports it
    return np.concatenate(found)


def closest_distances(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distance of each distinct point of (n, 3) to its closest one; none of a single point."""
    points = np.unique(points, axis=0)
    if len(points) < 2:
        return np.empty(0)
    points = points - points.mean(axis=0)
    square = (points**2).sum(axis=1)
    apart = square[:, None] + square - 2 * points @ points.T
    np.fill_diagonal(apart, np.inf)
    closest = apart.argmin(axis=1)
    # Again as a difference: the product above is rounded.
    found: NDArray[np.float64] = np.linalg.norm(points - points[closest], axis=1)
    return found


def find_warnings(
    facts: Sequence[ScanFacts], radius: float | None = None, step: float | None = None
) -> list[ScanWarning]:
    """Return the warnings about scans that are built together, in order of the scans.

    radius: given for all points [m]; None: it is measured.
    step: of the lattice [m]; None: a build will choose it, and each scan's own is checked.
    """
    used = [(number, each) for number, each in enumerate(facts) if not each.scan.fault]
    found = [
        *(ScanWarning(number, note) for number, each in used for note in each.scan.notes),
        *_beyond_limit(used),
        *unit_warnings([each.scan for each in facts]),
        *_wrong_units(used),
        *_gaps(used),
        *_avatars(used),
        *(_unlike_spacings(used) if radius is None else _radius_of_scans(used, radius)),
        *_coarse_steps(used, step),
    ]
    return sorted(found, key=lambda warning: warning.number)


_Numbered = Sequence[tuple[int, ScanFacts]]


def unit_warnings(scans: Sequence[Scan]) -> list[ScanWarning]:
    """Tell which units other than the metre the files state, once for all scans of one statement."""
    alike: dict[str, list[int]] = {}
    for number, scan in enumerate(scans):
        if scan.units_note:
            alike.setdefault(scan.units_note, []).append(number)
    found = []
    for note, numbers in alike.items():
        scan = scans[numbers[0]]
        more = f" and {len(numbers) - 1} more" if len(numbers) > 1 else ""
        end = "" if scan.units == "m" else ": converted to metres"
        found.append(ScanWarning(numbers[0], f"{scan.path}{more}: {note}{end}"))
    return found


def _wrong_units(facts: _Numbered) -> list[ScanWarning]:
    """Warn of scans that are probably in millimetres but read as metres."""
    found = []
    for number, each in facts:
        if each.length < OBJECT_LENGTH or each.scan.units != "m" or each.scan.crs:
            continue
        assert each.box is not None
        size = each.box[1] - each.box[0]
        if each.length < LONG and float(size.min()) < OBJECT_SHARE * each.length:
            continue
        on_a_map = float(np.abs(each.box).max()) > ON_A_MAP * each.length
        if on_a_map and float(size.min()) < max(HIGH, STEEP * each.length):
            continue
        spacing = each.spacing
        if spacing is None or spacing < SPARSE:
            continue
        found.append(
            ScanWarning(
                number,
                f"{each.name}: {length_text(each.length)} long, points about {length_text(spacing)} apart: probably "
                'in millimetres: write a list with `solidcloud inspect`, set units = "mm" in it, and build the list',
            )
        )
    return found


def _beyond_limit(facts: _Numbered) -> list[ScanWarning]:
    """Warn of scans without bounds whose first points are all beyond the limit of coordinates."""
    found = []
    for number, each in facts:
        if each.box is None and len(points := _points(each.scan, 0, SAMPLE_POINTS, np.finfo(float).max)):
            text = beyond_text(each.scan.units, float(np.abs(points).max()))
            found.append(ScanWarning(number, f"{each.name}: {text}"))
    return found


def beyond_text(units: str, farthest: float, others: str = "") -> str:
    """Return what is wrong with points beyond the limit of coordinates, and the likely unit.

    units: read as.  farthest: greatest of their coordinates [m], taken from these units.
    others: what else was found.
    """
    what = f"points {BEYOND}{others}, expected all within it"
    if units == "m" and farthest * METRES["mm"] <= MAX_COORDINATE:
        return (
            f"{what}: the coordinates are probably in millimetres: write a list with `solidcloud inspect`, set "
            'units = "mm" in it, and build the list'
        )
    return f"{what}: check its coordinates and their unit ({units})"


def _gaps(facts: _Numbered) -> list[ScanWarning]:
    """Warn of the widest gap between scans that is far larger than the scans."""
    placed = [(number, each) for number, each in facts if each.box is not None]
    if len(placed) < 2:
        return []
    boxes = np.array([each.box for _, each in placed])
    longest = max(each.length if each.whole else max(each.length, UNKNOWN_LENGTH) for _, each in placed)
    gap, beyond = widest_gap(boxes)
    if gap <= max(FAR, FAR_TIMES * longest):
        return []
    # The fewer scans are the ones out of place.
    fewer = beyond if 2 * int(beyond.sum()) <= len(placed) else ~beyond
    number, first = placed[int(np.flatnonzero(fewer)[0])]
    more = f" and {int(fewer.sum()) - 1} more" if fewer.sum() > 1 else ""
    return [
        ScanWarning(
            number,
            f"{first.name}{more}: {length_text(gap)} away from all other scans, and no scan is longer than "
            f"{length_text(longest)}: check poses and units in a list of `solidcloud inspect`, or build apart",
        )
    ]


def widest_gap(boxes: NDArray[np.float64]) -> tuple[float, NDArray[np.bool_]]:
    """Return the widest gap along an axis that divides boxes (n, 2, 3), and which boxes lie above it."""
    best, above = 0.0, np.zeros(len(boxes), bool)
    for axis in range(3):
        order = np.argsort(boxes[:, 0, axis], kind="stable")
        ends = np.maximum.accumulate(boxes[order, 1, axis])
        gaps = boxes[order[1:], 0, axis] - ends[:-1]
        at = int(gaps.argmax())
        if gaps[at] > best:
            best = float(gaps[at])
            above = np.zeros(len(boxes), bool)
            above[order[at + 1 :]] = True
    return best, above


def _avatars(facts: _Numbered) -> list[ScanWarning]:
    """Warn of meshes of the size of an avatar, around the origin, beside scans."""
    suspect = [(number, each) for number, each in facts if _is_figure(each)]
    if len(suspect) == len(facts):
        return []
    return [
        ScanWarning(
            number,
            f"{each.name}: a mesh of {length_text(each.length)} around the origin, beside scans: leave it out if it "
            "is an avatar (use = false in a list), or it becomes an obstacle",
        )
        for number, each in suspect
    ]


def _is_figure(facts: ScanFacts) -> bool:
    """Return whether a scan is a mesh of the size and the place of an avatar's model."""
    if not facts.is_mesh or facts.box is None or not 0 < facts.length <= AVATAR_LENGTH:
        return False
    slack = 0.1 * facts.length
    return bool((facts.box[0] <= slack).all() and (facts.box[1] >= -slack).all())


def _measured(facts: _Numbered, *, meshes: bool = False) -> list[tuple[int, ScanFacts, float]]:
    """Return scans, and meshes too if asked, with their spacing: of some, if there are many."""
    chosen = [facts[k] for k in spread(len(facts), MEASURED_SCANS)]
    return [
        (number, each, spacing)
        for number, each in chosen
        if (meshes or not each.is_mesh) and (spacing := each.spacing) is not None
    ]


def spread(count: int, most: int) -> list[int]:
    """Return up to `most` of the numbers below `count`, spread over them."""
    found: list[int] = np.unique(np.linspace(0, count - 1, most).astype(int)).tolist() if count else []
    return found


def _unlike_spacings(facts: _Numbered) -> list[ScanWarning]:
    """Warn of the sparsest scan if one radius cannot fit it and the densest."""
    measured = [
        each for each in (_measured(facts) if len(facts) > 1 else []) if each[1].count >= SAMPLE_POINTS
    ]
    if len(measured) < 2:
        return []
    (number, sparse, wide) = max(measured, key=lambda each: each[2])
    (_, dense, narrow) = min(measured, key=lambda each: each[2])
    if wide <= UNLIKE * narrow:
        return []
    return [
        ScanWarning(
            number,
            f"{sparse.name}: points about {length_text(wide)} apart, those of {dense.name} {length_text(narrow)}: one "
            "radius does not fit both: build with --radius mean,local and query with the model local",
        )
    ]


def _radius_of_scans(facts: _Numbered, radius: float) -> list[ScanWarning]:
    """Warn of a given radius that does not fit the scans."""
    measured = _measured(facts)
    if not measured:
        return []
    number, each, spacing = sorted(measured, key=lambda found: found[2])[len(measured) // 2]
    text = radius_warning(radius, spacing)
    return [ScanWarning(number, f"{each.name}: {text}")] if text else []


def step_warning(facts: Sequence[ScanFacts], step: float) -> tuple[str, ...]:
    """Return the warning that a lattice step [m] is too coarse for scans, if it is."""
    return tuple(text for _, text in _coarse_steps(list(enumerate(facts)), step))


def _coarse_steps(facts: _Numbered, step: float | None) -> list[ScanWarning]:
    """Warn of the scan whose points are the fewest lattice steps apart, if these are too few."""
    checked = [each for each in facts if step is not None or each[1].scan.lattice is not None]
    found = []
    for number, each, spacing in _measured(checked, meshes=True):
        own = max(each.scan.lattice.scale) if each.scan.lattice is not None else 0.0
        coarse = own if step is None else step
        if spacing and spacing < FEW_STEPS * coarse:
            found.append((spacing / coarse, number, each, spacing, own, coarse))
    if not found:
        return []
    _, number, each, spacing, own, coarse = min(found, key=lambda one: one[:2])
    advice = f"build all scans with --resolution {max(spacing / 10, MIN_STEP):.1g}"
    if own >= coarse:
        advice = "export the scan with a finer scale"
    elif coarse <= MIN_STEP:
        advice = (
            "no step is finer: write a list with `solidcloud inspect` and enlarge all scans by scale = 1000.0"
        )
    return [
        ScanWarning(
            number,
            f"{each.name}: points about {length_text(spacing)} apart, in steps of {length_text(coarse)}: rounding "
            f"moves their surface by up to {length_text(0.87 * coarse)}: {advice}",
        )
    ]


def radius_warning(radius: float, spacing: float) -> str:
    """Return what is wrong with a given radius [m] for points of this spacing [m]; "" if it fits.

    A radius of 0 is a choice: the points themselves. A spacing of 0, of duplicates, tells nothing.
    """
    if not spacing:
        return ""
    if radius and spacing < TOO_DENSE * radius:
        what = f"--radius {radius:g} is {radius / spacing:,.0f} times the distance between points"
        return f"{what}, about {length_text(spacing)}: walls grow by {length_text(radius)}: give it in metres"
    if radius and spacing > TOO_SPARSE * radius:
        what = f"--radius {radius:g} is a small part of the distance between points"
        return (
            f"{what}, about {length_text(spacing)}: avatars pass between them: give about {spacing / 2:.2g}"
        )
    return ""


def length_text(metres: float) -> str:
    """Format a length: 12 mm, 3.4 m, 3,200 km."""
    for least, factor, unit in ((2000.0, 1e-3, "km"), (1.0, 1.0, "m")):
        if metres >= least:
            value = metres * factor
            return f"{value:,.0f} {unit}" if value >= 10 else f"{value:.2g} {unit}"
    return f"{metres * 1e3:.3g} mm"
