"""Repetition of [Fig12] section 7: time of a collision test along the walk, for each degree.

Produces table 1, figure 7 and figure 8 of the paper on a generated scene instead of the Batalha
scan. CAVEATS lists the other differences.
"""

import contextlib
import csv
import gc
import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from ....builder.config import BuildConfig
from ....builder.pipeline import build_archive
from ....schemas.errors import InternalError, SolidcloudError
from ....schemas.wire.answers import Verdict
from ...scene import Scene
from ..common.paper_case import Case
from ..common.sphere_pictures import draw_spheres, level_spheres, load_pyplot
from ..common.whole_scene import open_whole
from .cell_comparison import AVATAR, WALK_DIVISIONS, Say, cell_row, compare_cells, show_cells, write_cells
from .paper_figures import PAPER_FPS, PAPER_MACHINE, paper_rows
from .path_figure import Curve, draw_path

DEGREES = (4, 6, 8, 10, 12, 14, 16)
FRAME_RATE = 30.0
# Untimed calls before the timed ones: the first few calls after other work took several times as
# long.
WARM_FRAMES = 30
# Degrees within this factor of the best count as equal: times of three runs differed by up to 4 %.
NEAR = 1.05

SLAB, PLAIN = "ours", "plain spheres"
NOBODY = "nobody"
# Height of the avatar NOBODY above every scan [m]: a call for it tests no voxel.
FAR_AWAY = 1e5

# Limits of the comparison with the paper, printed with every report.
CAVEATS = (
    "Nothing is rendered here: a frame of the 30 fps loop takes 1/30 s, or its test if that is longer.",
    "The degree is that of the scene's trees; the avatar's tree always has degree 8.",
    "Plain spheres are the paper's bounds in our trees: packed top-down instead of by insertion, with up to 32 points "
    "per leaf node, and in the same memory layout, which reserves the space of a slab.",
)


@dataclass
class Structure:
    """One hierarchy with its measurements.

    kind: SLAB, nodes are spheres cut by slabs, or PLAIN, the paper's spheres.  folder: of its
    archive.
    frames: (loops, k) [s], one call per frame.  loops: (loops,) [s], all frames in one call.
    verdict: (k,) uint8.  node_visits, point_tests: mean per pose.
    resident_bytes: of all decoded voxels.  archive_bytes: of the archive's files.
    """

    kind: str
    degree: int
    folder: Path
    frames: NDArray[np.float64]
    loops: NDArray[np.float64]
    verdict: NDArray[np.uint8]
    node_visits: float = 0.0
    point_tests: float = 0.0
    points: int = 0
    voxels: int = 0
    resident_bytes: int = 0
    archive_bytes: int = 0

    @property
    def frame_median(self) -> NDArray[np.float64]:
        """Return the time of each frame (k,) [s]: the median of the loops."""
        return np.median(self.frames, axis=0)


def build_structures(case: Case, degrees: tuple[int, ...], folder: Path, say: Say) -> list[Structure]:
    """Build one archive per degree and kind of node, in `folder`."""
    found = []
    k = len(case.poses)
    for degree in degrees:
        for kind in (SLAB, PLAIN):
            say(f"building degree {degree}, {kind}")
            target = folder / f"{kind.replace(' ', '-')}-{degree}"
            config = BuildConfig(
                degree=degree, with_slab=kind == SLAB, voxel=case.voxel, resolution=case.step, overwrite=True
            )
            build_archive(case.scans, target, config)
            found.append(
                Structure(kind, degree, target, np.empty((0, k)), np.empty(0), np.empty(0, np.uint8))
            )
    return found


# --- measuring ---


def time_frames(scene: Scene, avatar: str, poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the time of each frame (k,) [s], with one call per frame."""
    spent = np.empty(len(poses))
    singles = [np.ascontiguousarray(pose[None]) for pose in poses]
    for pose in singles[:WARM_FRAMES]:
        scene.collide(avatar, pose)
    for i, pose in enumerate(singles):
        begin = time.perf_counter()
        scene.collide(avatar, pose)
        spent[i] = time.perf_counter() - begin
    return spent


def measure(case: Case, structures: list[Structure], loops: int, say: Say) -> NDArray[np.float64]:
    """Time every structure with warm caches, all structures in turn in each loop.

    The order spreads disturbances by other work over all structures.
    Returns the time of each frame without a collision test (k,) [s]: the same call, with an avatar
    that no voxel is near.
    Raises InternalError if two structures answer differently, SolidcloudError if poses are unknown.
    """
    with contextlib.ExitStack() as stack:
        scenes = [stack.enter_context(open_whole(s.folder)) for s in structures]
        for structure, scene in zip(structures, scenes, strict=True):
            _first_answers(case, structure, scene)
        check_verdicts(structures)
        without = []
        scenes[0].add_avatar(NOBODY, [[0.0, 0.0, FAR_AWAY]], 0.0)
        frames: list[list[NDArray[np.float64]]] = [[] for _ in structures]
        batches: list[list[float]] = [[] for _ in structures]
        gc.collect()
        for loop in range(loops):
            say(f"walking, loop {loop + 1} of {loops}")
            without.append(time_frames(scenes[0], NOBODY, case.poses))
            for i, scene in enumerate(scenes):
                # The previous structure has changed the contents of the processor's caches: one
                # untimed call.
                scene.collide(AVATAR, case.poses)
                begin = time.perf_counter()
                scene.collide(AVATAR, case.poses)
                batches[i].append(time.perf_counter() - begin)
                frames[i].append(time_frames(scene, AVATAR, case.poses))
        for i, structure in enumerate(structures):
            structure.frames, structure.loops = np.array(frames[i]), np.array(batches[i])
    return np.median(np.array(without), axis=0)


def _first_answers(case: Case, structure: Structure, scene: Scene) -> None:
    """Fill in the answers and sizes of one structure; load every voxel of the walk."""
    scene.add_avatar(AVATAR, case.avatar)
    answers = scene.collide(AVATAR, case.poses)
    if (answers.verdict == Verdict.UNKNOWN).any() or answers.faults:
        raise SolidcloudError(
            f"{structure.folder}: {int((answers.verdict == Verdict.UNKNOWN).sum())} poses are unknown "
            f"{list(answers.faults)}, expected none: check the scans"
        )
    info = scene.info()
    structure.verdict = answers.verdict
    structure.node_visits = float(answers.node_visits.mean())
    structure.point_tests = float(answers.point_tests.mean())
    structure.points, structure.voxels = info.points, info.voxels
    structure.resident_bytes = info.resident_bytes
    structure.archive_bytes = sum(f.stat().st_size for f in structure.folder.rglob("*") if f.is_file())


def check_verdicts(structures: list[Structure]) -> None:
    """Raise InternalError if verdicts differ: no degree or kind of node may change an answer."""
    first = structures[0]
    for other in structures[1:]:
        differing = np.flatnonzero(first.verdict != other.verdict)
        if len(differing):
            raise InternalError(
                f"degree {other.degree}, {other.kind}: {len(differing)} verdicts differ from degree {first.degree}, "
                f"{first.kind}, the first at pose {differing[0]}; expected none: this is a bug of this software, "
                "report it"
            )


# --- the report ---


def loop_fps(seconds: NDArray[np.float64], rate: float = FRAME_RATE) -> float:
    """Return the mean frames per second of the paper's loop: a frame takes 1/rate, or its test."""
    return len(seconds) / float(np.maximum(seconds, 1 / rate).sum())


def table_row(structure: Structure) -> dict[str, Any]:
    """Return one row of table 1.

    frame_ms: one call per frame; mean over frames of the loops' median, in frame_ms_best of their
    minimum.
    batch_ms: all frames in one call, per frame; median of the loops, in batch_ms_best their
    minimum.
    """
    s, k = structure, structure.frames.shape[1]
    frame = s.frame_median
    return {
        "degree": s.degree,
        "structure": s.kind,
        "frame_ms": float(frame.mean()) * 1e3,
        "frame_ms_best": float(s.frames.min(axis=0).mean()) * 1e3,
        "slowest_frame_ms": float(frame.max()) * 1e3,
        "batch_ms": float(np.median(s.loops)) / k * 1e3,
        "batch_ms_best": float(s.loops.min()) / k * 1e3,
        "fps_30_loop": loop_fps(frame),
        "tests_per_second": 1 / float(frame.mean()),
        "tests_per_second_batch": k / float(np.median(s.loops)),
        "resident_mb": s.resident_bytes / 1e6,
        "resident_bytes_per_point": s.resident_bytes / s.points,
        "archive_bytes": s.archive_bytes,
        "archive_bytes_per_point": s.archive_bytes / s.points,
        "node_visits": s.node_visits,
        "point_tests": s.point_tests,
    }


def compare(rows: list[dict[str, Any]], structures: list[Structure]) -> list[str]:
    """Compare the measurements with the paper, in sentences."""
    said = [
        f"All {len(structures)} structures give the same {len(structures[0].verdict)} verdicts, "
        f"{int((structures[0].verdict == Verdict.CONTACT).sum())} of them contact.",
        "The paper: best at degree 10, 21.25 fps; worst at degree 12, 15.40 fps: a factor of 1.38, without a trend "
        "over degrees 4 to 16. Its frames include rendering; ours do not.",
    ]
    for kind in (SLAB, PLAIN):
        own = [row for row in rows if row["structure"] == kind]
        best, worst = (pick(own, key=lambda row: row["batch_ms_best"]) for pick in (min, max))
        near = [str(r["degree"]) for r in own if r["batch_ms_best"] <= NEAR * best["batch_ms_best"]]
        said.append(
            f"{kind.capitalize()}: best at degree {best['degree']}, {best['batch_ms_best'] * 1e3:.1f} us per test, "
            f"worst at degree {worst['degree']}, {worst['batch_ms_best'] * 1e3:.1f} us (all frames in one call, best "
            f"loop): a factor of {worst['batch_ms_best'] / best['batch_ms_best']:.2f}. Within {NEAR - 1:.0%} of the "
            f"best: degree {', '.join(near)}."
        )
    frame = max(row["slowest_frame_ms"] for row in rows)
    said.append(
        f"The slowest frame of all takes {frame:.3f} ms: "
        + ("no test slows the 30 fps loop." if frame < 1e3 / FRAME_RATE else "it slows the 30 fps loop.")
    )
    return said


def make_report(case: Case, structures: list[Structure], without: NDArray[np.float64]) -> dict[str, Any]:
    """Return the content of walkthrough.json: the case, table 1 and the sentences."""
    rows = [table_row(s) for s in structures]
    first = structures[0]
    return {
        "case": {
            "name": case.name,
            "points": first.points,
            "voxels": first.voxels,
            "voxel_size": case.voxel,
            "lattice_step": case.step,
            "avatar_points": len(case.avatar),
            "poses": len(case.poses),
            "contacts": int((first.verdict == Verdict.CONTACT).sum()),
            "loops": len(first.loops),
        },
        "paper_machine": PAPER_MACHINE,
        "caveats": list(CAVEATS),
        "verdicts_equal": True,  # otherwise measure() raises
        "table1": rows,
        "table1_paper": paper_rows(tuple(dict.fromkeys(s.degree for s in structures))),
        "comparison": compare(rows, structures),
        "without_collision_ms": float(without.mean()) * 1e3,
    }


def write_report(
    report: dict[str, Any], case: Case, structures: list[Structure], without: NDArray[np.float64], out: Path
) -> None:
    """Write walkthrough.json, table1.csv (the paper's rows last) and figure7.csv (median times)."""
    (out / "walkthrough.json").write_text(json.dumps(report, indent=1) + "\n")
    with open(out / "table1.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, list(report["table1"][0]))
        writer.writeheader()
        writer.writerows(report["table1"] + report["table1_paper"])
    names = ["t_s", "verdict", "without_collision_ms", *(f"{s.kind} {s.degree} ms" for s in structures)]
    columns = [without, *(s.frame_median for s in structures)]
    with open(out / "figure7.csv", "w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(names)
        for i, t in enumerate(case.times):
            verdict = Verdict(int(structures[0].verdict[i])).name.lower()
            rows.writerow([f"{t:.6g}", verdict, *(f"{column[i] * 1e3:.6f}" for column in columns)])


def draw_report(
    case: Case, structures: list[Structure], without: NDArray[np.float64], level: int, out: Path
) -> dict[str, Any]:
    """Draw figure7.png and figure8.png; return the numbers that figure 8 shows."""
    curves = {
        kind: [Curve(s.degree, s.frame_median) for s in structures if s.kind == kind]
        for kind in (SLAB, PLAIN)
    }
    contact = structures[0].verdict == Verdict.CONTACT
    draw_path(case.times, curves, without, contact, PAPER_FPS, out / "figure7.png")
    # The lowest degree has the deepest trees: most of its partitions reach the level.
    chosen = min((s for s in structures if s.kind == PLAIN), key=lambda s: s.degree)
    spheres = level_spheres(chosen.folder, level)
    partitions, ended = int(spheres.partition.max()) + 1, int(spheres.ended.sum())
    title = (
        f"Bounding spheres of level {level} in each of the {partitions} partitions, degree {chosen.degree}: "
        f"{len(spheres.radius)} spheres\n(one colour per partition; {ended} are leaf nodes of trees that end earlier)"
    )
    draw_spheres(spheres, title, out / "figure8.png")
    return {
        "level": level,
        "degree": chosen.degree,
        "partitions": partitions,
        "spheres": len(spheres.radius),
        "leaf_nodes_of_lower_trees": ended,
        "mean_radius_m": float(spheres.radius.mean()),
    }


def show(report: dict[str, Any], console: Console) -> None:
    """Print table 1, the sentences and the table of cells."""
    case = report["case"]
    title = (
        f"{case['name']}: {case['points']} points in {case['voxels']} voxel(s) of {case['voxel_size']:g} m, avatar of "
        f"{case['avatar_points']} points, {case['poses']} poses"
    )
    heads = {
        "degree": "degree", "structure": "structure", "fps_30_loop": "fps, 30 fps loop", "frame_ms": "ms per frame",
        "frame_ms_best": "best", "slowest_frame_ms": "slowest", "tests_per_second": "tests/s",
        "batch_ms": "ms, one call for all", "batch_ms_best": "best", "tests_per_second_batch": "tests/s",
        "resident_mb": "MB", "resident_bytes_per_point": "bytes per point", "archive_bytes": "archive bytes",
        "archive_bytes_per_point": "bytes per point",
    }  # fmt: skip
    table = Table(title=title)
    for head in heads.values():
        table.add_column(head, justify="right", no_wrap=head == "structure")
    order = (SLAB, PLAIN, "paper")
    for row in sorted(report["table1"] + report["table1_paper"], key=lambda r: order.index(r["structure"])):
        table.add_row(*(_cell(name, row.get(name)) for name in heads))
    console.print(table)
    console.print(f"The paper's rows: {report['paper_machine']}.")
    console.print(
        "Columns 'ms per frame' and 'slowest': one call per frame, median of the loops. Without a "
        f"collision test (an avatar far away) a call takes {report['without_collision_ms']:.4f} ms. "
        "Columns 'ms, one call for all': all frames in one call, per frame."
    )
    for sentence in report["caveats"] + report["comparison"]:
        console.print(sentence)
    show_cells(report["cells"], console)


def _cell(name: str, value: Any) -> str:
    """Format a value of the table."""
    if value is None or isinstance(value, str):
        return value or "-"
    if name.startswith("tests") or isinstance(value, int):
        return f"{value:,.0f}"
    return f"{value:.4f}" if "_ms" in name else f"{value:.2f}"


def run(
    make: Callable[[Path], Case],
    out: Path,
    scratch: Path,
    *,
    degrees: tuple[int, ...],
    loops: int,
    level: int,
    say: Say,
) -> dict[str, Any]:
    """Run the whole experiment: make(scratch) the case, build, walk, write everything into `out`.

    Returns the report.
    scratch: a folder for scans and archives, which the caller removes.
    """
    load_pyplot()  # fails now if matplotlib is missing, not after minutes of measuring
    out.mkdir(parents=True, exist_ok=True)
    say("making the case")
    case = make(scratch)
    structures = build_structures(case, degrees, scratch, say)
    without = measure(case, structures, loops, say)
    report = make_report(case, structures, without)
    report["cells"] = [cell_row(plan) for plan in compare_cells(case, scratch, loops, say, WALK_DIVISIONS)]
    write_cells(report["cells"], out / "cells.csv")
    say("drawing")
    report["figure8"] = draw_report(case, structures, without, level, out)
    write_report(report, case, structures, without, out)
    return report
