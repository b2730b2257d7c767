"""Archive that scripts/loadtest serves: a generated town that is kept in a folder."""

import shutil
import subprocess
import sys
from pathlib import Path

from solidcloud.server.report.common.machine import say

COMMAND = [sys.executable, "-P", "-m", "solidcloud.server.cli.main"]


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
