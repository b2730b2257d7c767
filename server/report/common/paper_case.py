"""Test data of the walkthrough: the generated façade of the paper's size, or a user's own scene."""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....builder.synthetic.facade import build_facade
from ....builder.synthetic.figure import figure_points
from ....builder.synthetic.scenes import make_facade
from ....builder.synthetic.walk import walk_poses
from ....schemas.archive.archive import Archive
from ....schemas.errors import BadRequestError
from ...avatars.avatar_shape import read_avatar
from ...cli.input.pose_file import read_poses

PAPER_POINTS = 587_923
PAPER_VOXEL = 32.0  # [m]; contains the whole generated façade, like the paper's one voxel
STEP = 1e-4  # lattice step of the builds [m], unless an archive with its own step is given


class Case(NamedTuple):
    """A scene, an avatar and a walk.

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
    """Generate the façade of the paper's size, with the figure of 3,617 points and a walk of 40 s.

    folder: receives the scan.
    """
    scan = folder / "facade.laz"
    make_facade(scan, points=PAPER_POINTS)
    times, poses = walk_poses(build_facade().truth)
    return Case("generated façade", [scan], voxel, STEP, figure_points(), times, poses)


def given_case(
    scans: list[Path],
    archive: Path | None,
    avatar: Path | None,
    poses: Path,
    folder: Path,
    voxel: float = PAPER_VOXEL,
) -> Case:
    """Return the case of a user's scans, or of an archive, whose points are written to `folder`."""
    step = STEP
    name = ", ".join(path.name for path in scans)
    if archive is not None:
        scans, name = [folder / "points.ply"], archive.resolve().name
        step = write_points(archive, scans[0])
    body = figure_points() if avatar is None else read_avatar(avatar).points
    times, walk = read_poses(poses)
    if not len(walk):
        raise BadRequestError(f"{poses}: no poses, expected at least one: give a file with poses")
    return Case(name, scans, voxel, step, body, times, walk)


def archive_points(archive: Archive) -> Iterator[NDArray[np.float64]]:
    """Yield the points (n, 3), world frame [m], of an archive, voxel by voxel."""
    lattice = archive.header.lattice
    for row, coordinate in enumerate(archive.coordinates):
        voxel, links = archive.read_voxel(row)
        leaves = np.flatnonzero(links.is_leaf)
        leaves = leaves[np.argsort(links.first[leaves])]
        low = voxel.nodes.block_low[leaves].astype(np.int64) + voxel.cells.low[links.cell[leaves]]
        low = np.repeat(low, voxel.nodes.count[leaves], axis=0)
        yield lattice.to_world(voxel.points + low + coordinate * lattice.voxel_steps)


def write_points(folder: Path, target: Path) -> float:
    """Write the points of the archive in `folder` as a binary PLY; return its lattice step [m].

    An archive holds one hierarchy. Another degree requires a new build, which reads scans.
    """
    with Archive(folder) as archive, open(target, "wb") as file:
        header = ["ply", "format binary_little_endian 1.0", f"element vertex {archive.header.points}"]
        header += [f"property double {axis}" for axis in "xyz"] + ["end_header", ""]
        file.write("\n".join(header).encode())
        for xyz in archive_points(archive):
            file.write(xyz.astype("<f8").tobytes())
        return archive.header.lattice.step
