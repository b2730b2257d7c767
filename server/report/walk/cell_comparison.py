"""Comparison of cells of one height ([Fig12] section 8) with the octree of section 4.

The walk is timed with each kind of cells (see builder/voxel/balance_cells.py) in turn. The verdicts
must be equal.
"""

import contextlib
import csv
import gc
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from ....builder.config import DEFAULT_CELL_POINTS, BuildConfig
from ....builder.passes.cell_summary import summarize_cells
from ....builder.pipeline import build_archive
from ....schemas.archive.archive import Archive
from ....schemas.errors import InternalError, SolidcloudError
from ....schemas.wire.answers import Verdict
from ..common.paper_case import Case
from ..common.whole_scene import open_whole

Say = Callable[[str], None]
AVATAR = "avatar"


class Division(NamedTuple):
    """Way to divide voxels into cells: the options of a build.

    cell_points: most points of a cell; None: as many as give `leaf_cells` cells.
    """

    kind: str
    cell_points: int | None
    leaf_cells: int | None = None


# Octrees with several limits (some of which make most trees one height by splitting alone), and
# balanced cells.
DIVISIONS = (
    Division("octree", 4096),
    Division("octree", 2048),
    Division("octree", 1024),
    Division("octree", 256),
    Division("balanced", 2048),
    Division("balanced", 1024),
)
# Divisions of the walkthrough: the default, as many cells as the paper's octree has ([Fig12] section
# 7), and cells of one height (section 8) for both.
PAPER_CELLS = 4096
WALK_DIVISIONS = (
    Division("octree", 1024),
    Division("octree", None, PAPER_CELLS),
    Division("balanced", 1024),
    Division("balanced", None, PAPER_CELLS),
)


@dataclass
class CellPlan:
    """One way to divide voxels into cells, with its measurements.

    division: the options of the build.  cell_points: most points of a cell.
    heights: number of levels of a cell's tree -> number of cells.
    small: cells with too few points for a packed tree of the common height; 0 in an octree.
    build_seconds: the least of the builds.  loops: (loops,) [s], all poses in one call.
    node_visits, point_tests: mean per pose.
    """

    division: Division
    folder: Path
    cell_points: int = 0
    small: int = 0
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
        kind, points, cells = self.division
        return f"{kind}, {points} points" if cells is None else f"{kind}, {cells} cells"

    @property
    def cells(self) -> int:
        """Return the number of cells."""
        return sum(self.heights.values())

    @property
    def equal_heights(self) -> float:
        """Return the share of cells whose trees have the most frequent height."""
        return max(self.heights.values()) / self.cells


def compare_cells(
    case: Case, folder: Path, loops: int, say: Say, divisions: Sequence[Division] = DIVISIONS
) -> list[CellPlan]:
    """Build `case` with each plan, in `folder`, and time its walk.

    Measures the CPU time of this thread with warm caches, all plans in turn in each loop.
    Raises InternalError if two plans answer differently, SolidcloudError if a pose is unknown.
    """
    plans = [
        CellPlan(each, folder / f"{each.kind}-{each.cell_points}-{each.leaf_cells}") for each in divisions
    ]
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
        cells=plan.division.kind,
        cell_points=plan.division.cell_points or DEFAULT_CELL_POINTS,
        leaf_cells=plan.division.leaf_cells,
        jobs=1,
        overwrite=True,
    )
    summaries = [build_archive(case.scans, plan.folder, config) for _ in range(2)]
    plan.build_seconds = min(s.stages["build"] for s in summaries)
    plan.bytes_a_point = summaries[0].bytes / summaries[0].points
    with Archive(plan.folder) as archive:
        found = summarize_cells(archive, heights=True)
    plan.cell_points, plan.heights, plan.small = found.most, found.heights or {}, found.small or 0


def cell_row(plan: CellPlan) -> dict[str, Any]:
    """Return a row of the table of cells; `batch_ms`, `batch_ms_best` as in table 1 (walkthrough.py)."""
    poses = len(plan.verdict)
    return {
        "kind": plan.division.kind,
        "cells_asked": plan.division.leaf_cells,
        "cells": plan.cells,
        "cell_points": plan.cell_points,
        "levels": {str(levels): held for levels, held in plan.heights.items()},
        "equal_heights": plan.equal_heights,
        "too_small_for_the_height": plan.small,
        "batch_ms": float(np.median(plan.loops)) / poses * 1e3,
        "batch_ms_best": float(plan.loops.min()) / poses * 1e3,
        "node_visits": plan.node_visits,
        "point_tests": plan.point_tests,
        "archive_bytes_per_point": plan.bytes_a_point,
    }


def write_cells(rows: list[dict[str, Any]], path: Path) -> None:
    """Write the table of cells as CSV."""
    with open(path, "w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows({**row, "levels": _levels_text(row["levels"])} for row in rows)


def show_cells(rows: list[dict[str, Any]], console: Console) -> None:
    """Print the table of cells."""
    table = Table(
        title=f"Leaf cells of the octree; the paper's façade has {PAPER_CELLS:,} ([Fig12] section 7)"
    )
    for head in (
        "cells", "asked", "found", "points, at most", "trees", "equal heights", "too small", "ms, one call for all",
        "best", "node visits",
    ):  # fmt: skip
        table.add_column(head, justify="right")
    for row in rows:
        asked = row["cells_asked"]
        table.add_row(
            row["kind"], "-" if asked is None else f"{asked:,}", f"{row['cells']:,}", f"{row['cell_points']:,}",
            _levels_text(row["levels"]), f"{row['equal_heights']:.1%}", f"{row['too_small_for_the_height']:,}",
            f"{row['batch_ms']:.4f}", f"{row['batch_ms_best']:.4f}", f"{row['node_visits']:.1f}",
        )  # fmt: skip
    console.print(table)
    console.print(
        "Equal heights: share of cells whose trees have the most frequent number of levels. Too small: balanced cells "
        "with too few points for a packed tree of this height that could not be merged within their largest permitted "
        "cube; nodes of one child give their trees the height."
    )


def _levels_text(levels: dict[str, int]) -> str:
    """Format the numbers of trees by their levels."""
    return ", ".join(f"{held:,} of {number}" for number, held in levels.items())
