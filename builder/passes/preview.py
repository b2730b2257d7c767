"""Preview of an archive: a few of its points as `preview.vtkhdf`, a file that ParaView opens."""

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.archive import Archive
from ...schemas.archive.index import Header
from ...schemas.archive.vtkhdf import PREVIEW_NAME, VtkPoints, read_points
from ...schemas.errors import CorruptError
from ...schemas.runtime.interrupts import check_interrupt
from ...schemas.runtime.new_hdf5_file import new_hdf5_file
from ..build_limits import MAX_PREVIEW_POINTS, PREVIEW_PART, WHOLE_PREVIEW_POINTS
from ..kernels.points.voxel_records import first_of_each, point_hashes
from ..run.executor import Executor, Progress, Silent, jobs_of, run_units, voxel_ranges
from ..voxel.record_points import hash_limit, iter_points, read_columns, record_columns, stored_columns

# Coordinates are rounded to this [m]: they then compress to 6 bytes a point instead of 19.
_ROUNDED = 2.0**-13


class _Unit(NamedTuple):
    """Voxels to select points from."""

    folder: Path
    rows: range
    share: float
    points: int


class _Chosen(NamedTuple):
    """Selected points. lattice: (n, 3) int64.  columns: (n,) by name."""

    lattice: NDArray[np.int64]
    columns: dict[str, NDArray]


def write_preview(folder: Path, executor: Executor | None = None, progress: Progress | None = None) -> int:
    """Write the preview of the archive in `folder`: distinct points, rounded to 2^-13 m.

    A hash of the lattice coordinates selects the points, so equal archives have equal previews,
    byte for byte. The preview contains the archive_id and the generation. It gets its name when it
    is complete. Return the number of points. Progress advances by the points of the archive. Raise
    CorruptError, OSError.
    """
    with Archive(folder) as archive:
        header, points = archive.header, archive.voxels["rows"][:, 2].astype(np.int64)
    most = min(MAX_PREVIEW_POINTS, max(WHOLE_PREVIEW_POINTS, header.points // PREVIEW_PART))
    # Five standard deviations below the limit: the random number of selected points hardly ever
    # exceeds it.
    share = 1.0 if header.points <= most else (most - 5 * math.sqrt(most)) / header.points
    units = [
        _Unit(folder, rows, share, int(points[rows.start : rows.stop].sum()))
        for rows in voxel_ranges(points, jobs_of(executor))
    ]
    results = run_units(executor, _choose, units, progress or Silent(), lambda unit: unit.points)
    found = sorted(zip(units, results, strict=True), key=lambda pair: pair[0].rows.start)
    chosen = _trimmed(_joined([part for _, part in found]), most)
    if not len(chosen.lattice):  # many points at few positions, none of them selected
        chosen = _choose(_Unit(folder, range(1), 1.0, 1))
        chosen = _Chosen(chosen.lattice[:1], {name: column[:1] for name, column in chosen.columns.items()})
    path = folder / PREVIEW_NAME
    with new_hdf5_file(path) as file:
        file.attrs["archive_id"] = np.frombuffer(header.archive_id, np.uint8)
        file.attrs["generation"] = np.uint32(header.generation)
        with VtkPoints(file, stored_columns(header), compressed=True) as out:
            world = header.lattice.to_world(chosen.lattice)
            out.append(np.rint(world / _ROUNDED) * _ROUNDED, chosen.columns)
    return len(chosen.lattice)


def preview_faults(folder: Path, header: Header) -> tuple[list[str], list[str]]:
    """Return the faults of the preview in `folder`, and notes on it.

    Both are empty without a preview.
    """
    path = folder / PREVIEW_NAME
    if not path.exists():
        return [], []
    try:
        found = read_points(path)
        stamp = found.attributes["archive_id"].tobytes(), int(found.attributes["generation"])
    except (CorruptError, OSError) as error:
        check_interrupt()
        return [str(error)], []
    except KeyError:
        return [f"{path}: does not name its archive and generation: delete it"], []
    if stamp != (header.archive_id, header.generation):
        return [], [f"{path}: belongs to another archive or generation"]
    low, high = header.lattice.to_world(np.stack([header.low, header.high]))
    outside = (found.points < low - _ROUNDED) | (found.points > high + _ROUNDED)
    if not 0 < len(found.points) <= MAX_PREVIEW_POINTS or outside.any():
        return [f"{path}: contains points that are not in the archive: delete it"], []
    return [], []


def _choose(unit: _Unit) -> _Chosen:
    """Select points of a range of voxels, one per position; runs in any process."""
    parts = []
    with Archive(unit.folder) as archive:
        columns = stored_columns(archive.header)
        base, limit = archive.coordinates * archive.header.lattice.voxel_steps, hash_limit(unit.share)
        for row in unit.rows:
            record = archive.open_voxel(row, columns=record_columns(columns))
            some = list(iter_points(record, base[row], limit=limit))
            if some:
                xyz, rows = np.concatenate([t.xyz for t in some]), np.concatenate([t.rows for t in some])
                first = first_of_each(xyz)
                parts.append(_Chosen(xyz[first] + base[row], read_columns(record, columns, rows[first])))
            del record  # free it before the next one is read
        nothing = {name: np.empty(0, kind) for name, kind in columns.items()}
    return _joined([_Chosen(np.empty((0, 3), np.int64), nothing), *parts])


def _joined(parts: list[_Chosen]) -> _Chosen:
    """Concatenate selections."""
    columns = {name: np.concatenate([p.columns[name] for p in parts]) for name in parts[0].columns}
    return _Chosen(np.concatenate([p.lattice for p in parts]), columns)


def _trimmed(chosen: _Chosen, most: int) -> _Chosen:
    """Keep at most `most` points: those with the smallest hashes."""
    if len(chosen.lattice) <= most:
        return chosen
    kept = np.sort(np.argsort(point_hashes(chosen.lattice), kind="stable")[:most])
    return _Chosen(chosen.lattice[kept], {name: column[kept] for name, column in chosen.columns.items()})
