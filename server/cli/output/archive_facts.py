"""Names and values that describe archives and exports, for printing in two columns.

Of an archive, these are the details beyond those in `SceneInfo`.
"""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from .console import bytes_text, length_text, print_facts

if TYPE_CHECKING:
    # These modules load numba and HDF5; a table needs neither.
    from ....builder.export.export_archive import ExportSummary
    from ....builder.passes.archive_summary import ArchiveSummary
    from ....builder.passes.cell_summary import CellSummary
    from ....schemas.archive.index import Source
    from ...residency.voxel_store import VoxelStore


def print_export(done: "ExportSummary") -> None:
    """Print the summary of a completed export."""
    print_facts(_export_facts(done))


def _export_facts(done: "ExportSummary") -> Iterator[tuple[str, str]]:
    yield "file", f"{done.file}, {done.format}, {bytes_text(done.bytes)}"
    yield "points", f"{done.points:,}"
    if done.low is not None and done.high is not None:
        low, high = (" ".join(f"{v:.4f}" for v in corner) for corner in (done.low, done.high))
        yield "bounds", f"{low} .. {high} m"
    for note in done.notes:
        yield "note", note


def print_summary(summary: "ArchiveSummary") -> None:
    """Print what matters about an archive: the last lines of `build` and `info`."""
    print()
    print_facts(summary_facts(summary))


def summary_facts(summary: "ArchiveSummary") -> Iterator[tuple[str, str]]:
    """Yield the figures of an archive's summary as names and texts."""
    yield "points", f"{summary.points:,}"
    area = "unknown" if summary.area is None else f"about {_rounded_area(summary.area)} m² of surface"
    yield "area", f"{area} ({summary.area_from})"
    if summary.spacing is not None:
        yield "spacing", f"{length_text(summary.spacing)} ({summary.spacing_from})"
    yield "radius", f"{length_text(summary.radius)} ({summary.radius_from})"
    yield (
        "voxel size",
        f"{summary.voxel:g} m ({summary.voxel_from}): {summary.voxels:,} voxels, {summary.points_a_voxel:,.0f} points "
        f"in the mean, {summary.densest:,} in the densest",
    )
    yield "leaf cells", cells_text(summary.cells)
    yield "bytes a point", f"{summary.bytes_a_point:.2f}"
    for number, line in enumerate(summary.look_at):
        yield "" if number else "if it looks wrong", line


def cells_text(cells: "CellSummary") -> str:
    """Describe leaf cells: their number and size, what was asked for, and the heights of their trees."""
    asked = "" if cells.asked is None else f" (--leaf-cells {cells.asked:,})"
    text = f"{cells.cells:,} of at most {cells.most:,} points{asked}"
    if cells.heights is None:
        return text
    if len(cells.heights) == 1:
        levels = f"all trees have {_levels_text(*cells.heights)}"
    else:
        levels = ", ".join(f"{held:,} trees of {_levels_text(each)}" for each, held in cells.heights.items())
    small = (
        f"; {cells.small:,} cells of fewer than {cells.fewest:,} points could not be merged within their largest cube"
        if cells.small
        else ""
    )
    return f"{text}; {levels}{small}"


def _levels_text(levels: int) -> str:
    """Format a number of levels."""
    return "1 level" if levels == 1 else f"{levels} levels"


def _rounded_area(square_metres: float) -> str:
    """Format an area with two significant digits: it is an estimate."""
    rounded = float(f"{square_metres:.2g}")
    return f"{rounded:,.0f}" if rounded >= 10 else f"{rounded:g}"


def archive_details(store: "VoxelStore") -> dict[str, Any]:
    """Return the details that `info` adds to a scene's description, in JSON types.

    densest: the voxel with the most points, their number and its decoded size in bytes.
    scans: for each source that declares any of them, its number and: scanner (origin [m]), crs,
    units, up.
    preview: size of the ParaView file in bytes; None if it does not exist.
    warnings: sentences about scans that look wrong.
    """
    from ....builder.sources.coincident_scans import coincident_sources
    from ....schemas.archive.vtkhdf import PREVIEW_NAME

    archive = store.archive
    points = archive.voxels["rows"][:, 2]
    densest = int(points.argmax())
    preview = archive.folder / PREVIEW_NAME
    return {
        "densest": {
            "voxel": archive.coordinates[densest].tolist(),
            "points": int(points[densest]),
            "resident_bytes": int(store.sizes[densest]),
        },
        "scans": [
            {"number": number, **said}
            for number, source in enumerate(archive.header.sources)
            if not source.fault and (said := _source_details(source))
        ],
        "preview": preview.stat().st_size if preview.exists() else None,
        "warnings": list(coincident_sources(archive.header.sources)),
    }


def _source_details(source: "Source") -> dict[str, Any]:
    """Return a scan's scanner position, coordinate system, units and up axis, if not default."""
    scanner = source.pose[:3, 3].tolist()
    return {
        **({"scanner": scanner} if any(scanner) else {}),
        **({"crs": source.crs} if source.crs else {}),
        **({"units": source.units} if source.units != "m" else {}),
        **({"up": source.up} if source.up != "z" else {}),
    }


def detail_facts(details: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield the result of `archive_details` as names and texts."""
    densest = details["densest"]
    decoded = bytes_text(densest["resident_bytes"])
    yield "densest", f"voxel {tuple(densest['voxel'])}, {densest['points']:,} points, {decoded} decoded"
    for scan in details["scans"]:
        if "scanner" in scan:
            yield f"scan {scan['number']}", f"scanner at {' '.join(f'{v:.3f}' for v in scan['scanner'])} m"
        if "units" in scan or "up" in scan:
            yield f"scan {scan['number']}", f"read as {scan.get('units', 'm')}, {scan.get('up', 'z')} up"
    for crs in sorted({scan["crs"] for scan in details["scans"] if "crs" in scan}):
        scans = sum(scan.get("crs") == crs for scan in details["scans"])
        yield "system", f"{' '.join(crs.split())[:300]} ({scans} of the scans)"
    if details["preview"] is not None:
        yield "preview", f"preview.vtkhdf for ParaView, {bytes_text(details['preview'])}"
    for warning in details["warnings"]:
        yield "warning", warning
