"""Demonstration: build a scan, serve it, walk through it; write walk.json and walk.png.

    python -m solidcloud.server.report.walk.demo_walk OUT [SCAN...] [--realtime]

Without scans a façade is generated, and the walk is that of [Fig12] section 3: 40 s, 1,200 poses of
a figure of 3,617 points. `scripts/demo` runs this module.
"""

import argparse
import json
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ....builder.config import BuildConfig
from ....builder.pipeline import build_archive
from ....builder.synthetic.figure import figure_points, write_figure
from ....schemas.errors import SolidcloudError
from ....schemas.runtime.own_command import own_command, shown_path
from ....schemas.wire.answers import CollideAnswers, Verdict
from ....schemas.wire.scene_messages import SceneInfo
from ...cli.input.pose_file import write_poses
from ...cli.output.compile_notice import compile_notices
from ...cli.output.console import bytes_text, print_build, print_facts
from ...cli.output.progress_display import progress_listener
from ...client import Client
from ..common.floor_walk import floor_walk
from ..common.thinned_points import read_thinned
from .server_process import served
from .walk_answers import Walk, WalkAnswers

# Number of points read again from the scans, for the picture and to detect a floor in scans without
# ground truth.
PICTURE_POINTS = 600_000


def main() -> None:
    """Run the demonstration and exit with the exit codes of `solidcloud`."""
    parser = argparse.ArgumentParser(
        prog="scripts/demo", description="Build a scan, serve it, walk through it."
    )
    parser.add_argument("out", type=Path, help=argparse.SUPPRESS)
    parser.add_argument(
        "scans", nargs="*", type=Path, metavar="SCAN", help="scans; default: a generated façade"
    )
    parser.add_argument(
        "--realtime", action="store_true", help="30 frames per second instead of as fast as possible"
    )
    chosen = parser.parse_args()
    # Like Ctrl-C: leave every `with` block, which stops the server.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        demonstrate(chosen.out, chosen.scans, realtime=chosen.realtime)
    except SolidcloudError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        print("error: interrupted", file=sys.stderr)
        sys.exit(130)


def demonstrate(out: Path, scans: Sequence[Path] = (), *, realtime: bool = False) -> dict[str, Any]:
    """Build, serve and walk; write walk.json and walk.png into the folder `out`.

    Returns the content of walk.json.
    scans: of a place with z up [m]; empty: a façade is generated.  realtime: one frame every 1/30
    s.
    """
    out.mkdir(parents=True, exist_ok=True)
    facade = None if scans else make_scan(out)
    scans = scans or [out / "facade.laz"]
    with progress_listener() as bars, compile_notices():
        summary = build_archive(scans, out / "archive", BuildConfig(overwrite=True), bars)
    print_build(summary)
    walk = _facade_walk(scans, facade, summary.points) if facade else _scan_walk(scans, summary.points)
    print(f"walking {walk.path}")
    avatar = figure_points()
    with served(summary.archive, "demo") as endpoint, Client(endpoint, scene="demo") as client:
        info = client.info()
        client.add_avatar("figure", avatar)
        frames = take_walk(client, walk, realtime=realtime)
    report = make_report(walk, frames, info, len(avatar))
    _print_summary(report["summary"])
    (out / "walk.json").write_text(json.dumps(report, indent=1) + "\n")
    # Imported here because matplotlib takes a second to load.
    from .walk_picture import draw_walk

    draw_walk(out / "walk.png", walk, frames, avatar)
    print(f"wrote {out / 'walk.json'} and {out / 'walk.png'}; the archive is {summary.archive}")
    _print_commands(out, summary.archive, avatar, walk)
    return report


def make_scan(out: Path) -> Path:
    """Generate the façade's scan in the folder `out`; return the path of its ground truth."""
    from ....builder.synthetic.scenes import make_facade

    with progress_listener() as bars:
        return make_facade(out / "facade.laz", progress=bars.made).truth


def take_walk(client: Client, walk: Walk, *, realtime: bool) -> WalkAnswers:
    """Query one pose after another, as a viewer does for each of its frames.

    There is no progress bar: its thread would hold the interpreter for milliseconds, which would
    count as round-trip time.
    """
    answers: list[CollideAnswers] = []
    round_trip = np.empty(len(walk.poses))
    begin = time.perf_counter()
    for k in range(len(walk.poses)):
        if realtime:
            time.sleep(max(0.0, begin + walk.times[k] - time.perf_counter()))
        asked = time.perf_counter()
        answers.append(client.collide("figure", walk.poses[k : k + 1]))
        round_trip[k] = time.perf_counter() - asked
    return WalkAnswers(
        np.concatenate([answer.verdict for answer in answers]),
        np.array([answer.engine_seconds for answer in answers]),
        round_trip,
        np.array([answer.resident for answer in answers]),
        np.array([answer.resident_bytes for answer in answers]),
        np.array([answer.hits for answer in answers]),
        np.array([answer.misses for answer in answers]),
    )


def make_report(walk: Walk, frames: WalkAnswers, info: SceneInfo, avatar_points: int) -> dict[str, Any]:
    """Return the content of walk.json: a summary and each frame. Time names end in their unit."""
    names = [verdict.name.lower() for verdict in Verdict]
    summary = {
        "path": walk.path,
        "points": info.points,
        "voxels": info.voxels,
        "avatar_points": avatar_points,
        "radius_m": info.radius,
        "frames": len(frames.verdict),
        **{
            name: int((frames.verdict == verdict).sum()) for name, verdict in zip(names, Verdict, strict=True)
        },
        "engine_us": _spread(frames.engine * 1e6),
        "round_trip_us": _spread(frames.round_trip * 1e6),
        "resident_voxels": int(frames.resident.max()),
        "resident_bytes": int(frames.resident_bytes.max()),
        "hits": int(frames.hits.sum()),
        "misses": int(frames.misses.sum()),
    }
    rows = [
        {
            "t": round(float(walk.times[k]), 6),
            "verdict": names[int(frames.verdict[k])],
            "engine_us": round(float(frames.engine[k]) * 1e6, 3),
            "round_trip_us": round(float(frames.round_trip[k]) * 1e6, 3),
            "resident_voxels": int(frames.resident[k]),
            "hits": int(frames.hits[k]),
            "misses": int(frames.misses[k]),
        }
        for k in range(len(frames.verdict))
    ]
    return {"summary": summary, "frames": rows}


def _facade_walk(scans: Sequence[Path], truth: Path, points: int) -> Walk:
    """Return the walk through the generated façade."""
    from ....builder.synthetic.truth import read_truth
    from ....builder.synthetic.walk import walk_poses

    times, poses = walk_poses(read_truth(truth).facades[0])
    path = "along the walls, around the column and through the door of the façade"
    return Walk(times, poses, path, read_thinned(scans, points, PICTURE_POINTS), 0)


def _scan_walk(scans: Sequence[Path], points: int) -> Walk:
    """Return a straight walk through the given scans."""
    thinned = read_thinned(scans, points, PICTURE_POINTS)
    times, poses = floor_walk(thinned)
    along = int(np.argmax(np.ptp(poses[:, :2, 3], axis=0)))
    path = f"a straight line along {'xy'[along]} through the middle, over the lowest dense points, z up"
    return Walk(times, poses, path, thinned, along)


def _print_commands(out: Path, archive: Path, avatar: NDArray[np.float64], walk: Walk) -> None:
    """Write the avatar and the poses into `out`; print commands that serve and query the archive."""
    figure, poses = out / "figure.obj", out / "poses.csv"
    write_figure(figure, avatar)
    write_poses(poses, walk.times, walk.poses)
    print("to do this with your own programs, serve the archive, and query it in a second terminal:")
    print(f"  {own_command()} serve {shown_path(archive)} --name demo")
    print(f"  {own_command()} query --scene demo --avatar {shown_path(figure)} --poses {shown_path(poses)}")


def _spread(values: NDArray[np.float64]) -> dict[str, float]:
    """Return mean, median, 99th percentile and maximum."""
    p50, p99 = np.percentile(values, [50, 99])
    found = {"mean": values.mean(), "p50": p50, "p99": p99, "max": values.max()}
    return {name: round(float(value), 3) for name, value in found.items()}


def _print_summary(summary: dict[str, Any]) -> None:
    """Print the summary as a table."""

    def times(of: dict[str, float]) -> str:
        return ", ".join(f"{name} {value:,.0f}" for name, value in of.items()) + " µs"

    print_facts(
        [
            ("frames", f"{summary['frames']} of a figure of {summary['avatar_points']:,} points"),
            ("verdicts", ", ".join(f"{summary[v.name.lower()]} {v.name.lower()}" for v in Verdict)),
            ("engine", times(summary["engine_us"])),
            ("round trip", times(summary["round_trip_us"])),
            (
                "resident",
                f"{summary['resident_voxels']} voxels at most, {bytes_text(summary['resident_bytes'])}",
            ),
            ("loads", f"{summary['misses']} misses, {summary['hits']:,} hits"),
        ]
    )


if __name__ == "__main__":
    main()
