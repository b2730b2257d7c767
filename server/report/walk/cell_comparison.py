"""Comparison of cells of one height ([Fig12] section 8) with the octree of section 4.

The walk is timed with each kind of cells (see builder/voxel/balance_cells.py) in turn. The verdicts
must be equal.
"""

import contextlib
import gc
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ....builder.config import BuildConfig
from ....builder.pipeline import build_archive
from ....schemas.archive.archive import Archive
from ....schemas.archive.voxel import Links, VoxelData
from ....schemas.errors import InternalError, SolidcloudError
from ....schemas.wire.answers import Verdict
from ..common.paper_case import Case
from ..common.whole_scene import open_whole
from .walkthrough import AVATAR, Say

# Kind of cells and maximum number of points of a cell: octrees with several limits (some of which
# make most trees one height by splitting alone), and balanced cells.
PLANS = (
    ("octree", 4096),
    ("octree", 2048),
    ("octree", 1024),
    ("octree", 256),
    ("balanced", 2048),
    ("balanced", 1024),
)


@dataclass
class CellPlan:
    """One way to divide voxels into cells, with its measurements.

    kind, cell_points: of BuildConfig.  heights: number of levels of a cell's tree -> number of
    cells.
    build_seconds: the least of the builds.  loops: (loops,) [s], all poses in one call.
    node_visits, point_tests: mean per pose.
    """

    kind: str
    cell_points: int
    folder: Path
    heights: dict[int, int] = field(default_factory=dict)
    build_seconds: float = 0.0
    bytes_a_point: float = 0.0
    resident_bytes_a_point: float = 0.0
    loops: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    verdict: NDArray[np.uint8] = field(default_factory=lambda: np.empty(0, np.uint8))
    node_visits: float = 0.0
    point_tests: float = 0.0

    @property
    def name(self) -> str:
        """Return the name for tables."""
        return f"{self.kind}, {self.cell_points} points"


def compare_cells(case: Case, folder: Path, loops: int, say: Say) -> list[CellPlan]:
    """Build `case` with each plan, in `folder`, and time its walk.

    Measures the CPU time of this thread with warm caches, all plans in turn in each loop.
    Raises InternalError if two plans answer differently, SolidcloudError if a pose is unknown.
    """
    plans = [CellPlan(kind, most, folder / f"{kind}-{most}") for kind, most in PLANS]
    for plan in plans:
        say(f"building cells: {plan.name}")
        _build(case, plan)
    with contextlib.ExitStack() as stack:
        scenes = [stack.enter_context(open_whole(plan.folder)) for plan in plans]
        for plan, scene in zip(plans, scenes, strict=True):
            scene.add_avatar(AVATAR, case.avatar)
            answers = scene.collide(AVATAR, case.poses)
            if (answers.verdict == Verdict.UNKNOWN).any():
                raise SolidcloudError(f"{plan.folder}: poses are unknown, expected none: check the scans")
            if len(plans[0].verdict) and (answers.verdict != plans[0].verdict).any():
                raise InternalError(f"cells {plan.name}: verdicts differ from {plans[0].name}; report it")
            plan.verdict = answers.verdict
            plan.node_visits = float(answers.node_visits.mean())
            plan.point_tests = float(answers.point_tests.mean())
            info = scene.info()
            plan.resident_bytes_a_point = info.resident_bytes / info.points
        gc.collect()
        spent = np.empty((len(plans), loops))
        for loop in range(loops):
            say(f"walking, loop {loop + 1} of {loops}")
            for i, scene in enumerate(scenes):
                scene.collide(
                    AVATAR, case.poses
                )  # untimed: the previous plan has changed the contents of the caches
                begin = time.thread_time()
                scene.collide(AVATAR, case.poses)
                spent[i, loop] = time.thread_time() - begin
    for plan, row in zip(plans, spent, strict=True):
        plan.loops = row
    return plans


def _build(case: Case, plan: CellPlan) -> None:
    """Build one archive twice, because the first build compiles, and fill in its properties."""
    config = BuildConfig(
        voxel=case.voxel,
        resolution=case.step,
        cells=plan.kind,
        cell_points=plan.cell_points,
        jobs=1,
        overwrite=True,
    )
    summaries = [build_archive(case.scans, plan.folder, config) for _ in range(2)]
    plan.build_seconds = min(s.stages["build"] for s in summaries)
    plan.bytes_a_point = summaries[0].bytes / summaries[0].points
    heights: Counter[int] = Counter()
    with Archive(plan.folder) as archive:
        for row in range(len(archive.voxels)):
            heights.update(tree_heights(*archive.read_voxel(row)))
    plan.heights = dict(sorted(heights.items()))


def tree_heights(voxel: VoxelData, links: Links) -> list[int]:
    """Return the number of levels of every cell's tree, in the order of the cells."""
    root = len(voxel.nodes.count) - int(voxel.cells.nodes.sum(dtype=np.int64))
    heights = []
    for node in range(root, root + len(voxel.cells.nodes)):
        levels = 1
        while not links.is_leaf[node]:
            node, levels = links.first[node], levels + 1
        heights.append(levels)
    return heights
