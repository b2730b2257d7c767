"""HTML page of the accuracy report: answer, choices, charts and tables, in one self-contained file."""

import base64
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

from .....schemas.runtime.new_file import new_file
from .....schemas.runtime.visible_text import visible
from ..measurement.accuracy_results import Report
from .accuracy_charts import length_name
from .accuracy_texts import answer, choices, findings, size_name

STYLE = """
body{font:16px/1.5 system-ui,sans-serif;color:#2f2a26;background:#fbfaf7;max-width:60rem}
body{margin:1.5rem auto;padding:0 1rem}
h1{font-size:1.6rem}h2{margin-top:2.2rem;border-top:1px solid #d9cfc1;padding-top:1rem;font-size:1.25rem}
p.answer{font-size:1.15rem;font-weight:600}
img{width:640px;max-width:100%;height:auto;background:#fff}p,li{max-width:48rem}figure{margin:1rem 0}
table{border-collapse:collapse;font-size:.9rem}
th,td{padding:.25rem .6rem;text-align:right;border-bottom:1px solid #e4ded4;vertical-align:top}
th:first-child,td:first-child{text-align:left}td.text{text-align:left}.warn{color:#a05a00}
@media (max-width:640px){thead{display:none}tr{display:block;padding:.5rem 0;border-bottom:2px solid #d9cfc1}
td,td:first-child{display:flex;justify-content:space-between;gap:1rem;text-align:right;border:0}
td:first-child{font-weight:600}td::before{content:attr(data-head);color:#8a8178;text-align:left;font-weight:400}}
"""

TERMS = {
    "pose": "a position and orientation of the avatar. Each pose is one query: does the avatar touch the "
    "scan there?",
    "time of a pose": "the median over calls of 600 to 1,200 poses of one class, divided by their number. "
    "All settings are called in turn, in two passes. Shades are 95 % intervals. An open mark did not "
    "repeat: the two passes differ by more than a tenth.",
    "early": "said to be in contact although exactly it is clear. The avatar is stopped before it touches.",
    "wrongly clear": "said to be clear although exactly it is in contact: the avatar could pass through. No "
    "setting of this software does so.",
    "level of detail": "one point of the scan for each leaf of its hierarchies, with bounds of all points "
    "below. It is a file of its own beside the archive, and answers while the archive's voxels are not in "
    "memory.",
}


def write_page(report: Report, charts: dict[str, Path], target: Path) -> None:
    """Write the page, completely or not at all. charts: as `draw_charts` returns them."""
    facts = report.facts
    body = [
        "<h1>What accuracy costs in time</h1>",
        f'<p class="answer">{escape(answer(report))}</p>',
        f"<p>{escape(facts['scene'])}; an avatar of {facts['avatar_points']:,} points; "
        f"{facts['judged_poses']:,} poses, {facts['judged_contacts']:,} of them in contact; "
        f"{escape(facts['processor'])}, one core.</p>",
        *(f'<p class="warn">{escape(said)}</p>' for said in facts["warnings"]),
        "<h2>Three settings</h2>",
        _table(
            (
                "setting",
                "how",
                "error",
                "a pose near the scan",
                "elsewhere",
                "wait, cold",
                "read, cold",
                "when",
            ),
            choices(report),
            texts=(1, 2, 7),
        ),
        _picture(charts["main"], "What an error allowed saves, in memory and with nothing in memory."),
        "<ul>" + "".join(f"<li>{escape(line)}</li>" for line in findings(report)[1:]) + "</ul>",
        *_memory(report, charts),
        *_cold(report, charts),
        *_walks(report, charts),
        *_radii(report, charts),
        *_frames(report, charts),
        "<h2>Terms</h2><dl>",
        *(f"<dt><b>{escape(term)}</b></dt><dd>{escape(said)}</dd>" for term, said in TERMS.items()),
        "</dl>",
    ]
    page = (
        '<!doctype html><html lang="en"><head><meta charset="utf-8"><meta name="viewport" '
        'content="width=device-width, initial-scale=1"><title>What accuracy costs in time</title>'
        f"<style>{STYLE}</style></head><body>{''.join(body)}</body></html>\n"
    )
    with new_file(target) as file:
        file.write(visible(page).encode())


def _memory(report: Report, charts: dict[str, Path]) -> list[str]:
    rows = [
        (
            row.question, row.kind, f"{100 * row.share:.0f} %", length_name(row.tolerance), f"{row.time_us:.2f}",
            f"{row.ratio:.2f}", f"{row.low:.2f} to {row.high:.2f}", "yes" if row.repeats else "no",
            f"{100 * row.early:.0f} %" if row.question == "collide" else "",
            "" if row.error_mm is None else f"{max(row.error_mm, 0.0):.1f}", f"{row.visits:,.0f}",
        )
        for row in report.memory
    ]  # fmt: skip
    heads = (
        "query", "poses", "share", "error allowed", "time [µs]", "of exact", "95 %", "repeats", "early",
        "largest error [mm]", "node visits",
    )  # fmt: skip
    fields = [
        (
            f"{row.cell * 100:g} cm", row.kind, f"{row.time_us:.1f}", f"{row.ratio:.1f}",
            f"{100 * row.false_clear:.1f} %",
            f"{100 * row.early:.1f} %", f"{100 * row.early_if_safe:.1f} %", size_name(row.scene_bytes),
            f"{row.seconds:.2f}",
        )
        for row in report.fields
    ]  # fmt: skip
    field_heads = (
        "cells", "poses", "time [µs]", "of exact", "wrongly clear", "early", "early if never wrongly clear",
        "whole scene", "made in [s]",
    )  # fmt: skip
    said = (
        "An error allowed ends the exact search at the first pair of points that is near enough, and "
        "changes nothing else. Where nothing is that near, it saves nothing."
    )
    about = (
        "A Euclidean distance field holds the distance to the nearest occupied cell for each cell of a "
        "grid. Robots ask it at each point of their body. Its error is up to one diagonal of a cell."
    )
    found = [
        "<h2>1. In memory</h2>", f"<p>{said}</p>", _picture(charts["memory"], "Time of collide by class of "
        "poses."),
        _picture(charts["distance"], "Time of distance by class of poses."),
    ]  # fmt: skip
    if fields:
        found += [f"<p>{about}</p>", _table(field_heads, fields)]
    return [*found, _details("All settings", _table(heads, rows))]


def _cold(report: Report, charts: dict[str, Path]) -> list[str]:
    rows = [
        (
            "exact, no level" if row.tolerance is None else length_name(row.tolerance), f"{row.wait_ms:.2f}",
            f"{row.wait:.3f} ({row.wait_low:.3f} to {row.wait_high:.3f})",
            "" if row.read_bytes is None else f"{row.read_bytes / 1e3:,.0f}",
            "" if row.bytes_ratio is None else f"{row.bytes_ratio:.3f} ({row.bytes_low:.3f} to "
            f"{row.bytes_high:.3f})",
            f"{100 * row.loaded:.0f} %",
        )
        for row in report.cold
    ]  # fmt: skip
    heads = ("error allowed", "wait [ms]", "of exact", "read [kB]", "of exact", "poses that needed a voxel")
    return [
        "<h2>2. With nothing in memory</h2>",
        "<p>Each question is asked of a scene that was opened just before, with the system's cache of its "
        "files dropped. The level of detail is asked first. Only where it cannot decide within the error "
        "allowed are voxels read.</p>",
        _picture(
            charts["cold"], "Wait and bytes read of one pose, relative to the exact answer without the level."
        ),
        _table(heads, rows),
    ]


def _walks(report: Report, charts: dict[str, Path]) -> list[str]:
    rows = [
        (row.kind, f"{row.memory:g}", size_name(row.memory_bytes), row.note, "", "", "", "", "")
        if row.note
        else (
            row.kind, f"{row.memory:g}", size_name(row.memory_bytes), f"{row.stalls} of {row.frames}",
            f"{row.longest_ms:.1f}", f"{row.median_ms:.2f}",
            "" if row.read_bytes is None else size_name(row.read_bytes), f"{100 * row.early:.0f} %",
            str(row.false_clear),
        )
        for row in report.walks
    ]  # fmt: skip
    heads = (
        "answers", "scene in memory", "bytes", "frames over 33 ms", "longest [ms]", "median [ms]", "read",
        "clear, not said clear", "wrongly clear",
    )  # fmt: skip
    return [
        "<h2>3. A walk with little memory</h2>",
        "<p>At 5 m/s, 30 frames a second. Exact answers wait until the voxels in reach are loaded. By "
        "bounds, only the level of detail is in memory, and motion stops where it cannot prove a pose "
        "clear.</p>",
        _picture(charts["walks"], "Stalls, early stops and bytes of the walk.") if "walks" in charts else "",
        _table(heads, rows),
    ]


def _radii(report: Report, charts: dict[str, Path]) -> list[str]:
    if not report.radii:
        return []

    def door(value: float | None) -> str:
        return "" if value is None else "does not pass" if value == float("inf") else f"{value:.0f}"

    rows = [
        (
            row.scene, row.setting, f"{100 * row.passed:.2f} %", f"{row.leak_p50_mm:.1f}", f"{row.leak_p99_mm:.1f}",
            door(row.doorway_mm), door(row.made_doorway_mm), "" if row.time_us is None else f"{row.time_us:.2f}",
        )
        for row in report.radii
    ]  # fmt: skip
    heads = (
        "scene", "radius model", "ball passes through", "leak p50 [mm]", "leak p99 [mm]", "door [mm]",
        "door, generated [mm]", "time [µs]",
    )  # fmt: skip
    return [
        "<h2>4. Radius models</h2>",
        "<p>Each point is a sphere. Larger spheres close holes in walls, and make doors narrower. The ball "
        "has a radius of 5 cm, and is pushed into walls of a generated façade where the truth is known. "
        "The leak is how far it enters: negative if it is stopped before the wall, 100 mm if it passes "
        "through. The door's figure is the extra width that the avatar needs. Radius models are one mean "
        "for all points, one that follows the spacing around each point (local), smaller ones on the rims "
        "of surfaces (border), or a fixed radius; a number after a colon is a factor.</p>",
        _picture(charts["radii"], "Doorway error against leak; a line joins the factors of a radius model."),
        _table(heads, rows),
    ]


def _frames(report: Report, charts: dict[str, Path]) -> list[str]:
    rows = [
        (
            length_name(row.tolerance), f"{row.time_us:.0f}", f"{row.p99_us:.0f}",
            f"{row.ratio:.2f} ({row.low:.2f} to {row.high:.2f})", "yes" if row.repeats else "no",
            f"{row.way:.1f}",
            f"{row.apart_mm:.2g}",
        )
        for row in report.frames
    ]  # fmt: skip
    heads = (
        "tolerance of sweep", "frame [µs]", "p99 [µs]", "of the first", "repeats", "way [m]", "largest "
        "difference [mm]",
    )  # fmt: skip
    return [
        "<h2>5. Frames</h2>",
        "<p>A walk at 1.4 m/s with the effects stop, sweep, slide, step and ground. The tolerance of sweep "
        "says how far the avatar may be stopped before it touches. The largest difference is that of a "
        "single frame from the same pose.</p>",
        _picture(charts["frames"], "Time of a frame against the tolerance of the effect sweep."),
        _table(heads, rows),
    ]


def _table(heads: Sequence[str], rows: Sequence[Sequence[Any]], texts: tuple[int, ...] = ()) -> str:
    """Return an HTML table, whose rows become lists on narrow screens."""
    lines = []
    for row in rows:
        cells = (
            f'<td data-head="{escape(head, quote=True)}"{" class=text" if at in texts else ""}>{escape(str(cell))}</td>'
            for at, (head, cell) in enumerate(zip(heads, row, strict=True))
        )
        lines.append(f"<tr>{''.join(cells)}</tr>")
    head = "".join(f"<th>{escape(each)}</th>" for each in heads)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(lines)}</tbody></table>"


def _details(title: str, inner: str) -> str:
    return f"<details><summary>{escape(title)}</summary>{inner}</details>"


def _picture(file: Path, said: str) -> str:
    """Return a PNG as embedded HTML, with a caption."""
    data = base64.b64encode(file.read_bytes()).decode("ascii")
    return (
        f'<figure><img alt="{escape(said, quote=True)}" src="data:image/png;base64,{data}">'
        f"<figcaption>{escape(said)}</figcaption></figure>"
    )
