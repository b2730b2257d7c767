"""Folder of scans in several formats, one of them damaged, for tests of scan lists; and edits of a list."""

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import synthetic_scans
import tomli_w
from scan_formats import ptx_scan, write_e57
from solidcloud.builder.sources.scan_files import InputFile

# Pose of the first scan in the PTX file.
POSE = np.array([[0.0, -1, 0, 10], [1, 0, 0, 20], [0, 0, 1, 30], [0, 0, 0, 1]])


def write_campaign(folder: Path) -> Path:
    """Write a LAS, a PTX of two scans, a damaged E57 and a text file below a new folder; return the folder."""
    (folder / "deep").mkdir(parents=True)
    raw = np.random.default_rng(1).integers(0, 1000, (50, 3))
    synthetic_scans.write_las(folder / "a.las", raw)
    xyz = raw[:20] * 0.01 + 1
    (folder / "b.ptx").write_text(ptx_scan(xyz, np.ones(20), POSE) + ptx_scan(xyz[:7], np.ones(7)))
    path = write_e57(folder / "deep" / "c.e57", [{"columns": {f"cartesian{a}": xyz[:, 0] for a in "XYZ"}}])
    data = bytearray(path.read_bytes())
    data[-100] ^= 1
    path.write_bytes(data)
    synthetic_scans.write_xyz(folder / "deep" / "d.xyz", xyz)
    return folder


def read_points(files: list[InputFile]) -> np.ndarray:
    """Return all points of all scans of some input files, (n, 3)."""
    blocks = [block.xyz for item in files for scan in item.scans for block in scan.blocks()]
    return np.concatenate([np.empty((0, 3)), *blocks])


def edit_list(path: Path, change: dict[str, Any], number: int = 0) -> None:
    """Set fields of one scan of a list; None removes a field."""
    document = tomllib.loads(path.read_text())
    document["scan"][number].update(change)
    for name in [name for name, value in document["scan"][number].items() if value is None]:
        del document["scan"][number][name]
    path.write_text(tomli_w.dumps(document))
