"""Test data of the accuracy report: archive, avatar, and poses at which answers are compared."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from .....builder.config import BuildConfig
from .....builder.pipeline import build_archive
from .....builder.sources.lattice_step import STEPS
from .....builder.synthetic.facade import build_facade
from .....builder.synthetic.figure import figure_points
from .....builder.synthetic.scenes import make_facade
from .....builder.synthetic.truth import SceneTruth, read_truth
from .....builder.synthetic.walk import walk_poses
from .....builder.voxel.record_points import voxel_points
from .....schemas.archive.archive import Archive
from .....schemas.archive.index import Header
from .....schemas.wire.answers import Verdict
from ....avatars.avatar_model import make_avatar
from ....scene import Scene
from ...common.floor_walk import floor_walk
from ...common.paired_times import Floats
from .measurement_plan import MeasurementPlan

AVATAR = "avatar"
SEED = 2012
# Reach of the distance queries [m].
REACH = 0.5
# Maximum offset of poses from the walk, to both sides and upwards [m]: about one in nine touches.
SIDEWAYS, UPWARDS = 0.2, 0.2
# The walk through a given archive follows voxels within BESIDE of a line [m]: at most CROSSED, of at
# most CROSSED_POINTS. Its floor is found by at most SAMPLED points of each.
BESIDE, CROSSED, CROSSED_POINTS, SAMPLED = 2.0, 96, 30_000_000, 50_000
# Quantiles across the middle line at which walks are tried: one may lead along the inside of a wall.
LINES = (0.5, 0.3, 0.7, 0.1, 0.9)


class MeasuredScene(NamedTuple):
    """Test data of a measurement.

    name: for titles.  archive: its folder.
    warnings: sentences about what cannot be measured.
    truth: ground truth of the generated façade; None for other scans.
    modelled: archive of the same scan with all radius models; None without ground truth.
    config: of the build of `modelled`.
    is_figure: the avatar is the generated figure; the doorway error is defined only for it.
    avatar: (n, 3) [m].  walk: (k, 4, 4), from one end to the other.
    around: (k, 4, 4), the walk's poses with random offsets.
    """

    name: str
    archive: Path
    warnings: tuple[str, ...]
    truth: SceneTruth | None
    modelled: Path | None
    config: BuildConfig
    is_figure: bool
    avatar: Floats
    walk: Floats
    around: Floats

    @property
    def judged(self) -> Floats:
        """Return the poses (2 k, 4, 4) of the comparison with the reference answers."""
        return np.concatenate([self.walk, self.around])


def generated_scene(
    plan: MeasurementPlan, avatar: Floats | None, models: frozenset[str], folder: Path
) -> MeasuredScene:
    """Generate the façade's scan in `folder`, build it, and return it with the walk through it.

    models: radius models stored in the second archive.
    """
    scan = folder / "facade.laz"
    made = make_facade(scan, points=plan.points)
    body = figure_points() if avatar is None else avatar
    _, walk = walk_poses(build_facade().truth, plan.frames)
    # These archives usually have one shard: more processes would only load numba several times.
    plain = BuildConfig(resolution=STEPS[0], overwrite=True, jobs=1)
    config = BuildConfig(resolution=STEPS[0], overwrite=True, jobs=1, models=models)
    for name, chosen in (("plain", plain), ("modelled", config)):
        build_archive([scan], folder / name, chosen)
    return MeasuredScene(
        f"generated façade of {made.points:,} points", folder / "plain", (), read_truth(made.truth),
        folder / "modelled", config, avatar is None, body, walk, _moved(walk),
    )  # fmt: skip


def archive_scene(archive: Path, plan: MeasurementPlan, avatar: Floats | None) -> MeasuredScene:
    """Return an archive with a straight walk over its floor, through the voxels around its middle.

    Of walks along LINES, it is the one with the most clear poses.

    Raises BadDataError if there is no floor to stand on.
    """
    with Archive(archive) as opened:
        points = middle_points(opened)
        header, warnings = opened.header, unknown_regions(opened.header)
    body = figure_points() if avatar is None else avatar
    walks = [floor_walk(points, quantile)[1] for quantile in LINES]
    for walk in walks:
        # The walk places avatar points on scan points. Raise it by both radii: the spheres would else
        # intersect the floor at every pose.
        walk[:, 2, 3] += header.radius + make_avatar(body).radius
    walk = _freest(archive, body, walks)
    walk = walk[np.linspace(0, len(walk) - 1, min(plan.frames, len(walk))).astype(int)]
    name = f"{archive.resolve().name}, {header.points:,} points"
    return MeasuredScene(
        name, archive, warnings, None, None, BuildConfig(), avatar is None, body, walk, _moved(walk)
    )


def _freest(archive: Path, avatar: Floats, walks: list[Floats]) -> Floats:
    """Return the walk with the most clear poses, the first of several."""
    with Scene.open(archive) as scene:
        scene.add_avatar(AVATAR, avatar)
        clear = [(scene.collide(AVATAR, walk[::10]).verdict == Verdict.CLEAR).sum() for walk in walks]
    return walks[int(np.argmax(clear))]


def unknown_regions(header: Header) -> tuple[str, ...]:
    """Return a warning about regions whose scans were left out of the archive, if there are any."""
    if header.unknown_everywhere:
        where = "everywhere, because the bounds of a scan that was left out are not known"
    elif len(header.unknown):
        where = f"in {len(header.unknown)} region{'s' * (len(header.unknown) > 1)}"
    else:
        return ()
    return (f"Scans were left out of this archive: it answers unknown {where}. Such poses are not measured.",)


def middle_points(archive: Archive) -> Floats:
    """Return points (n, 3), world frame [m], of the voxels along the middle of the longer horizontal axis.

    Of the voxels within BESIDE of the middle line, those nearest to the middle: at most CROSSED, of
    at most CROSSED_POINTS; of each about SAMPLED points at most.
    """
    at, lattice = archive.coordinates, archive.header.lattice
    along = int(np.argmax(np.ptp(at, axis=0)[:2]))
    middle = np.median(at, axis=0)
    beside = np.abs(at[:, 1 - along] - middle[1 - along]) * lattice.voxel_size
    line = np.flatnonzero(beside <= max(BESIDE, beside.min()))
    order = line[np.argsort(np.abs(at[line, along] - middle[along]), kind="stable")][:CROSSED]
    counts = np.cumsum(archive.voxels["rows"][order, 2].astype(np.int64))
    kept = []
    for row in order[: max(1, int((counts <= CROSSED_POINTS).sum()))].tolist():
        local = voxel_points(*archive.read_voxel(row))
        local = local[:: max(1, -(-len(local) // SAMPLED))]
        kept.append(lattice.to_world(local + at[row] * lattice.voxel_steps))
    return np.concatenate([np.empty((0, 3)), *kept])


def _moved(walk: Floats) -> Floats:
    """Return the walk's poses with random offsets."""
    rng = np.random.default_rng([SEED, 0xA0])
    moved = walk.copy()
    moved[:, :2, 3] += rng.uniform(-SIDEWAYS, SIDEWAYS, (len(walk), 2))
    moved[:, 2, 3] += rng.uniform(0.0, UPWARDS, len(walk))
    return moved
