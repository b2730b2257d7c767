"""Test data of the accuracy report: scene, avatar, and poses at which settings are compared."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....builder.config import DEFAULT_STEP, BuildConfig
from ....builder.sources.scan_files import open_scans
from ....builder.synthetic.facade import build_facade
from ....builder.synthetic.figure import figure_points
from ....builder.synthetic.scenes import make_facade
from ....builder.synthetic.truth import SceneTruth, read_truth
from ....builder.synthetic.walk import walk_poses
from ....builder.voxel.point_radius import voxel_points
from ....schemas.archive.archive import Archive
from ....schemas.archive.index import Header
from ....schemas.errors import BadDataError
from ....schemas.wire.answers import Verdict
from ...avatars.avatar_file import read_avatar
from ...avatars.avatar_model import make_avatar
from ...scene import Scene
from ..common.floor_walk import floor_walk
from .accuracy_plan import Plan

Floats = NDArray[np.float64]

AVATAR = "avatar"
SEED = 2012
# Reach of the distance queries [m].
REACH = 0.5
# Maximum offset of poses from the walk, to both sides and upwards [m]: about one in nine touches.
SIDEWAYS, UPWARDS = 0.2, 0.2
# Absolute signed distance of near-tangent poses, from one exact unit to a micrometre [m].
LEAST_OFF, MOST_OFF = 1.5e-8, 1e-6
# Maximum number of moves along the nearest pair's normal: after a move another pair may be the
# nearest.
TANGENT_STEPS = 12
# Rotation that makes the façade's walls oblique to the axes: about z, then about x [rad].
TURN, TILT = np.deg2rad(33.0), np.deg2rad(21.0)


class Ground(NamedTuple):
    """Test data of a measurement.

    name: for titles.  scan: file to build.
    config: default configuration of its build, with a lattice step.
    warnings: sentences about what cannot be measured.
    truth: ground truth of the generated façade; None for other scans.
    own: the avatar is the generated figure; the doorway error is defined only for it.
    avatar: (n, 3) [m].  walk: (k, 4, 4), poses on which times are measured.
    around: (k, 4, 4), the walk's poses with random offsets.
    """

    name: str
    scan: Path
    config: BuildConfig
    warnings: tuple[str, ...]
    truth: SceneTruth | None
    own: bool
    avatar: Floats
    walk: Floats
    around: Floats

    @property
    def step(self) -> float:
        """Return the lattice step [m]."""
        return self.config.resolution or DEFAULT_STEP

    @property
    def judged(self) -> Floats:
        """Return the poses (2 k, 4, 4) of the comparison with the reference answers."""
        return np.concatenate([self.walk, self.around])


def made_ground(plan: Plan, avatar: Path | None, folder: Path) -> Ground:
    """Generate the façade's scan in `folder`, and return it with the walk through it."""
    scan = folder / "facade.laz"
    made = make_facade(scan, points=plan.points)
    body = figure_points() if avatar is None else read_avatar(avatar)
    _, walk = walk_poses(build_facade().truth, plan.frames)
    name, truth = f"generated façade of {made.points:,} points", read_truth(made.truth)
    config = BuildConfig(resolution=DEFAULT_STEP, overwrite=True)
    return Ground(name, scan, config, (), truth, avatar is None, body, walk, _moved(walk))


def given_ground(archive: Path, plan: Plan, avatar: Path | None, folder: Path) -> Ground:
    """Write the points nearest to an archive's middle voxel to `folder`, with a straight walk.

    They are built with the archive's options and its radius: fewer points would have another mean.
    Raises BadDataError if there is no floor to stand on.
    """
    with Archive(archive) as opened:
        points, total = _middle_points(opened, plan.most_points), opened.header.points
        config, warnings = config_of(opened.header), unknown_regions(opened.header)
    scan = folder / "points.ply"
    write_ply(scan, points)
    body = figure_points() if avatar is None else read_avatar(avatar)
    walk = floor_walk(points)[1]
    walk = walk[np.linspace(0, len(walk) - 1, min(plan.frames, len(walk))).astype(int)]
    # The walk places avatar points on scan points. Raise it by both radii: the spheres would else
    # intersect the floor at every pose.
    walk[:, 2, 3] += (config.radius or 0.0) + make_avatar(body).radius
    name = f"{archive.resolve().name}, {len(points):,} of {total:,} points"
    return Ground(name, scan, config, warnings, None, avatar is None, body, walk, _moved(walk))


def config_of(header: Header) -> BuildConfig:
    """Return options that build an archive's points again with its radius, lattice and nodes."""
    options = header.options
    return BuildConfig(
        voxel=header.lattice.voxel_size, resolution=header.lattice.step, radius=header.radius, degree=header.degree,
        leaf=header.leaf, cell_points=options["cell_points"], cells=options.get("cells", "octree"),
        with_slab=options["with_slab"], models=frozenset(header.models), overwrite=True,
    )  # fmt: skip


def unknown_regions(header: Header) -> tuple[str, ...]:
    """Return a warning about regions whose scans were left out of the archive, if there are any."""
    if header.unknown_everywhere:
        where = "everywhere, because the bounds of a scan that was left out are not known"
    elif len(header.unknown):
        where = f"in {len(header.unknown)} region{'s' * (len(header.unknown) > 1)}"
    else:
        return ()
    return (
        f"Scans were left out of this archive: it answers unknown {where}. That is not measured here: its points are "
        "built again without those regions.",
    )


def turned_ground(ground: Ground, folder: Path) -> Ground:
    """Return the scene and poses, rotated together so that no wall is parallel to an axis.

    The result has no ground truth.
    """
    c, s, c2, s2 = np.cos(TURN), np.sin(TURN), np.cos(TILT), np.sin(TILT)
    turn = np.array([[1, 0, 0], [0, c2, -s2], [0, s2, c2]]) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    middle = ground.walk[:, :3, 3].mean(axis=0)
    scan = folder / "turned.ply"
    write_ply(scan, (_scan_points(ground.scan) - middle) @ turn.T + middle)

    def turned(poses: Floats) -> Floats:
        moved = poses.copy()
        moved[:, :3, :3] = turn @ poses[:, :3, :3]
        moved[:, :3, 3] = (poses[:, :3, 3] - middle) @ turn.T + middle
        return moved

    return ground._replace(
        name=f"{ground.name}, turned", scan=scan, truth=None, walk=turned(ground.walk),
        around=turned(ground.around),
    )  # fmt: skip


def tangent_poses(scene: Scene, poses: Floats, count: int) -> Floats:
    """Return poses (<= count, 4, 4) whose signed distance is within MOST_OFF of 0, on either side.

    Each pose is moved along the contact normal of its nearest pair, as `distance` returns it, until
    its signed distance is as small as drawn at random. Poses that do not converge are left out.
    scene: with the avatar added.
    """
    rng = np.random.default_rng([SEED, 0x7A])
    moved = poses[rng.choice(len(poses), min(len(poses), 2 * count), replace=False)].copy()
    off = np.exp(rng.uniform(np.log(LEAST_OFF), np.log(MOST_OFF), len(moved))) * rng.choice(
        [-1, 1], len(moved)
    )
    settled = np.zeros(len(moved), bool)
    for _ in range(TANGENT_STEPS):
        open_ = np.flatnonzero(~settled)
        found = scene.distance(AVATAR, moved[open_], REACH)
        short = off[open_] - found.signed_distance
        settled[open_] = np.isfinite(short) & (np.abs(found.signed_distance) <= MOST_OFF)
        go = np.isfinite(short) & ~settled[open_]
        moved[open_[go], :3, 3] += short[go, None] * found.normal[go]
    return moved[settled][:count]


def judged_contact(scene: Scene, poses: Floats) -> NDArray[np.bool_]:
    """Return whether poses (k,) are in contact, exactly. Raises BadDataError if one is unknown."""
    verdict = scene.collide(AVATAR, poses).verdict
    if (verdict == Verdict.UNKNOWN).any():
        raise BadDataError(
            f"{int((verdict == Verdict.UNKNOWN).sum())} poses are unknown, expected none: check the scan"
        )
    return verdict == Verdict.CONTACT


def write_ply(target: Path, points: Floats) -> None:
    """Write points (n, 3) as a binary PLY of doubles."""
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    header += [f"property double {axis}" for axis in "xyz"] + ["end_header", ""]
    target.write_bytes("\n".join(header).encode() + points.astype("<f8").tobytes())


def _scan_points(scan: Path) -> Floats:
    """Return all points (n, 3) of a scan file [m]."""
    return np.concatenate([block.xyz for each in open_scans(scan) for block in each.blocks()])


def _middle_points(archive: Archive, most: int) -> Floats:
    """Return the points (n, 3), world frame [m], of the voxels nearest to the scene's middle.

    At most `most` points, but at least one voxel.
    """
    middle = np.median(archive.coordinates, axis=0)
    held: list[Floats] = []
    count = 0
    for row in np.argsort(((archive.coordinates - middle) ** 2).sum(axis=1), kind="stable"):
        count += int(archive.voxels["rows"][row, 2])
        if held and count > most:
            break
        local = voxel_points(*archive.read_voxel(int(row)))
        lattice = archive.header.lattice
        held.append(lattice.to_world(local + archive.coordinates[row] * lattice.voxel_steps))
    return np.concatenate(held)


def _moved(walk: Floats) -> Floats:
    """Return the walk's poses with random offsets."""
    rng = np.random.default_rng([SEED, 0xA0])
    moved = walk.copy()
    moved[:, :2, 3] += rng.uniform(-SIDEWAYS, SIDEWAYS, (len(walk), 2))
    moved[:, 2, 3] += rng.uniform(0.0, UPWARDS, len(walk))
    return moved
