"""Scans of five kinds, generated small or large, to compare estimates of archive sizes with builds."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import synthetic_scans
from numpy.typing import NDArray
from solidcloud.builder.synthetic.scenes import make_facade


def _write(path: Path, xyz: NDArray[np.float64], step: float) -> None:
    """Write points as LAS on a lattice."""
    low = np.floor(xyz.min(axis=0))
    synthetic_scans.write_las(
        path, np.rint((xyz - low) / step).astype(np.int64), scale=step, offset=tuple(low)
    )


def made(folder: Path, points: int) -> None:
    """Generate a façade, scanned by casting rays: a LAZ file."""
    make_facade(folder / "facade.laz", points=points, seed=3)


def als(folder: Path, points: int) -> None:
    """Generate an airborne scan of rolling ground and some roofs, in flight strips.

    10 points per square metre, 1 cm.
    """
    rng = np.random.default_rng(1)
    side = np.sqrt(points / 10)
    xy = rng.random((points, 2)) * side
    z = 6 * np.sin(xy[:, 0] / 60) * np.cos(xy[:, 1] / 45) + rng.normal(0, 0.03, points)
    house = (np.floor(xy / 25).sum(axis=1) % 3 == 0) & ((xy % 25 < 12).all(axis=1))
    tree = ~house & (rng.random(points) < 0.15)
    z += np.where(house, 7 + 0.3 * (xy[:, 0] % 12), np.where(tree, rng.random(points) * 12, 0))
    order = np.lexsort((xy[:, 1], np.floor(xy[:, 0] / 40)))
    _write(folder / "tile.las", np.column_stack([xy, z])[order], 0.01)


def _room(
    rng: np.random.Generator, points: int, size: NDArray[np.float64], noise: float
) -> NDArray[np.float64]:
    """Return points on the six sides of a box, evenly distributed."""
    at = rng.random((points, 3)) * size
    areas = np.array([size[1] * size[2], size[0] * size[2], size[0] * size[1]])
    axis = rng.choice(3, points, p=areas / areas.sum())
    at[np.arange(points), axis] = size[axis] * rng.integers(0, 2, points) + rng.normal(0, noise, points)
    return at


def _seen_from(
    rng: np.random.Generator, xyz: NDArray[np.float64], station: NDArray[np.float64], count: int
) -> NDArray:
    """Return points of a surface with the density that a scanner at a station gives.

    The points are in the order of the scanner's rotation.
    """
    away = xyz - station
    near = 1 / np.maximum(1.0, (away**2).sum(axis=1))
    taken = xyz[rng.choice(len(xyz), count, replace=False, p=near / near.sum())]
    away = taken - station
    return taken[np.argsort(np.round(np.arctan2(away[:, 1], away[:, 0]), 3), kind="stable")]


def office(folder: Path, points: int) -> None:
    """Generate rooms with flat walls and 2 mm of noise, from several stations, one file each."""
    rng = np.random.default_rng(2)
    stations, size = 6, np.array([18.0, 9.0, 2.8])
    each = points // stations
    for number in range(stations):
        walls = _room(rng, 3 * each, size, 0.002)
        station = np.array([2 + 2.8 * number, 4.5, 1.5])
        _write(folder / f"station_{number}.las", _seen_from(rng, walls, station, each), 1e-4)


def church(folder: Path, points: int) -> None:
    """Generate large halls with few stations: some walls are a hundred times as dense as others."""
    rng = np.random.default_rng(3)
    each = points // 3
    for number, x in enumerate((6.0, 20.0, 55.0)):
        hall = _room(rng, 4 * each, np.array([70.0, 22.0, 18.0]), 0.003)
        xyz = _seen_from(rng, hall, np.array([x, 11.0, 1.7]), each)
        _write(folder / f"station_{number}.las", xyz, 1e-3)


def jittered(folder: Path, points: int) -> None:
    """Generate eight copies of one scan, each with its own noise of 1 mm."""
    rng = np.random.default_rng(4)
    first = _room(rng, points // 8, np.array([12.0, 8.0, 4.0]), 0.001)
    first = first[np.argsort(np.floor(first[:, 0] * 20), kind="stable")]
    for number in range(8):
        _write(folder / f"copy_{number}.las", first + rng.normal(0, 0.001, first.shape), 1e-4)


KINDS: dict[str, Callable[[Path, int], None]] = {
    "made": made,
    "als": als,
    "office": office,
    "church": church,
    "jittered": jittered,
}
