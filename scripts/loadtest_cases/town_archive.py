"""Archive that a load test serves: a given one, or a generated town that is kept in a folder."""

import shutil
import subprocess
import sys
from pathlib import Path

from bench_build_cases.build_runs import COMMAND
from measurement.machine import say


def find(
    archive: Path | None, truth: Path | None, points: int, voxel: float, work: Path
) -> tuple[Path, Path]:
    """Return the archive and its truth, given or of a generated town of this many points.

    The town is generated where `work` has none. Raises SystemExit for a missing truth.
    """
    if archive is None:
        archive, beside = made_town(work, points, voxel)
    else:
        beside = archive.with_name(f"{archive.stem}.truth.json")
    truth = truth or beside
    if not truth.exists():
        raise SystemExit(
            f"{truth}: not there: name the truth that was written beside the scan of the town with --truth"
        )
    return archive, truth


def made_town(work: Path, points: int, voxel: float) -> tuple[Path, Path]:
    """Return the archive of a town of this many points and its truth; generate it where it is missing.

    The scan is not kept.
    """
    name = f"town-{points}-{voxel:g}"
    archive, truth = work / name, work / f"{name}.truth.json"
    if (archive / "index.h5").exists() and truth.exists():
        return archive, truth
    work.mkdir(parents=True, exist_ok=True)
    scan = work / f"{name}.las"
    say(f"making a town of {points:,} points, once")
    try:
        for step in (
            ["make", "town", "-o", str(scan), "--points", str(points)],
            ["build", str(scan), "-o", str(archive), "--voxel", f"{voxel:g}", "--overwrite"],
        ):
            # Standard output is reserved for the figures.
            subprocess.run([*COMMAND, *step], check=True, stdout=sys.stderr)
    finally:
        scan.unlink(missing_ok=True)
    shutil.rmtree(work / f".{name}.building", ignore_errors=True)
    return archive, truth
