"""Scan placed in the world: converted to metres, turned to z up, moved by a pose, in float64."""

import copy
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ...schemas.errors import ScanError
from .common.scan import BOUNDS_MARGIN, IDENTITY, Scan, ScanBlock, SourceLattice, apply_pose, checked_bounds
from .common.units import EXPECTED_UNITS, axis_metres
from .common.units import METRES as METRES

# Up axis -> source axis of the world's x, y and z, and the sign of each: rotations, never
# reflections.
TURNS: dict[str, tuple[tuple[int, int, int], tuple[int, int, int]]] = {
    "z": ((0, 1, 2), (1, 1, 1)),
    "y": ((0, 2, 1), (1, -1, 1)),
    "x": ((1, 2, 0), (1, 1, 1)),
}


def place_scan(
    scan: Scan,
    *,
    pose: NDArray[np.float64] | None = None,
    units: str | None = None,
    up: str | None = None,
    scale: float = 1.0,
) -> Scan:
    """Return a scan at a pose, in metres, with z up; the scan itself where no coordinate changes.

    pose: (4, 4), scan in metres with z up -> world; None or the scan's own pose: keep the scan's
    pose.
    units: see `axis_metres`; None or "": the scan's own.
    up: a key of TURNS; None or "": the scan's own.
    scale: an additional factor, above 0.
    Raises ScanError if the scan's own unit is not a length.
    """
    units, up = units or scan.units, up or scan.up
    metres = axis_metres(units)
    if metres is None:
        raise ScanError(
            f"{scan.path}: {scan.units_note or f'coordinates in {units}'}, expected a length: project the scan to a "
            f"coordinate system in metres; or, if the file is wrong, give its units in a list of `solidcloud inspect`: "
            f"{EXPECTED_UNITS}"
        )
    if pose is not None and np.array_equal(pose, scan.pose):
        pose = None
    if pose is None and all(length * scale == 1 for length in metres) and up == "z":
        if (scan.units, scan.up) != (units, up):
            scan = copy.copy(scan)
            if scan.units != units:
                scan.units, scan.units_note = units, ""
            scan.up = up
        return scan
    return PlacedScan(scan, pose, units, up, scale)


class PlacedScan(Scan):
    """Scan scaled to metres, turned to z up, and moved by the given pose, in this order.

    Without a given pose the scan keeps its own, which is applied first, in the file's own units and
    axes. A given pose replaces the scan's own. Each number is multiplied once, axes are exchanged
    exactly, then `apply_pose` runs: a point gets the same bits in any block. `pose` combines all
    steps, including the scale.
    """

    def __init__(
        self, inner: Scan, given: NDArray[np.float64] | None, units: str, up: str, scale: float
    ) -> None:
        bounds = inner.bounds
        if given is not None and not np.array_equal(inner.pose, IDENTITY):
            # Readers apply the scan's own pose: use a copy without one. Its bounds were in the
            # world frame and no longer apply.
            inner, bounds = copy.copy(inner), None
            inner.pose, inner.bounds = IDENTITY, None
        self._inner = inner
        self._axes, self._signs = TURNS[up]
        # For each axis of the world: a length of the file [m].
        self._factors = tuple(length * scale for length in axis_metres(units) or ())
        self._given = IDENTITY if given is None else given
        turn = np.eye(4)
        turn[:3, :3] = np.eye(3)[list(self._axes)] * np.multiply(self._factors, self._signs)[:, None]
        super().__init__(
            inner.path,
            inner.format,
            index=inner.index,
            declared_count=inner.declared_count,
            pose=self._given @ turn @ inner.pose,
            lattice=self._lattice(),
            bounds=None if bounds is None else self._bounds(bounds),
        )
        self.units, self.up, self.crs, self.seekable = units, up, inner.crs, inner.seekable
        self.units_note = inner.units_note if units == inner.units else ""
        self.columns, self.notes = inner.columns, inner.notes

    def trusted_bounds(self) -> NDArray[np.float64] | None:
        return None if self._inner.trusted_bounds() is None else self.bounds

    def _read(self, block_points: int) -> Iterator[ScanBlock]:
        return self._read_range(block_points, 0, None)

    def _read_range(self, block_points: int, start: int, stop: int | None) -> Iterator[ScanBlock]:
        self._inner.wanted, self._inner.drop_classes = self.wanted, self.drop_classes
        for block in self._inner.blocks(block_points, start, stop):
            self.dropped = self._inner.dropped
            yield block._replace(xyz=self.place(block.xyz))
        self.dropped = self._inner.dropped

    def place(self, xyz: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return points (n, 3) of the file, its own pose applied, in the world [m]."""
        return apply_pose(self._given, self._turned(xyz))

    def _turned(self, xyz: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the points in metres with z up, (n, 3); changing a sign is exact, hence one rounding."""
        turned = np.empty_like(xyz)
        with np.errstate(over="ignore"):  # values beyond float64 become infinite; the caller counts them
            for axis, source in enumerate(self._axes):
                np.multiply(xyz[:, source], self._signs[axis] * self._factors[axis], out=turned[:, axis])
        return turned

    def _lattice(self) -> SourceLattice | None:
        """Return the source's lattice, scaled and turned; None if a pose moves the points."""
        inner = self._inner.lattice
        if inner is None or not np.array_equal(self._given, IDENTITY):
            return None
        scale = np.multiply(self._factors, np.take(inner.scale, self._axes))
        offset = np.multiply(self._factors, self._signs) * np.take(inner.offset, self._axes)
        return SourceLattice(tuple(scale.tolist()), tuple(offset.tolist()))

    def _bounds(self, bounds: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Return a box (2, 3) that encloses every point of the box `bounds` (2, 3) once placed."""
        corners = np.array(
            [[bounds[k, 0], bounds[m, 1], bounds[n, 2]] for k in (0, 1) for m in (0, 1) for n in (0, 1)]
        )
        moved = self.place(corners)
        return checked_bounds(
            np.stack([moved.min(axis=0) - BOUNDS_MARGIN, moved.max(axis=0) + BOUNDS_MARGIN])
        )
