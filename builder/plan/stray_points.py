"""Stray points: points that hang in the air above floors, where a walking avatar would bump into them.

Dust, reflections and what is left of passing people. The rule, for the points of all scans together,
in metres with z up, at the poses that a build gives them:

- Points are counted in cubes of EDGE: floor(coordinate / EDGE) on each axis.
- Cubes with points that touch, with a face, an edge or a corner, form a group.
- A group with fewer than FEW points hangs if below one of its lowest cubes, in the same column or
  one of the eight around it, and at most DEPTH lower, there is a cube of a group with FEW points or
  more: a floor. A cube directly below would be in the group, so at least one cube between is empty.

A stray point within one to two cubes of a surface is in the group of the surface, and not counted.
A surface of fewer than FEW points that touches nothing, such as a sign on a thin pole that was not
seen, is counted. A table top is a floor by this rule.

Memory: about 80 bytes for each cube with points, of all scans, and as many again for those of one
scan.
"""

from collections.abc import Sequence
from itertools import groupby
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas.errors import ScanError
from ...schemas.runtime.interrupts import check_interrupt
from ..kernels.points.cube_components import (
    add_cubes,
    count_around,
    count_points,
    find_hanging,
    find_slots,
    join_cubes,
)
from ..passes.spool_pass import usable
from ..run.executor import Progress, Silent
from ..sources.common.scan import Scan
from ..sources.scan_files import open_entries
from ..sources.scan_list import ScanEntry

# Edge of a cube [m]: more than the spacing of most scans, so that surfaces hold together, and less
# than the gap that a walking body passes through.
EDGE = 0.1
# A group of this many points is no stray: 0.05 m^2 of a surface with points every centimetre.
FEW = 500
# Greatest height of a hanging group above a floor [m]: about that of a person.
DEPTH = 2.0
# Share of the points of a surface in 27 cubes that lie within EDGE of one in the middle: a disc of
# radius EDGE in a square of three EDGE.
DISC_SHARE = np.pi / 9
# --outliers is advised with the COUNT that leaves out the largest share of hanging points, less the
# share of the points of surfaces times LOSS_WEIGHT. That share is at
# most MOST_LOST.
LOSS_WEIGHT, MOST_LOST = 10.0, 0.01
# Values of --moving. Scans must have points within eight times the distance [m] of what they did not see:
# 0.8 m reaches the middle of a door from its jambs, 0.4 m does not.
MOVING = (0.1, 1)


class HangingPoints(NamedTuple):
    """Points of one scan that hang.

    read: number of its points.  points: of these, those that hang.  groups: number of groups they
    are in.
    largest, place: the number of its points in the group with most of them, and their centre (3,)
    world [m], within EDGE / 2; of equal groups the one with the least x, y, z; 0 and None without
    hanging points.
    """

    read: int
    points: int
    groups: int
    largest: int
    place: tuple[float, float, float] | None

    @property
    def share(self) -> float:
        """Return the share of the points that hang."""
        return self.points / self.read if self.read else 0.0


class StrayAdvice(NamedTuple):
    """Options of a build that leave hanging points out.

    points: number of hanging points of all scans.
    outliers: (R, COUNT) of `--outliers`; None where it would leave out too many points of surfaces.
    left_out: number of hanging points that it leaves out at least.
    lost: number of points of surfaces that it leaves out, an estimate.
    moving: (R, SCANS) of `--moving`; None if no scan with hanging points overlaps another.
    """

    points: int
    outliers: tuple[float, int] | None
    left_out: int
    lost: int
    moving: tuple[float, int] | None


class StrayPoints(NamedTuple):
    """Result of `find_stray_points`.

    scans: of each entry; None for one that is not used or cannot be read.  faults: number of an entry -> why it
    cannot be read.  advice: None if no point hangs.
    """

    scans: list[HangingPoints | None]
    faults: dict[int, str]
    advice: StrayAdvice | None


class CubeTable:
    """Numbers of points in cubes, see cube_components.py.

    origin: (3,) int64, the cube that coordinates are relative to.  known: number of cubes.
    """

    def __init__(self, origin: NDArray[np.int64] | None = None) -> None:
        """Start empty. origin: None: the cube of the first point."""
        self.origin = origin
        self.cubes, self.counts = np.zeros((1 << 10, 3), np.int32), np.zeros(1 << 10, np.int64)
        self._known = np.zeros(1, np.int64)

    @property
    def known(self) -> int:
        """Return the number of cubes."""
        return int(self._known[0])

    def count(self, xyz: NDArray[np.float64]) -> None:
        """Count points (n, 3) world [m], all finite."""
        if self.origin is None and len(xyz):
            self.origin = np.floor(xyz[0] / EDGE).astype(np.int64)
        done = 0
        while done < len(xyz):
            done += count_points(xyz[done:], EDGE, self.origin, self.cubes, self.counts, self._known)
            if done < len(xyz):
                self._grow(2 * len(self.counts))

    def add(self, cubes: NDArray[np.int32], numbers: NDArray[np.int64]) -> None:
        """Add cubes (n, 3) with numbers (n,) of points; the origin is that of this table."""
        size = len(self.counts)
        while 4 * (self.known + len(cubes)) > 3 * size:
            size *= 2
        if size > len(self.counts):
            self._grow(size)
        self._known[0] += add_cubes(cubes, numbers, self.cubes, self.counts)

    def _grow(self, size: int) -> None:
        """Move all cubes to a table of this size, a power of two."""
        held = self.counts != 0
        cubes, numbers = self.cubes[held], self.counts[held]
        self.cubes, self.counts = np.zeros((size, 3), np.int32), np.zeros(size, np.int64)
        add_cubes(cubes, numbers, self.cubes, self.counts)


class _Groups(NamedTuple):
    """Groups of the cubes of a table. parents, points: see `join_cubes`."""

    parents: NDArray[np.int64]
    points: NDArray[np.int64]

    @classmethod
    def of(cls, table: CubeTable) -> "_Groups":
        size = len(table.counts)
        found = cls(np.empty(size, np.int64), np.empty(size, np.int64))
        join_cubes(table.cubes, table.counts, *found)
        check_interrupt()
        return found


class _ScanCubes(NamedTuple):
    """Cubes of one scan that may hang, because they are in small groups even without other scans.

    cubes: (n, 3) int32.  numbers: (n,) of its points.  read: number of its points.
    box: (2, 3), lowest and highest of all its cubes.
    """

    cubes: NDArray[np.int32]
    numbers: NDArray[np.int64]
    read: int
    box: NDArray[np.int32]


def find_stray_points(entries: Sequence[ScanEntry], progress: Progress | None = None) -> StrayPoints:
    """Read the points of all entries, once, and find those that hang in the air.

    The entries are placed as a build of a list of them does. Those with a fault, and those that a
    build does not use, are not read.
    """
    progress = progress or Silent()
    whole = CubeTable()
    cubes: dict[int, _ScanCubes] = {}
    faults: dict[int, str] = {}
    progress.start("read", sum(entry.count or 0 for entry in entries if _is_read(entry)), "points")
    sound = [number for number, entry in enumerate(entries) if _is_read(entry)]
    # A file is opened once: to find the scans in a text file takes as long as reading it.
    for _, same in groupby(sound, key=lambda number: entries[number].path):
        numbers = list(same)
        (file,) = open_entries([entries[number] for number in numbers])
        faults |= dict.fromkeys(numbers, file.fault) if file.fault else {}
        for number, scan in zip(numbers, file.scans, strict=not file.fault):
            try:
                cubes[number] = _read(scan, whole, progress)
            except ScanError as error:
                faults[number] = str(error)
    progress.finish()
    groups, hangs = _hanging(whole)
    scans = [
        _of_scan(cubes[number], whole, groups, hangs) if number in cubes else None
        for number in range(len(entries))
    ]
    boxes = [
        (each.box, bool(scan and scan.points)) for number, each in cubes.items() for scan in [scans[number]]
    ]
    return StrayPoints(scans, faults, _advice(whole, groups, hangs, _overlap(boxes)))


def _is_read(entry: ScanEntry) -> bool:
    return entry.use and not entry.fault


def _read(scan: Scan, whole: CubeTable, progress: Progress) -> _ScanCubes:
    """Count the points of a scan in its own cubes, and add these to the table of all scans."""
    table = CubeTable(whole.origin)
    read = 0
    for block in scan.blocks():
        xyz = usable(block).xyz
        table.count(np.ascontiguousarray(xyz))
        read += len(xyz)
        progress.advance(len(block.xyz))
    if not read:
        return _ScanCubes(np.empty((0, 3), np.int32), np.empty(0, np.int64), 0, np.zeros((2, 3), np.int32))
    groups = _Groups.of(table)
    held = table.counts != 0
    whole.origin = table.origin
    whole.add(table.cubes[held], table.counts[held])
    box = np.stack([table.cubes[held].min(axis=0), table.cubes[held].max(axis=0)])
    held[held] = groups.points[groups.parents[held]] < FEW
    return _ScanCubes(table.cubes[held], table.counts[held], read, box)


def _hanging(table: CubeTable) -> tuple[_Groups, NDArray[np.bool_]]:
    """Return the groups of a table, and hangs (2^b,), true at the slots that represent hanging ones."""
    groups, size = _Groups.of(table), len(table.counts)
    lowest, hangs = np.empty(size, np.int64), np.empty(size, np.bool_)
    find_hanging(table.cubes, table.counts, *groups, FEW, round(DEPTH / EDGE), lowest, hangs)
    return groups, hangs


def _of_scan(scan: _ScanCubes, whole: CubeTable, groups: _Groups, hangs: NDArray[np.bool_]) -> HangingPoints:
    """Return the hanging points of one scan."""
    slots = np.empty(len(scan.cubes), np.int64)
    find_slots(scan.cubes, whole.cubes, whole.counts, slots)
    roots = groups.parents[slots]
    mine = hangs[roots]
    if whole.origin is None or not mine.any():
        return HangingPoints(scan.read, 0, 0, 0, None)
    names, of = np.unique(roots[mine], return_inverse=True)
    numbers = scan.numbers[mine]
    points = np.bincount(of, numbers).astype(np.int64)
    centres = (scan.cubes[mine] + whole.origin + 0.5) * EDGE
    centres = np.stack([np.bincount(of, numbers * axis) for axis in centres.T], axis=1) / points[:, None]
    most = int(points.max())
    x, y, z = min(np.round(centres[points == most], 3).tolist())
    return HangingPoints(scan.read, int(points.sum()), len(names), most, (x, y, z))


def _overlap(boxes: Sequence[tuple[NDArray[np.int32], bool]]) -> bool:
    """Return whether a scan with hanging points overlaps another: (box (2, 3), has hanging points)."""
    return any(
        bool((one[0] <= other[1]).all() and (other[0] <= one[1]).all())
        for k, (one, hangs) in enumerate(boxes)
        if hangs
        for m, (other, _) in enumerate(boxes)
        if m != k
    )


def _advice(table: CubeTable, groups: _Groups, hangs: NDArray[np.bool_], overlap: bool) -> StrayAdvice | None:
    """Return the options that leave out hanging points, and few of the points of surfaces.

    A hanging point has within EDGE no others than those of its own cube and the 26 around it, which
    are in its group. If they are COUNT together, it has fewer than COUNT others. A point of a
    surface has about DISC_SHARE of those in its cube and the 26 around it.
    """
    held = np.flatnonzero(table.counts)
    numbers, roots = table.counts[held], groups.parents[held]
    mine, surface = hangs[roots], groups.points[roots] >= FEW
    if not mine.any():
        return None
    around = np.empty(len(table.counts), np.int64)
    count_around(table.cubes, table.counts, around)
    near = around[held]
    expected = DISC_SHARE * near[surface]
    order = np.argsort(expected, kind="stable")
    lost = np.concatenate([[0], np.cumsum(numbers[surface][order])])
    counts = np.unique(near[mine])
    costs = lost[np.searchsorted(expected[order], counts, side="left")]
    by_near = np.argsort(near[mine], kind="stable")
    gone = np.cumsum(numbers[mine][by_near])
    gains = gone[np.searchsorted(near[mine][by_near], counts, side="right") - 1]
    benefit = gains / gone[-1] - LOSS_WEIGHT * costs / lost[-1]
    benefit[costs > MOST_LOST * lost[-1]] = 0.0
    best = int(benefit.argmax())
    moving = MOVING if overlap else None
    if benefit[best] <= 0:
        return StrayAdvice(int(gone[-1]), None, 0, 0, moving)
    return StrayAdvice(int(gone[-1]), (EDGE, int(counts[best])), int(gains[best]), int(costs[best]), moving)
