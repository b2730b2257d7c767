"""Archives for measurement: built with the command line as a user does, opened fully resident."""

import subprocess
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from solidcloud.builder.synthetic.scenes import make_facade
from solidcloud.schemas.archive.archive import Archive
from solidcloud.server.report.common.machine import say
from solidcloud.server.scene import Scene

PAPER_VOXEL, DEFAULT_VOXEL = 32, 8  # [m]; 32 holds the whole façade, like the paper's single voxel
STEP = 1e-4  # lattice step of the targets [m]


def build(scan: Path, target: Path, *, voxel: int | None = None, step: float | None = STEP) -> Path:
    """Build an archive of `scan` with the command line; None: the command's defaults."""
    say(f"building {target.name}" + (f" with --voxel {voxel}" if voxel else ""))
    options = ["--voxel", str(voxel)] if voxel else []
    options += ["--resolution", str(step)] if step else []
    command = [str(Path(sys.executable).with_name("solidcloud")), "build", str(scan), "-o", str(target)]
    # Standard output is reserved for the figures.
    subprocess.run([*command, *options], check=True, stdout=sys.stderr)
    return target


def facade_archives(folder: Path) -> dict[int, Path]:
    """Generate the façade and build it twice; return voxel [m] -> archive."""
    say("making the façade")
    scan = folder / "facade.laz"
    make_facade(scan)
    voxels = (PAPER_VOXEL, DEFAULT_VOXEL)
    return {voxel: build(scan, folder / f"voxel{voxel}", voxel=voxel) for voxel in voxels}


def stored_points(path: Path) -> NDArray[np.float64]:
    """Return all points (n, 3) that an archive stores, from its origin [m]."""
    blocks = []
    with Archive(path) as archive:
        lattice = archive.header.lattice
        for row, coordinate in enumerate(archive.coordinates):
            voxel, links = archive.read_voxel(row)
            leaves = np.flatnonzero(links.is_leaf)
            leaves = leaves[np.argsort(links.first[leaves])]
            low = voxel.nodes.block_low[leaves].astype(np.int64) + voxel.cells.low[links.cell[leaves]]
            low = np.repeat(low, voxel.nodes.count[leaves], axis=0)
            blocks.append(voxel.points + low + coordinate * lattice.voxel_steps)
    return np.concatenate(blocks) * lattice.step


def contact_distance(scenes: list[Scene], avatar: NDArray[np.float64]) -> float:
    """Add the avatar to every scene; return the sum of both radii [m], which must be equal in all."""
    infos = [scene.add_avatar("avatar", avatar) for scene in scenes]
    found = {float(scene.info().radius + info.radius) for scene, info in zip(scenes, infos, strict=True)}
    if len(found) != 1:
        raise SystemExit(f"the archives give different contact distances {found}: not one case, rebuild them")
    return found.pop()


def archive_bytes(path: Path) -> int:
    """Return the total size of an archive's files [bytes]."""
    return sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
