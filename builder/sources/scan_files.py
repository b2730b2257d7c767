"""Opening of scans: files, folders and scan lists, as a build or `solidcloud inspect` names them.

format_table.py lists the formats, scan_list.py reads a list. Opening a file reads its headers.
Points are read only from the text of PTX and PTS files, where the second scan can be found only by
reading past the first, and from small scans without declared bounds (coincident_scans.py).
"""

import importlib
import math
import os
from collections.abc import Callable, Iterable, Sequence, Set
from dataclasses import replace
from functools import cache
from itertools import zip_longest
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas.errors import BadRequestError, ScanError
from ...schemas.runtime.interrupts import check_interrupt
from ..run.executor import Progress, Silent
from ..run.transient_errors import raise_transient
from .class_counts import count_classes, counted_points
from .coincident_scans import coincident_scan
from .common.scan import Scan, library_errors, scan_error, sha256_of
from .common.units import axis_metres
from .format_table import FORMATS, UNSUPPORTED
from .placed_scan import place_scan
from .scan_list import LIST_SUFFIX, ScanEntry, read_scan_list
from .scan_warnings import ScanFacts, find_warnings
from .surface_samples import SurfaceSamples

_FORMATS = {row.suffix: row for row in FORMATS}
# How the names of AppleDouble files begin: macOS keeps a file's attributes in them.
COMPANION = "._"
_APPLE_DOUBLE = b"\x00\x05\x16\x07"
_IN_FOLDERS = frozenset(row.suffix for row in FORMATS if row.in_folders)


class InputFile(NamedTuple):
    """File of a build: its scans, opened and placed, or the fault that prevents it.

    region: (2, 3) world [m], where the points of a file that cannot be opened may have been; None:
    not known.
    note: about the search of the folder whose first file this is, or "".
    """

    path: Path
    scans: list[Scan]
    fault: str = ""
    region: NDArray[np.float64] | None = None
    note: str = ""


def open_scans(path: Path, *, spacing: float | None = None) -> list[Scan]:
    """Open the scans of one file: read and check the headers, but no points.

    spacing: sample the surface of a mesh (OBJ, STL, PLY, GLB) with about this distance between
    points [m] instead of returning its vertices; other formats ignore it.
    An E57, PTX or PTS file may hold many scans; an E57 file may hold none. A valid file without
    points gives a scan without blocks.
    Raises ScanError for a file that is missing, empty, of unknown format, truncated or
    inconsistent, and BadRequestError for a spacing that is not a positive number.
    """
    path = Path(path)
    if spacing is not None and not (math.isfinite(spacing) and spacing > 0):
        raise BadRequestError(f"spacing {spacing}, expected a positive number of metres: correct --spacing")
    _check_exists(path)
    if not path.is_file():
        raise scan_error(
            path, "a folder or a device", "a file", "name its files, or pass it through find_scan_files()"
        )
    suffix = path.suffix.lower()
    form = _FORMATS.get(suffix)
    if form is None:
        raise scan_error(
            path, f"the suffix {suffix!r}", f"one of {' '.join(_FORMATS)}", "convert the scan to one of these"
        )
    with library_errors(path):
        if path.stat().st_size == 0:
            raise scan_error(path, "an empty file", "a scan", "fetch the file again, or leave it out")
        scans: list[Scan] = _reader(form.reader)(path)
        # The vertex reader has checked the header by now; trimesh never sees a broken one.
        return [SurfaceSamples(scans[0], spacing)] if spacing is not None and form.is_mesh else scans


def _reader(name: str) -> Callable[..., Any]:
    """Return a function of `formats/` by its module and name, as format_table.py gives them."""
    module, function = name.split(".")
    found: Callable[..., Any] = getattr(importlib.import_module(f".formats.{module}", __package__), function)
    return found


def find_scan_files(paths: Iterable[Path]) -> list[Path]:
    """Expand paths to scan files: files stay as they are, folders are searched at any depth.

    A folder's files are sorted by path; the order does not depend on the file system. They include
    files of formats that open_scans() refuses. Files given by name keep their position, whatever
    their suffix. Links to folders below a folder are not followed.
    Files that macOS keeps beside others on foreign disks ("._name.las") are skipped in folders.
    Raises ScanError for a path that does not exist, for a folder that cannot be listed and for one
    without scan files.
    """
    return [file for file, _ in _search(paths)]


def _search(paths: Iterable[Path]) -> list[tuple[Path, str]]:
    """Return the files of find_scan_files(), each with a note on the search of its folder, or ""."""

    def refuse(error: OSError) -> None:
        raise scan_error(
            Path(error.filename),
            f"a folder that cannot be listed ({error.strerror})",
            "to read all scans below it",
            "allow it to be read, or name the other folders",
        )

    files: list[tuple[Path, str]] = []
    for path in map(Path, paths):
        _check_exists(path)
        if not path.is_dir():
            files.append((path, ""))
            continue
        found = sorted(
            Path(folder, name)
            for folder, _, names in os.walk(path, onerror=refuse)
            for name in names
            if Path(name).suffix.lower() in _IN_FOLDERS | UNSUPPORTED
        )
        skipped = [file for file in found if _is_companion(file)]
        below = [file for file in found if file not in skipped]
        if not below:
            raise scan_error(
                path,
                "a folder without scans",
                f"files ending in {' '.join(sorted(_IN_FOLDERS))}",
                "check the folder's name, or name its files",
            )
        note = f"{path}: {len(skipped)} files of macOS skipped, {skipped[0].name} first" if skipped else ""
        files += zip(below, [note, *[""] * len(below)], strict=False)
    return files


def _is_companion(path: Path) -> bool:
    """Return whether a file holds only attributes of another; its name alone does not tell.

    The result is False for a file that cannot be read: opening it reports the reason.
    """
    if not path.name.startswith(COMPANION):
        return False
    try:
        with path.open("rb") as file:
            return file.read(4) == _APPLE_DOUBLE
    except OSError:
        return False


def header_bounds(path: Path, units: str = "") -> NDArray[np.float64] | None:
    """Return the bounds that the header of an unreadable scan file declares.

    units: see `axis_metres`; "": what the file states.
    Returns (2, 3) world frame [m], low and high corner, or None where they are unknown. Never
    raises. Points are read only to contradict the bounds.
    """
    form = _FORMATS.get(Path(path).suffix.lower())
    if form is None or not form.bounds:
        return None
    try:
        bounds: NDArray[np.float64] | None = _reader(form.bounds)(Path(path), units)
        return bounds
    except Exception:
        check_interrupt()
        # Best effort on a file known to be broken; open_scans() or blocks() has already raised its
        # error.
        return None


def trusted_bounds(scan: Scan) -> NDArray[np.float64] | None:
    """Return `Scan.trusted_bounds`; None if the scan's file cannot be read."""
    try:
        with library_errors(scan.path):
            return scan.trusted_bounds()
    except ScanError:
        return None


def _check_exists(path: Path) -> None:
    with library_errors(path):
        exists = path.exists()
    if not exists:
        raise scan_error(path, "no such file or folder", "a scan", "check the path for a misspelling")


def inspect_scans(
    paths: Iterable[Path], *, with_sha256: bool = False, progress: Progress | None = None
) -> list[ScanEntry]:
    """List the scans of files, folders and lists (.toml) by their headers, in this order.

    A file that cannot be read, or that holds no scan (possible in E57), becomes an entry with a
    fault. An entry also has the warnings about its scan (scan_warnings.py). That of a list keeps
    the list's use, units, scale, up, pose and crs. Raise ScanError for a path that does not exist
    and a folder without scans, BadRequestError for a file that is named twice.
    """
    inputs: list[tuple[Path, list[ScanEntry] | None, str]] = []
    for path in map(Path, paths):
        if path.suffix.lower() == LIST_SUFFIX and path.is_file():
            inputs += [(file, listed, "") for file, listed in _by_file(read_scan_list(path)).items()]
        else:
            inputs += [(file, None, note) for file, note in _search([path])]
    _check_once((path, entry.index) for path, listed, _ in inputs for entry in listed or [ScanEntry(path)])
    progress = progress or Silent()
    progress.start("inspect", len(inputs), "files")
    entries: list[ScanEntry] = []
    numbers: list[int] = []
    facts: list[ScanFacts] = []
    counted = counted_points(len(inputs))
    for path, listed, note in inputs:
        found, scans = _inspect_file(path, with_sha256, counted)
        if note:
            found[0] = replace(found[0], warnings=(note, *found[0].warnings))
        if listed is not None:
            found, scans = _as_listed(listed, found, scans)
        for scan, entry in zip_longest(scans, found):
            if scan and entry.use:
                try:
                    placed = place_scan(
                        scan, pose=entry.pose, units=entry.units, up=entry.up, scale=entry.scale
                    )
                    numbers.append(len(entries))
                    facts.append(ScanFacts(placed))
                except ScanError as error:
                    entry = replace(entry, fault=str(error))
            entries.append(entry)
        progress.advance(1)
    progress.finish()
    for warning in find_warnings(facts):
        entry = entries[numbers[warning.number]]
        entries[numbers[warning.number]] = replace(entry, warnings=(*entry.warnings, warning.text))
    return entries


def _as_listed(
    listed: list[ScanEntry], found: list[ScanEntry], scans: list[Scan]
) -> tuple[list[ScanEntry], list[Scan]]:
    """Return the entries of a list for one file, described by its headers; first those with a scan.

    found: the entries of the file.  scans: those of the file; none if it cannot be opened.
    """
    known: list[ScanEntry] = []
    lost: list[ScanEntry] = []
    for entry in listed:
        if scans and entry.index >= len(scans):
            lost.append(replace(entry, fault=_missing_text(entry, len(scans))))
            continue
        header = found[entry.index if scans else 0]
        (known if scans else lost).append(
            replace(
                header, index=entry.index, use=entry.use, units=entry.units or header.units, scale=entry.scale,
                up=entry.up or header.up, pose=entry.pose, crs=entry.crs or header.crs,
                sha256=header.sha256 or entry.sha256,
            )
        )  # fmt: skip
    return [*known, *lost], [scans[entry.index] for entry in known]


def _inspect_file(path: Path, with_sha256: bool, counted: int) -> tuple[list[ScanEntry], list[Scan]]:
    """List the scans of one file; return the entries, and the scans unless they cannot be opened.

    counted: see `count_classes`.
    """
    digest = ""
    try:
        digest = sha256_of(path) if with_sha256 else ""
        scans = open_scans(path)
    except ScanError as error:
        return [ScanEntry(path, bounds=header_bounds(path, "m"), sha256=digest, fault=str(error))], []
    if not scans:
        return [ScanEntry(path, sha256=digest, fault=f"{path}: holds no scan, expected at least one")], []
    entries = [
        ScanEntry(
            path,
            scan.index,
            scan.format,
            scan.declared_count,
            scan.bounds,
            None if np.array_equal(scan.pose, np.eye(4)) else scan.pose,
            scan.units,
            scan.up,
            1.0,
            scan.crs,
            digest,
            fault=scan.fault,
            warnings=tuple(filter(None, [coincident_scan(scan)])),
            columns=tuple(sorted(scan.columns)),
            classes=count_classes(scan, counted),
        )
        for scan in scans
    ]
    return entries, scans


def open_input_files(
    paths: Sequence[Path],
    spacing: float | None = None,
    wanted: Set[str] = frozenset(),
    drop_classes: Set[int | str] = frozenset(),
) -> list[InputFile]:
    """Open what a build reads: files, folders and lists of scans (.toml).

    Scans are placed in metres with z up. spacing: of sampled meshes [m]. wanted, drop_classes: see
    `Scan`. A file that cannot be opened is kept with its fault, so that all faults are named
    together. Raise ScanError for a path that does not exist and a folder without scans,
    BadRequestError for a broken list and for a scan that is named twice, OSError if a file cannot
    be opened for a transient reason (transient_errors.py).
    """
    found: list[InputFile] = []
    for path in map(Path, paths):
        if path.suffix.lower() != LIST_SUFFIX or path.is_dir():
            found += [_open_input(file, None, spacing)._replace(note=note) for file, note in _search([path])]
            continue
        used = [entry for entry in read_scan_list(path) if entry.use]
        if not used:
            raise BadRequestError(f"{path}: no scan to use, expected at least one: set use = true")
        found += open_entries(used, spacing)
    _check_once((item.path, index) for item in found for index in [scan.index for scan in item.scans] or [0])
    for scan in (scan for item in found for scan in item.scans):
        scan.wanted, scan.drop_classes = frozenset(wanted), frozenset(drop_classes)
    return found


def open_entries(entries: Iterable[ScanEntry], spacing: float | None = None) -> list[InputFile]:
    """Open the scans of entries, placed in metres with z up, a file at a time; see open_input_files."""
    return [_open_input(file, listed, spacing) for file, listed in _by_file(entries).items()]


def _by_file(entries: Iterable[ScanEntry]) -> dict[Path, list[ScanEntry]]:
    """Return the entries of each file, in their order."""
    files: dict[Path, list[ScanEntry]] = {}
    for entry in entries:
        files.setdefault(entry.path, []).append(entry)
    return files


def _missing_text(entry: ScanEntry, count: int) -> str:
    """Return the fault of an entry whose file holds only `count` scans."""
    return f"{entry.path}: holds {count} scans, expected one of index {entry.index}: correct the list"


def _check_once(scans: Iterable[tuple[Path, int]]) -> None:
    """Raise BadRequestError for a scan (file, index) that occurs twice, even by different paths."""
    seen: dict[tuple[str, int], Path] = {}
    for path, index in scans:
        key = os.path.realpath(path), index
        if key in seen:
            raise BadRequestError(
                f"{path}: scan {index} is named twice, as that of {seen[key]} too, expected each once: leave one out"
            )
        seen[key] = path


def _open_input(path: Path, entries: list[ScanEntry] | None, spacing: float | None) -> InputFile:
    """Open one file with its listed scans; None: all of them, unchanged."""

    @cache
    def scans_spaced(factor: float) -> list[Scan]:
        # A mesh is sampled in its own units.
        return open_scans(path, spacing=None if spacing is None else spacing / factor)

    try:
        if entries is None:
            return InputFile(path, [place_scan(scan) for scan in scans_spaced(1.0)])
        scans = []
        for entry in entries:
            listed = scans_spaced((axis_metres(entry.units) or (1.0,))[0] * entry.scale)
            if entry.index >= len(listed):
                # The bounds in the file are not those of a scan that it has lost.
                return InputFile(path, [], _missing_text(entry, len(listed)))
            scan = place_scan(
                listed[entry.index], pose=entry.pose, units=entry.units, up=entry.up, scale=entry.scale
            )
            scan.crs = entry.crs or scan.crs
            scans.append(scan)
        return InputFile(path, scans)
    except ScanError as error:
        raise_transient(error, path)
        units = {entry.units for entry in entries or ()} or {""}
        moved = len(units) > 1 or any(
            (entry.up or "z", entry.scale) != ("z", 1.0) or entry.pose is not None for entry in entries or ()
        )
        # The header's bounds do not apply after a list has moved the scan.
        return InputFile(path, [], str(error), None if moved else header_bounds(path, units.pop()))
