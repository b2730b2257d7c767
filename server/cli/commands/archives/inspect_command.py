"""`solidcloud inspect`: list scans by their headers, and write a scan list for a build."""

import sys
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..command_options import AsJson, interruptible, print_error, print_json, print_warning

if TYPE_CHECKING:
    from .....builder.plan.stray_points import StrayPoints
    from .....builder.sources.scan_list import ScanEntry

DEFAULT_LIST = Path("scans.toml")
# Points that are counted by a flag of LAS, or as noise (low and high).
WITHHELD = "withheld"
FLAGGED = (WITHHELD, "class 7", "class 18", "synthetic")


def inspect(
    scans: Annotated[list[Path], typer.Argument(help="Scans, folders of scans, or a scans.toml.")],
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="Scan list to write, for solidcloud build; default: scans.toml."),
    ] = None,
    with_sha256: Annotated[
        bool, typer.Option("--sha256", help="Also hash every file, which reads the whole file.")
    ] = False,
    stray: Annotated[
        bool,
        typer.Option(
            "--stray",
            help="Also read all points, count those that hang in the air up to 2 m above floors, and propose options "
            "of build that leave them out.",
        ),
    ] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing scan list.")] = False,
    as_json: AsJson = False,
) -> None:
    """Describe scans and write a list to edit.

    The description comes from the headers of the scans; of a scans.toml, its edits are kept. Points
    that are withheld, noise (classes 7 and 18) or synthetic are counted, in large files by a
    sample.

    --stray: dust and what is left of passing people stop walking avatars in mid air. Points hang if
    their group in cubes of 0.1 m has fewer than 500 points, touches no other group, and is above one
    with more. --json has the same fields: stray is null for a scan that was not read.

    Exit code 3: a scan is broken.
    """
    from dataclasses import replace

    from .....builder.sources.scan_files import inspect_scans
    from .....builder.sources.scan_list import write_scan_list
    from .....schemas.errors import BadRequestError
    from .....schemas.runtime.os_errors import naming_write_errors
    from ...output.progress_display import progress_listener

    if output and output.exists() and not overwrite:
        raise BadRequestError(f"{output}: exists, expected no such file: give another -o, or --overwrite")
    found: StrayPoints | None = None
    with progress_listener() as bars:
        entries = inspect_scans(scans, with_sha256=with_sha256, progress=bars)
        if stray:
            from .....builder.plan.stray_points import find_stray_points

            with interruptible():
                found = find_stray_points(entries, bars)
            for number, fault in found.faults.items():
                entries[number] = replace(entries[number], fault=fault)
    if as_json:
        print_json([{**_plain(entry), "stray": _plain_stray(found, k)} for k, entry in enumerate(entries)])
    else:
        print(
            "\n".join(
                [
                    *_lines(entries),
                    *_flag_lines(entries),
                    *([] if found is None else _stray_lines(entries, found)),
                ]
            )
        )
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
        "flagged": _flagged(entry),
    }


def _flagged(entry: "ScanEntry") -> dict[str, Any] | None:
    """Return how many points a build leaves out or could leave out; None if they were not counted.

    exact: all points were read; otherwise the numbers are estimated from those that were.
    """
    read = entry.classes["points"] if entry.classes else 0
    if not read or entry.classes is None:
        return None
    total = read if entry.count is None else entry.count
    flags = {name: round(entry.classes.get(name, 0) * total / read) for name in FLAGGED}
    return {"exact": read >= total, **flags}


def _flag_lines(entries: "list[ScanEntry]") -> list[str]:
    """Format the flagged points, a line for each scan that has some."""
    lines = []
    for entry in entries:
        found = _flagged(entry) or {}
        about = "" if found.get("exact") else "about "
        counts = {name: f"{about}{found[name]:,}" for name in FLAGGED if found.get(name)}
        parts = (
            [f"{counts[WITHHELD]} points withheld, which a build leaves out"] if WITHHELD in counts else []
        )
        drop = [name for name in counts if name != WITHHELD]
        if drop:
            option = ",".join(name.removeprefix("class ") for name in drop)
            text = ", ".join(
                f"{counts[name]} {name if name == 'synthetic' else f'of {name}'}" for name in drop
            )
            parts.append(f"{text}: `build --drop-classes {option}` leaves these out")
        if parts:
            lines.append(f"{_name(entry)}: {'; '.join(parts)}")
    return lines


def _plain_stray(found: "StrayPoints | None", number: int) -> dict[str, Any] | None:
    """Convert the hanging points of a scan to JSON types; None if they were not counted.

    left_out and lost are of all scans: what `outliers` leaves out of hanging points, and of surfaces.
    """
    scan = found and found.scans[number]
    if found is None or scan is None:
        return None
    advice = found.advice if scan.points else None
    return {
        "points": scan.points,
        "share": scan.share,
        "groups": scan.groups,
        "largest": {"points": scan.largest, "place": scan.place} if scan.points else None,
        "outliers": _option(advice and advice.outliers),
        "left_out": advice.left_out if advice else 0,
        "lost": advice.lost if advice else 0,
        "moving": _option(advice and advice.moving),
    }


def _stray_lines(entries: "list[ScanEntry]", found: "StrayPoints") -> list[str]:
    """Format the hanging points, a line for each scan that has some, and what to do about them."""
    lines = [
        f"{_name(entry)}: {scan.points:,} points ({scan.share:.2g} of all) hang in the air above floors, in "
        f"{scan.groups:,} groups; the largest, of {scan.largest:,}, at {_place(list(scan.place))}"
        for entry, scan in zip(entries, found.scans, strict=True)
        if scan and scan.place
    ]
    advice = found.advice
    if advice is None:
        return ["no points hang in the air above floors"]
    said = []
    if advice.outliers:
        also = f" and about {advice.lost:,} of surfaces" if advice.lost else ""
        said.append(
            f"--outliers {_option(advice.outliers)} leaves out at least {advice.left_out:,} of {advice.points:,}{also}"
        )
    if advice.moving:
        said.append(
            f"--moving {_option(advice.moving)} leaves out what only one of the overlapping scans saw"
        )
    if not said:
        said.append("--outliers would leave out surfaces too: they are scanned as thinly as these points")
    return [*lines, f"solidcloud build: {'; '.join(said)}"]


def _option(rule: tuple[float, int] | None) -> str | None:
    """Format the value of an option METRES,NUMBER."""
    return rule and f"{rule[0]:g},{rule[1]}"


def _name(entry: "ScanEntry") -> str:
    """Return the path, with the scan's number in its file unless it is the first."""
    return str(entry.path) + (f" [{entry.index}]" if entry.index else "")


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
    other = [entry.units] if entry.units not in ("", "m") else []
    other += [f"{entry.up} up"] if entry.up not in ("", "z") else []
    return (
        "broken" if entry.fault else entry.format,
        "" if entry.fault else "?" if entry.count is None else f"{entry.count:,}",
        low,
        high,
        "" if entry.pose is None else _place(entry.pose[:3, 3].tolist()),
        ", ".join(other),
        ", ".join(entry.columns),
        _name(entry),
    )


def _place(xyz: list[float]) -> str:
    return " ".join(f"{v:.2f}" for v in xyz)
