"""Test data of the accuracy report: scene, avatar, and poses at which settings are compared."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .....builder.config import DEFAULT_STEP, BuildConfig
from .....builder.synthetic.facade import build_facade
from .....builder.synthetic.figure import figure_points
from .....builder.synthetic.scenes import make_facade
from .....builder.synthetic.truth import SceneTruth, read_truth
from .....builder.synthetic.walk import walk_poses
from .....builder.voxel.record_points import voxel_points
from .....schemas.archive.archive import Archive
from .....schemas.archive.index import Header
from ....avatars.avatar_file import read_avatar
from ....avatars.avatar_model import make_avatar
from ...common.floor_walk import floor_walk
from .measurement_plan import MeasurementPlan

Floats = NDArray[np.float64]

AVATAR = "avatar"
SEED = 2012
# Reach of the distance queries [m].
REACH = 0.5
# Maximum offset of poses from the walk, to both sides and upwards [m]: about one in nine touches.
SIDEWAYS, UPWARDS = 0.2, 0.2


class MeasuredScene(NamedTuple):
    """Test data of a measurement.

    name: for titles.  scan: file to build.
    config: default configuration of its build, with a lattice step.
    warnings: sentences about what cannot be measured.
    truth: ground truth of the generated façade; None for other scans.
    is_figure: the avatar is the generated figure; the doorway error is defined only for it.
    avatar: (n, 3) [m].  walk: (k, 4, 4), poses on which times are measured.
    around: (k, 4, 4), the walk's poses with random offsets.
    """

    name: str
    scan: Path
    config: BuildConfig
    warnings: tuple[str, ...]
    truth: SceneTruth | None
    is_figure: bool
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


def generated_scene(plan: MeasurementPlan, avatar: Path | None, folder: Path) -> MeasuredScene:
    """Generate the façade's scan in `folder`, and return it with the walk through it."""
    scan = folder / "facade.laz"
    made = make_facade(scan, points=plan.points)
    body = figure_points() if avatar is None else read_avatar(avatar)
    _, walk = walk_poses(build_facade().truth, plan.frames)
    name, truth = f"generated façade of {made.points:,} points", read_truth(made.truth)
    config = BuildConfig(resolution=DEFAULT_STEP, overwrite=True)
    return MeasuredScene(name, scan, config, (), truth, avatar is None, body, walk, _moved(walk))


def archive_scene(archive: Path, plan: MeasurementPlan, avatar: Path | None, folder: Path) -> MeasuredScene:
    """Write the points nearest to an archive's middle voxel to `folder`, with a straight walk.

    They are built with the archive's options and its radius: fewer points would have another mean.
    Raises BadDataError if there is no floor to stand on.
    """
    with Archive(archive) as opened:
        points, total = _middle_points(opened, plan.max_points), opened.header.points
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
    return MeasuredScene(name, scan, config, warnings, None, avatar is None, body, walk, _moved(walk))


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


def write_ply(target: Path, points: Floats) -> None:
    """Write points (n, 3) as a binary PLY of doubles."""
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    header += [f"property double {axis}" for axis in "xyz"] + ["end_header", ""]
    target.write_bytes("\n".join(header).encode() + points.astype("<f8").tobytes())


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
