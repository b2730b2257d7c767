"""Section `growth`: the same walk in the first façade of growing towns of equal density, all resident.

Towns consist of whole façades of the paper's 587,923 points: 2, 17 and 170 of them hold 1.2, 10 and
100 million points. A generated town stays in the folder of --growth, as `town-N` beside
`town-N.truth.json`. The 100 million points take long to generate and are only measured with
--growth.
"""

import shutil
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from measurement.measured_archives import build
from measurement.query_poses import walk_at
from solidcloud.builder.synthetic.scenes import make_town
from solidcloud.builder.synthetic.town import POINTS_PER_FACADE
from solidcloud.builder.synthetic.truth import read_truth
from solidcloud.server.report.common.bench_results import Part
from solidcloud.server.report.common.machine import Clock, cores, say
from solidcloud.server.report.common.whole_scene import open_whole
from solidcloud.server.scene import Scene

from .bench_context import Bench
from .compared_sides import COLLIDE, OURS, Contender, time_in_turn, timer

FACADES = (2, 17, 170)
DEFAULT_FACADES = FACADES[:2]
MAX_GROWTH = 1.3
CASE = "growth"


def town(folder: Path, facades: int) -> tuple[Path, Path]:
    """Return the archive of a town of this many façades and its truth; generate it where it is missing."""
    points = facades * POINTS_PER_FACADE
    archive, truth = folder / f"town-{points}", folder / f"town-{points}.truth.json"
    if not (archive / "index.h5").exists() or not truth.exists():
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix="scans-", dir=folder) as scratch, cores(None):
            say(f"making a town of {facades} façades, {points:,} points")
            made = make_town(Path(scratch) / "town", points=points, progress=_tenths())
            built = build(Path(scratch) / "town", Path(scratch) / "archive")
            shutil.rmtree(archive, ignore_errors=True)
            built.rename(archive)
            made.truth.rename(truth)
    return archive, truth


def _tenths() -> Callable[[int, int], None]:
    """Return a progress callback that reports every tenth."""
    said = 0

    def progress(done: int, of: int) -> None:
        nonlocal said
        if 10 * done // of > said:
            said = 10 * done // of
            say(f"  {done:,} of {of:,} points made")

    return progress


def run(bench: Bench, clock: Clock) -> Part:
    """Time the walk in each town, in turn."""
    part = Part("growth")
    given: Path | None = bench.options.growth
    sizes = FACADES if given else DEFAULT_FACADES
    folder = given or bench.folder / "growth"
    with ExitStack() as stack:
        contenders, walk = [], None
        for facades in sizes:
            archive, truth = town(folder, facades)
            if walk is None:
                walk = walk_at(read_truth(truth).facades[0], 30.0)
            scene = stack.enter_context(open_whole(archive))
            with scene.residency.hold(range(scene.info().voxels)):
                pass
            scene.add_avatar("avatar", bench.avatar)
            name = f"{scene.info().points:,} points"
            contenders.append(
                Contender(name, timer(lambda poses, scene=scene: scene.collide("avatar", poses)))
            )
            _describe(part, scene, name, walk)
        assert walk is not None
        clock.restart()
        times = time_in_turn(contenders, walk, max(bench.loops, 3), clock, bench.rng, 0.9)
    for name, spent in times.items():
        part.add(name, OURS, COLLIDE, spent, "µs", len(walk))
    first, *others = [float(np.median(spent)) for spent in times.values()]
    whole = len(sizes) == len(FACADES)
    part.remarks.append("each town has the radius of its own mean closest-point distance, as the default is")
    part.goal(
        "growth", "collide, 10⁸ points / 10⁶ points", others[-1] / first if whole else None, MAX_GROWTH, "x"
    )
    if not whole:
        part.goal("growth", "collide, 10⁷ points / 10⁶ points", others[-1] / first, MAX_GROWTH, "x")
        part.missing.append("10⁸ points: give --growth FOLDER, where the archives are, or stay once made")
    return part


def _describe(part: Part, scene: Scene, name: str, walk: np.ndarray) -> None:
    """Add the work of the walk in this town, which shows that the density is equal."""
    info = scene.info()
    answers = scene.collide("avatar", walk)
    part.add(name, OURS, "voxels, all resident", float(info.voxels), "")
    part.add(name, OURS, "radius of the points", info.radius * 1e3, "mm")
    part.add(name, OURS, "colliding poses", float((answers.verdict == 1).sum()), "", len(walk))
    part.add(name, OURS, "node visits a pose", float(answers.node_visits.mean()), "")
    part.add(name, OURS, "point tests a pose", float(answers.point_tests.mean()), "")
