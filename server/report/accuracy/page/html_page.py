"""HTML page of the accuracy report, with embedded pictures and explanations of its terms."""

import base64
import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from html import escape
from pathlib import Path
from typing import Any

from ..measurement.interleaved_timing import NOISY
from ..measurement.setting_results import Report, Row, knobs
from .page_texts import CHARTS, KNOBS, TERMS, findings

STYLE = """
body{font:16px/1.5 system-ui,sans-serif;color:#2f2a26;background:#fbfaf7;max-width:75rem}
body{margin:2rem auto;padding:0 1rem}
h1{font-size:1.7rem}h2{margin-top:2.5rem;border-top:1px solid #d9cfc1;padding-top:1rem}
img{max-width:100%;height:auto;background:#fff}p,li{max-width:48rem}
.wide{overflow-x:auto}table{border-collapse:collapse;font-size:.85rem}
th,td{padding:.2rem .55rem;text-align:right;border-bottom:1px solid #e4ded4;white-space:nowrap}
th{text-align:right;vertical-align:bottom;white-space:normal}th:first-child,td:first-child{text-align:left}
tr.default{background:#efe9dc;font-weight:600}.noisy{color:#a05a00}dt{font-weight:600}dd{margin:0 0 .5rem 1rem}
"""

# Column headings of a table, in the order of `_cells`. Columns that are empty in all rows are left
# out.
HEADS = (
    "setting", "time per pose [µs]", "p50 of groups", "p99 of groups", "ratio to default", "early", "late", "unknown",
    "near-tangent: early", "late", "unknown", "distance error, max [mm]", "mean [mm]", "no pair found",
    "doorway [mm]", "made doorway [mm]", "leak p50 [mm]", "p99 [mm]", "worst [mm]", "passed [%]",
    "archive [bytes]", "decode [ms]",
    "node tests", "pair tests", "Pareto front", "note",
)  # fmt: skip


def write_page(report: Report, charts: dict[str, Path], target: Path) -> None:
    """Write the page. charts: as `draw_charts` returns them."""
    facts = report.facts
    body = [
        f"<h1>Accuracy and query time</h1><p>{escape(report.scene)}; an avatar of {facts['avatar_points']:,} points. "
        f"Times are measured on a walk of {facts['walk_poses']:,} poses, verdicts on {facts['judged_poses']:,} poses, "
        f"{facts['judged_contacts']:,} of them in contact, and on {facts['near_tangent_poses']:,} within a micrometre "
        "of touching. The reference is the server's exact answer. At "
        f"{facts['poses_judged_by_every_pair']:,} poses it was compared with a test of every pair of points in "
        "integers, and agreed."
        f"{''.join(f' <strong>{escape(said)}</strong>' for said in facts['warnings'])}</p>",
        _noise(report.rows),
        "<h2>Summary</h2>",
        _picture(charts["main"], CHARTS["main"]),
        "<ul>"
        + "".join(
            f"<li>{escape(line)}</li>" for line in findings(report.rows, facts["poses_judged_by_every_pair"])
        )
        + "</ul>",
    ]
    if "verdicts" in charts:
        body.append(_picture(charts["verdicts"], CHARTS["verdicts"]))
    body.append(
        "<h2>Pareto front</h2><p>Settings of the server that no other setting beats in time and in at least one "
        "error.</p>"
    )
    body.append(table(front_rows(report.rows)))
    body.append("<h2>Terms</h2><dl>")
    body += [f"<dt>{escape(term)}</dt><dd>{escape(said)}</dd>" for term, said in TERMS.items()]
    body.append("</dl>")
    for knob in knobs(report.rows):
        own = [row for row in report.rows if row.knob == knob]
        body.append(f"<h2>{escape(knob.capitalize())}</h2>")
        body.append(f"<p>{escape(KNOBS[knob])}</p>{_picture(charts[knob], '')}{table(own)}")
    page = (
        '<!doctype html><html lang="en"><head><meta charset="utf-8"><title>Accuracy and query time</title>'
        f"<style>{STYLE}</style></head><body>{''.join(body)}</body></html>\n"
    )
    target.write_text(page, encoding="utf-8")


def front_rows(rows: Sequence[Row]) -> list[Row]:
    """Return the rows on a Pareto front, named by knob and setting; the defaults appear once."""
    chosen = [row for row in rows if row.front]
    first = next((row for row in chosen if row.default), None)
    return [
        replace(row, setting="all settings" if row is first else f"{row.knob} {row.setting}")
        for row in chosen
        if row is first or not row.default
    ]


def table(rows: Sequence[Row]) -> str:
    """Format the rows of one knob as an HTML table."""
    cells = [_cells(row) for row in rows]
    shown = [k for k in range(len(HEADS)) if any(line[k] for line in cells)]
    head = "".join(f"<th>{escape(HEADS[k])}</th>" for k in shown)
    lines = []
    for row, line in zip(rows, cells, strict=True):
        kind = ' class="default"' if row.default else ""
        lines.append(f"<tr{kind}>" + "".join(f"<td>{escape(line[k])}</td>" for k in shown) + "</tr>")
    return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{"".join(lines)}</tbody></table></div>'


def _cells(row: Row) -> list[str]:
    """Return the cells of a row, in the order of HEADS."""
    noisy = " (noisy)" if row.noise is not None and row.noise > NOISY else ""
    return [
        row.setting + (" (default)" if row.default else ""),
        _figure(row.mean_us, 2) + noisy,
        *(_figure(value, 2) for value in (row.p50_us, row.p99_us, row.times)),
        *_counts((row.early, row.late, row.unknown), row.poses),
        *_counts((row.tangent_early, row.tangent_late, row.tangent_unknown), row.tangent),
        _small(row.distance_max_mm),
        _small(row.distance_mean_mm),
        str(row.distance_missing or ""),
        *(_figure(v, 1) for v in (row.doorway_mm, row.made_doorway_mm)),
        *(_figure(v, 1) for v in (row.leak_p50_mm, row.leak_p99_mm, row.leak_worst_mm)),
        "" if row.leak_share is None else f"{row.leak_share * 100:.2f}",
        "" if row.archive_bytes is None else f"{row.archive_bytes:,}",
        _figure(row.decode_ms, 1),
        *(_figure(value, 0) for value in (row.node_tests, row.pair_tests)),
        ", ".join(row.front),
        row.note,
    ]


def _counts(counts: Iterable[int], of: int) -> list[str]:
    return [f"{count:,} of {of:,}" if count else "0" if of else "" for count in counts]


def _figure(value: float | None, digits: int) -> str:
    if value is None:
        return ""
    return f"{value:,.{digits}f}" if math.isfinite(value) else "does not pass"


def _small(value: float | None) -> str:
    """Format a length [mm] that may be 0, a rounding error, or centimetres."""
    if value is None:
        return ""
    return "0" if value < 1e-9 else f"{value:.3g}"


def _picture(file: Path, said: str) -> str:
    """Return a PNG as embedded HTML, with a caption."""
    data = base64.b64encode(file.read_bytes()).decode("ascii")
    below = f"<figcaption>{escape(said)}</figcaption>" if said else ""
    return (
        f'<figure><img alt="{escape(said or file.stem)}" src="data:image/png;base64,{data}">{below}</figure>'
    )


def _noise(rows: Sequence[Row]) -> str:
    """Return a warning if other work on the machine disturbed the times."""
    noisy: list[Any] = [row for row in rows if row.noise is not None and row.noise > NOISY]
    if not noisy:
        return ""
    return (
        f'<p class="noisy">The machine was busy: at {len(noisy)} of {len(rows)} settings the median repetition took '
        f"over {NOISY:g} times as long as the best. Times are the best of several repetitions taken in turn; compare "
        "them only with one another.</p>"
    )
