"""What the accuracy report is measured on: a scene, an avatar, and the poses that settings are judged at."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...builder.config import DEFAULT_STEP, BuildConfig
from ...builder.made.facade import build_facade
from ...builder.made.figure import figure_points
from ...builder.made.scenes import make_facade
from ...builder.made.truth import SceneTruth, read_truth
from ...builder.made.walk import walk_poses
from ...builder.radius import voxel_points
from ...builder.sources.files import open_scans
from ...schemas.answers import Verdict
from ...schemas.archive import Archive
from ...schemas.errors import BadDataError
from ...schemas.index import Header
from ..avatar import make_avatar
from ..scene import Scene
from .accuracy_plan import Plan
from .floor_walk import floor_walk
from .points import read_avatar

Floats = NDArray[np.float64]

AVATAR = "avatar"
SEED = 2012
# Distances are asked up to here [m].
REACH = 0.5
# How far poses are moved off the walk, to both sides and upwards [m]: about one in nine of them touches.
SIDEWAYS, UPWARDS = 0.2, 0.2
# Near-tangent poses have their nearest pair off by this much, from an exact unit to a micrometre [m].
LEAST_OFF, MOST_OFF = 1.5e-8, 1e-6
# Moving along the nearest pair's normal lands on another pair at times: then again, so often at most.
TANGENT_STEPS = 12
# The turn that takes the façade's walls off the axes: about z, then about x [rad].
TURN, TILT = np.deg2rad(33.0), np.deg2rad(21.0)


class Ground(NamedTuple):
    """What is measured on.

    name: for titles.  scan: the file to build.  config: how, where nothing else is said; its lattice step is given.
    warnings: what of it is not measured, in sentences.  truth: of the made façade, else None.
    own: whether the avatar is the made figure, of which alone the doorway's error is known.
    avatar: (n, 3) [m].  walk: (k, 4, 4), on which times are measured.  around: (k, 4, 4), the walk's poses moved.
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
        """The lattice step [m]."""
        return self.config.resolution or DEFAULT_STEP

    @property
    def judged(self) -> Floats:
        """The poses (2 k, 4, 4) whose verdicts and distances are compared with the judge's."""
        return np.concatenate([self.walk, self.around])


def made_ground(plan: Plan, avatar: Path | None, folder: Path) -> Ground:
    """The made façade, scanned into `folder`, and the walk through it."""
    scan = folder / "facade.laz"
    made = make_facade(scan, points=plan.points)
    body = figure_points() if avatar is None else read_avatar(avatar)
    _, walk = walk_poses(build_facade().truth, plan.frames)
    name, truth = f"made façade of {made.points:,} points", read_truth(made.truth)
    config = BuildConfig(resolution=DEFAULT_STEP, overwrite=True)
    return Ground(name, scan, config, (), truth, avatar is None, body, walk, _moved(walk))


def given_ground(archive: Path, plan: Plan, avatar: Path | None, folder: Path) -> Ground:
    """The points of an archive, those nearest to its middle voxel, written to `folder`; a straight walk over them.

    They are built again as the archive was, with its radius: fewer points would have another mean.
    BadDataError: nothing to stand on.
    """
    with Archive(archive) as opened:
        points, total = _middle_points(opened, plan.most_points), opened.header.points
        config, warnings = config_of(opened.header), unknown_regions(opened.header)
    scan = folder / "points.ply"
    write_ply(scan, points)
    body = figure_points() if avatar is None else read_avatar(avatar)
    walk = floor_walk(points)[1]
    walk = walk[np.linspace(0, len(walk) - 1, min(plan.frames, len(walk))).astype(int)]
    # The walk's height is that of points over points; a thin avatar's large spheres would all stand in the floor.
    walk[:, 2, 3] += (config.radius or 0.0) + make_avatar(body).radius
    name = f"{archive.resolve().name}, {len(points):,} of {total:,} points"
    return Ground(name, scan, config, warnings, None, avatar is None, body, walk, _moved(walk))


def config_of(header: Header) -> BuildConfig:
    """The options that build an archive again from its points, into another of the same radius, lattice and nodes."""
    options = header.options
    return BuildConfig(
        voxel=header.lattice.voxel_size, resolution=header.lattice.step, radius=header.radius, degree=header.degree,
        leaf=header.leaf, cell_points=options["cell_points"], cells=options.get("cells", "octree"),
        with_slab=options["with_slab"], models=frozenset(header.models), overwrite=True,
    )  # fmt: skip


def unknown_regions(header: Header) -> tuple[str, ...]:
    """What is said of regions whose scans were left out: they are not built again."""
    if header.unknown_everywhere:
        where = "everywhere, for of a scan left out not even the bounds are known"
    elif len(header.unknown):
        where = f"in {len(header.unknown)} region{'s' * (len(header.unknown) > 1)}"
    else:
        return ()
    return (
        f"Scans were left out of this archive: it answers unknown {where}. That is not measured here: the points it "
        "has are built again without.",
    )


def turned_ground(ground: Ground, folder: Path) -> Ground:
    """The same scene, avatar and poses, turned together so that no wall stands along an axis; it has no truth."""
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
    """Poses (<= count, 4, 4) whose signed distance is within MOST_OFF of 0, on either side, by the engine's `distance`.

    scene: with the avatar added. Each pose is moved along the normal of its nearest pair until that pair is as far off
    as was drawn; a pose where it does not settle is left out.
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
    """The exact verdicts (k,) of poses; BadDataError where one is unknown."""
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
    """All points (n, 3) of a scan file [m]."""
    return np.concatenate([block.xyz for each in open_scans(scan) for block in each.blocks()])


def _middle_points(archive: Archive, most: int) -> Floats:
    """The points (n, 3) world [m] of the voxels nearest to the scene's middle, so many at most (but one voxel)."""
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
    """The walk's poses, each moved at random."""
    rng = np.random.default_rng([SEED, 0xA0])
    moved = walk.copy()
    moved[:, :2, 3] += rng.uniform(-SIDEWAYS, SIDEWAYS, (len(walk), 2))
    moved[:, 2, 3] += rng.uniform(0.0, UPWARDS, len(walk))
    return moved
