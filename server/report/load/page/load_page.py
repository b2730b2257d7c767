"""Page of a load test: targets, pictures and figures in one self-contained HTML file."""

import base64
import html
from pathlib import Path
from typing import Any, NamedTuple

from .....schemas.runtime.new_file import new_file
from .....schemas.runtime.visible_text import visible
from ...common.bench_results import Part, busy, goal_rows, limit_text, number

RELOAD_SECONDS = 10
STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; margin: 2rem auto; max-width: 1100px; padding: 0 1rem; color: #222; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.15rem; margin-top: 2.2rem; }
img { max-width: 100%; } table { border-collapse: collapse; font-size: 13px; }
td, th { padding: .15rem .6rem; text-align: left; border-bottom: 1px solid #e3e7eb; }
td.n { text-align: right; font-variant-numeric: tabular-nums; }
.met { color: #2e8b57; } .missed { color: #c0392b; font-weight: 600; } .not { color: #b8860b; }
p.note { color: #777; font-size: 13px; } p.warn { color: #c0392b; } p.run { background: #eef4f9; padding: .4rem .8rem; }
"""


class PageState(NamedTuple):
    """State of a load test. now: what runs, "" at the end.

    done, total: numbers of runs.  seconds: since the beginning.
    """

    now: str
    done: int
    total: int
    seconds: float


def write_page(
    parts: list[Part],
    notes: dict[str, str],
    pictures: list[tuple[str, bytes]],
    about: str,
    target: Path,
    state: PageState | None = None,
) -> None:
    """Write the page, completely or not at all. A page that is not the last one reloads itself.

    pictures: title and PNG of each.
    about: machine and archive, in a sentence.
    """
    body = [f"<h1>solidcloud under load</h1><p>{html.escape(about)}</p>"]
    running = state is not None and bool(state.now)
    if state is not None and running:
        done = f"{state.done} of {state.total} runs, {state.seconds / 60:.0f} min so far"
        body.append(
            f'<p class="run">running: {html.escape(state.now)} ({done}); this page reloads itself</p>'
        )
    if warning := busy(parts):
        body.append(f'<p class="warn">{html.escape(warning)}: not figures to quote</p>')
    for part in parts:
        for line in [*part.wrong, *([f"ended early: {part.error}"] if part.error else [])]:
            body.append(f'<p class="warn">{html.escape(f"{part.section}: {line}")}</p>')
    body.append(_goals(goal_rows(parts, notes)))
    for name, picture in pictures:
        source = base64.b64encode(picture).decode()
        body.append(
            f'<h2>{html.escape(name)}</h2><img alt="{html.escape(name)}" src="data:image/png;base64,{source}">'
        )
    body += [_figures(part) for part in parts if part.figures]
    for part in parts:
        for line in [*part.missing, *part.remarks]:
            body.append(f'<p class="note">{html.escape(f"{part.section}: {line}")}</p>')
    target.parent.mkdir(parents=True, exist_ok=True)
    page = '<!doctype html><html lang="en"><head><meta charset="utf-8"><title>solidcloud under load</title>'
    if running:
        page += f'<meta http-equiv="refresh" content="{RELOAD_SECONDS}">'
    page += f"<style>{STYLE}</style></head><body>{''.join(body)}</body></html>\n"
    with new_file(target) as file:
        file.write(visible(page).encode())


def _goals(rows: list[dict[str, Any]]) -> str:
    lines = []
    for row in rows:
        kind = row["verdict"].split()[0]
        title = html.escape(row["note"], quote=True)
        lines.append(
            f'<tr title="{title}"><td>{html.escape(row["goal"])}</td><td class="n">{number(row["measured"])}</td>'
            f'<td class="n">{html.escape(limit_text(row))}</td><td class="{kind}">{row["verdict"]}</td></tr>'
        )
    head = "<tr><th>goal</th><th>figure</th><th>limit</th><th></th></tr>"
    return f"<h2>Goals</h2><table>{head}{''.join(lines)}</table>" if rows else ""


def _figures(part: Part) -> str:
    """Return a section's figures: one row per case and side, one column per figure."""
    columns = list(dict.fromkeys((f.what, f.unit) for f in part.figures))
    lines: dict[tuple[str, str], dict[tuple[str, str], float]] = {}
    for f in part.figures:
        lines.setdefault((f.case, f.side), {})[(f.what, f.unit)] = f.value
    head = "".join(f"<th>{html.escape(what)}{f', {unit}' if unit else ''}</th>" for what, unit in columns)
    rows = "".join(
        f"<tr><td>{html.escape(case)}</td><td>{html.escape(side)}</td>"
        + "".join(f'<td class="n">{number(values.get(column))}</td>' for column in columns)
        + "</tr>"
        for (case, side), values in lines.items()
    )
    title = html.escape(part.section)
    return f'<h2>{title}</h2><div style="overflow-x:auto"><table><tr><th></th><th></th>{head}</tr>{rows}</table></div>'
