"""What archives and exports say of themselves, in two columns: of an archive, what a scene does not say."""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from ..console import bytes_text, print_facts

if TYPE_CHECKING:
    # Numba and HDF5 come with these; a table needs neither.
    from ...builder.export import Exported
    from ...schemas.index import Source
    from ..store import Store


def print_export(done: "Exported") -> None:
    """What an export says of itself when it is done."""
    print_facts(_export_facts(done))


def _export_facts(done: "Exported") -> Iterator[tuple[str, str]]:
    yield "file", f"{done.file}, {done.format}, {bytes_text(done.bytes)}"
    yield "points", f"{done.points:,}"
    if done.low is not None and done.high is not None:
        low, high = (" ".join(f"{v:.4f}" for v in corner) for corner in (done.low, done.high))
        yield "bounds", f"{low} .. {high} m"
    for note in done.notes:
        yield "note", note


def archive_details(store: "Store") -> dict[str, Any]:
    """What `info` says of an archive beyond what a server says of a scene; JSON's own types alone.

    densest: the voxel with the most points, their number and what it takes decoded.  scans: of each source that has
    any of it, by its number: scanner (its origin [m]), crs, units, up.  preview: bytes of the file for ParaView, None
    where there is none.  warnings: sentences about scans that look wrong.
    """
    from ...builder.coincident import coincident_sources
    from ...schemas.vtkhdf import PREVIEW_NAME

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
            if not source.fault and (said := _of_source(source))
        ],
        "preview": preview.stat().st_size if preview.exists() else None,
        "warnings": list(coincident_sources(archive.header.sources)),
    }


def _of_source(source: "Source") -> dict[str, Any]:
    """Where the scanner stood, of a scan with a pose of its own, and in what system and units it was."""
    scanner = source.pose[:3, 3].tolist()
    return {
        **({"scanner": scanner} if any(scanner) else {}),
        **({"crs": source.crs} if source.crs else {}),
        **({"units": source.units} if source.units != "m" else {}),
        **({"up": source.up} if source.up != "z" else {}),
    }


def detail_facts(details: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """The same in words."""
    densest = details["densest"]
    decoded = bytes_text(densest["resident_bytes"])
    yield "densest", f"voxel {tuple(densest['voxel'])}, {densest['points']:,} points, {decoded} decoded"
    for scan in details["scans"]:
        if "scanner" in scan:
            yield f"scan {scan['number']}", f"scanner at {' '.join(f'{v:.3f}' for v in scan['scanner'])} m"
        if "units" in scan or "up" in scan:
            yield f"scan {scan['number']}", f"taken for {scan.get('units', 'm')}, {scan.get('up', 'z')} up"
    for crs in sorted({scan["crs"] for scan in details["scans"] if "crs" in scan}):
        scans = sum(scan.get("crs") == crs for scan in details["scans"])
        yield "system", f"{' '.join(crs.split())[:300]} ({scans} of the scans)"
    if details["preview"] is not None:
        yield "preview", f"preview.vtkhdf for ParaView, {bytes_text(details['preview'])}"
    for warning in details["warnings"]:
        yield "warning", warning
