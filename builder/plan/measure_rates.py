"""Measurement of this machine's build rates, in seconds, relative to the packaged rates.

A synthetic cloud of a room's surfaces is generated, without ray casting, and built by one worker.
The time of each stage divided by the time that the packaged rates predict is the slowdown of this
machine. Reading is measured for each format whose library is installed.
"""

import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..config import BuildConfig
from ..pipeline import build_archive
from ..run.executor import Progress, Silent
from ..sources.scan_files import open_scans
from .rates import Rates, StageRate

POINTS = 1_000_000
READ_POINTS = 300_000


def room(points: int, seed: int = 2012) -> NDArray[np.float64]:
    """Generate points (n, 3) [m] on the surfaces of a hall of 30 x 20 x 8 m, with 2 mm of noise."""
    rng = np.random.default_rng(seed)
    size = np.array([30.0, 20.0, 8.0])
    at = rng.random((points, 3)) * size
    walls = np.array([size[1] * size[2], size[0] * size[2], size[0] * size[1]])
    axis = rng.choice(3, points, p=walls / walls.sum())
    which = np.arange(points), axis
    at[which] = size[axis] * rng.integers(0, 2, points) + rng.normal(0, 0.002, points)
    # Order the points in strips, as a scanner delivers columns.
    return at[np.argsort(np.floor(at[:, 0] * 20), kind="stable")]


def _write_las(path: Path, xyz: NDArray[np.float64]) -> None:
    """Write a LAS 1.2 file of points (n, 3), point format 0, scale 0.1 mm."""
    at = np.rint(xyz * 1e4).astype("<i4")
    bounds = np.stack([at.max(axis=0), at.min(axis=0)], axis=1).ravel() * 1e-4
    header = b"".join(
        [
            b"LASF", bytes(20), bytes([1, 2]), bytes(64), np.array([1, 2026], "<u2").tobytes(),
            np.array([227], "<u2").tobytes(), np.array([227, 0], "<u4").tobytes(), bytes([0]),
            np.array([20], "<u2").tobytes(), np.array([len(at), len(at), 0, 0, 0, 0], "<u4").tobytes(),
            np.array([1e-4] * 3 + [0.0] * 3, "<f8").tobytes(), bounds.astype("<f8").tobytes(),
        ]
    )  # fmt: skip
    records = np.zeros(len(at), [("xyz", "<i4", (3,)), ("rest", "V8")])
    records["xyz"] = at
    path.write_bytes(header + records.tobytes())


def _writers() -> dict[str, tuple[str, Callable[[Path, NDArray[np.float64]], None]]]:
    """Return the file suffix and the writer function of each format."""

    def made(path: Path, xyz: NDArray[np.float64]) -> None:
        from ..synthetic.scanner import ScannerPose, SimulatedScan
        from ..synthetic.write import open_target

        with open_target(path) as file:
            file.write(
                1, SimulatedScan(ScannerPose((0.0, 0.0, 0.0), 0.0), 0.0, xyz, np.zeros(len(xyz), np.uint16))
            )

    def ply(path: Path, xyz: NDArray[np.float64]) -> None:
        properties = "".join(f"property double {name}\n" for name in "xyz")
        head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(xyz)}\n{properties}end_header\n"
        path.write_bytes(head.encode() + xyz.astype("<f8").tobytes())

    def text(path: Path, xyz: NDArray[np.float64]) -> None:
        path.write_text("".join("%.4f %.4f %.4f\n" % tuple(point) for point in xyz.tolist()))  # noqa: UP031  fastest

    return {
        "las": (".las", _write_las),
        "laz": (".laz", made),
        "e57": (".e57", made),
        "ply": (".ply", ply),
        "text": (".xyz", text),
    }


def read_rates(folder: Path) -> dict[str, float]:
    """Return the seconds per point of reading each format whose library is installed."""
    xyz = np.round(room(READ_POINTS), 4)
    found: dict[str, float] = {}
    for name, (suffix, write) in _writers().items():
        path = folder / f"read{suffix}"
        try:
            write(path, xyz)
            found[name] = min(_read_seconds(path) for _ in range(2)) / READ_POINTS
        except ImportError:
            continue
        finally:
            path.unlink(missing_ok=True)
    return found


def _read_seconds(path: Path) -> float:
    """Return the processor time of reading a file in the page cache.

    Other load does not affect it.
    """
    begin = time.process_time()
    for scan in open_scans(path):
        for _ in scan.blocks():
            pass
    return time.process_time() - begin


def measure_rates(rates: Rates, progress: Progress | None = None) -> Rates:
    """Return the rates of this machine: those given, scaled by a small build, stage by stage."""
    progress = progress or Silent()
    config = BuildConfig(jobs=1)
    progress.start("measure", 3, "builds")
    with tempfile.TemporaryDirectory(prefix="solidcloud-measure-") as scratch:
        folder = Path(scratch)
        scan = folder / "room.las"
        _write_las(scan, room(20_000))
        build_archive([scan], folder / "warm", config)  # loads or compiles the kernels
        progress.advance(1)
        _write_las(scan, room(POINTS))
        summary = build_archive([scan], folder / "archive", config)
        progress.advance(1)
        read = {**rates.read, **read_rates(folder)}
        progress.advance(1)
    progress.finish()
    known = rates.stages
    shared = [name for name in known if name in summary.stages]
    factors = {name: summary.stages[name] / known[name].seconds(POINTS, 1) for name in shared}
    whole = sum(summary.stages[name] for name in shared) / sum(
        known[name].seconds(POINTS, 1) for name in shared
    )
    stages = {
        name: StageRate(*(value * factors.get(name, whole) for value in stage))
        for name, stage in known.items()
    }
    said = f"a synthetic cloud of {POINTS:,} points built here; the rest as in: {rates.rests_on}"
    return replace(rates, stages=stages, read=read, rests_on=said)
