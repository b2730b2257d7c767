"""`solidcloud inspect`: list scans by their headers, and write a scan list for a build."""

import sys
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from .command_options import AsJson, interruptible, print_error, print_json, print_warning

if TYPE_CHECKING:
    from ....builder.sources.scan_list import ScanEntry

DEFAULT_LIST = Path("scans.toml")


def inspect(
    scans: Annotated[list[Path], typer.Argument(help="Scans or folders of scans.")],
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="Scan list to write, for solidcloud build; default: scans.toml."),
    ] = None,
    with_sha256: Annotated[
        bool, typer.Option("--sha256", help="Also hash every file, which reads the whole file.")
    ] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing scan list.")] = False,
    as_json: AsJson = False,
) -> None:
    """Describe scans and write a list to edit.

    The description comes from the headers of the scans. Exit code 3: a scan is broken.
    """
    from ....builder.sources.scan_files import inspect_scans
    from ....builder.sources.scan_list import write_scan_list
    from ....schemas.errors import BadRequestError
    from ....schemas.process.os_errors import naming_write_errors
    from ..output.progress_display import progress_listener

    if output and output.exists() and not overwrite:
        raise BadRequestError(f"{output}: exists, expected no such file: give another -o, or --overwrite")
    with progress_listener() as bars:
        entries = inspect_scans(scans, with_sha256=with_sha256, progress=bars)
    if as_json:
        print_json([_plain(entry) for entry in entries])
    else:
        print("\n".join(_lines(entries)))
    # Without --output the list is only a convenience, and an existing list may hold hours of edits.
    if not as_json and not output and DEFAULT_LIST.exists() and not overwrite:
        print(
            f"{DEFAULT_LIST}: exists and was not changed; -o writes another list, --overwrite replaces this one",
            file=sys.stderr,
        )
    elif output or not as_json:
        with interruptible(), naming_write_errors(output or DEFAULT_LIST):
            write_scan_list(output or DEFAULT_LIST, entries)
        print(f"{output or DEFAULT_LIST}: {len(entries)} scans", file=sys.stderr)
    for entry in entries:
        for warning in entry.warnings:
            print_warning(warning)
    faults = [entry.fault for entry in entries if entry.fault]
    for fault in faults:
        print_error(fault, 3)
    raise typer.Exit(3 if faults else 0)


def _plain(entry: "ScanEntry") -> dict[str, Any]:
    """Convert an entry to JSON types."""
    return {
        "path": str(entry.path),
        "index": entry.index,
        "format": entry.format,
        "count": entry.count,
        "bounds": None if entry.bounds is None else entry.bounds.tolist(),
        "pose": None if entry.pose is None else entry.pose.tolist(),
        "units": entry.units,
        "up": entry.up,
        "scale": entry.scale,
        "crs": entry.crs,
        "sha256": entry.sha256,
        "use": entry.use,
        "fault": entry.fault,
        "warnings": list(entry.warnings),
        "columns": list(entry.columns),
    }


def _lines(entries: "list[ScanEntry]") -> list[str]:
    """Format entries as a table, one line each. The path is last because it may be long."""
    head = ("format", "points", "low corner", "high corner", "scanner at", "", "columns", "scan")
    rows = [head, *(_row(entry) for entry in entries)]
    widths = [max(len(row[k]) for row in rows) for k in range(len(head))]
    lines = []
    for row in rows:
        cells = [
            row[k].rjust(widths[k]) if k == 1 else row[k].ljust(widths[k])
            for k in range(len(head))
            if widths[k]
        ]
        lines.append("  ".join(cells).rstrip())
    known = sum(entry.count or 0 for entry in entries)
    open_ended = sum(entry.count is None and not entry.fault for entry in entries)
    files = len({entry.path for entry in entries})
    broken = sum(bool(entry.fault) for entry in entries)
    more = f" and those of {open_ended} scans that do not declare a count" if open_ended else ""
    faults = f", {broken} broken" if broken else ""
    counts = Counter[str]()
    for entry in entries:
        counts.update(dict.fromkeys(entry.columns, entry.count or 0))
    held = "".join(f"; {name} of {count:,}" for name, count in sorted(counts.items()))
    return [*lines, f"{len(entries)} scans in {files} files{faults}: {known:,} points{more}{held}"]


def _row(entry: "ScanEntry") -> tuple[str, ...]:
    """Return the cells of one line of the table."""
    low, high = ("", "") if entry.bounds is None else (_place(corner) for corner in entry.bounds.tolist())
    other = [entry.units] if entry.units != "m" else []
    other += [f"{entry.up} up"] if entry.up != "z" else []
    name = str(entry.path) + (f" [{entry.index}]" if entry.index else "")
    return (
        "broken" if entry.fault else entry.format,
        "" if entry.fault else "?" if entry.count is None else f"{entry.count:,}",
        low,
        high,
        "" if entry.pose is None else _place(entry.pose[:3, 3].tolist()),
        ", ".join(other),
        ", ".join(entry.columns),
        name,
    )


def _place(xyz: list[float]) -> str:
    return " ".join(f"{v:.2f}" for v in xyz)
