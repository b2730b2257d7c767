"""What the walkthrough is measured on: the made façade of the paper's size, or a user's own scene."""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...builder.made.facade import build_facade
from ...builder.made.figure import figure_points
from ...builder.made.scenes import make_facade
from ...builder.made.walk import walk_poses
from ...schemas.archive import Archive
from ...schemas.errors import BadRequestError
from ..pose_file import read_poses
from .points import read_avatar

PAPER_POINTS = 587_923
PAPER_VOXEL = 32.0  # [m]; holds the whole made façade, as the paper's one voxel does
STEP = 1e-4  # lattice step of the builds, unless an archive brings its own [m]


class Case(NamedTuple):
    """What is walked through by whom.

    name: for titles.  scans: the files to build.  voxel, step: of the builds [m].
    avatar: (n, 3) float64 [m].  times: (k,) [s].  poses: (k, 4, 4) float64, avatar to world.
    """

    name: str
    scans: list[Path]
    voxel: float
    step: float
    avatar: NDArray[np.float64]
    times: NDArray[np.float64]
    poses: NDArray[np.float64]


def made_case(folder: Path, voxel: float = PAPER_VOXEL) -> Case:
    """The made façade of the paper's size, its scan in `folder`; the figure of 3,617 points, the 40 seconds' walk."""
    scan = folder / "facade.laz"
    make_facade(scan, points=PAPER_POINTS)
    times, poses = walk_poses(build_facade().truth)
    return Case("made façade", [scan], voxel, STEP, figure_points(), times, poses)


def given_case(
    scans: list[Path],
    archive: Path | None,
    avatar: Path | None,
    poses: Path,
    folder: Path,
    voxel: float = PAPER_VOXEL,
) -> Case:
    """A user's scans, or the points of an archive, written to `folder` and built anew for each degree."""
    step = STEP
    name = ", ".join(path.name for path in scans)
    if archive is not None:
        scans, name = [folder / "points.ply"], archive.resolve().name
        step = write_points(archive, scans[0])
    body = figure_points() if avatar is None else read_avatar(avatar)
    times, walk = read_poses(poses)
    if not len(walk):
        raise BadRequestError(f"{poses}: no poses, expected at least one: give a path to walk")
    return Case(name, scans, voxel, step, body, times, walk)


def archive_points(archive: Archive) -> Iterator[NDArray[np.float64]]:
    """The points (n, 3) world [m] of an archive, voxel by voxel."""
    lattice = archive.header.lattice
    for row, coordinate in enumerate(archive.coordinates):
        voxel, links = archive.read_voxel(row)
        leaves = np.flatnonzero(links.is_leaf)
        leaves = leaves[np.argsort(links.first[leaves])]
        low = voxel.nodes.block_low[leaves].astype(np.int64) + voxel.cells.low[links.cell[leaves]]
        low = np.repeat(low, voxel.nodes.count[leaves], axis=0)
        yield lattice.to_world(voxel.points + low + coordinate * lattice.voxel_steps)


def write_points(folder: Path, target: Path) -> float:
    """Write the points of the archive in `folder` as a binary PLY; returns its lattice step [m].

    An archive holds one hierarchy; for another degree its points are built anew, and a build takes scans.
    """
    with Archive(folder) as archive, open(target, "wb") as file:
        header = ["ply", "format binary_little_endian 1.0", f"element vertex {archive.header.points}"]
        header += [f"property double {axis}" for axis in "xyz"] + ["end_header", ""]
        file.write("\n".join(header).encode())
        for xyz in archive_points(archive):
            file.write(xyz.astype("<f8").tobytes())
        return archive.header.lattice.step
