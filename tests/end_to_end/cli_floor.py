"""Scan of a level floor for tests of the command, its archive, and the errors on standard error."""

from pathlib import Path

import numpy as np
import pytest
from solidcloud.server.cli.main import run

RADIUS = 0.05  # of the floor's points [m]


def floor(half: float = 2.0, step: float = 0.1) -> np.ndarray:
    """Return the points of a level floor at z = 0, (n, 3) [m]."""
    x, y = np.meshgrid(np.arange(-half, half, step), np.arange(-half, half, step))
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])


def build_floor(folder: Path) -> Path:
    """Build the floor's archive, `hall`, in a folder; return its path."""
    scan, target = folder / "floor.xyz", folder / "hall"
    np.savetxt(scan, floor(), fmt="%.4f")
    assert run(["build", str(scan), "-o", str(target), "--voxel", "2", "--jobs", "1"]) == 0
    return target


def errors(capsys: pytest.CaptureFixture[str]) -> list[str]:
    """Return the lines of standard error that report an error."""
    return [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
