"""Export of points from an archive to LAS, LAZ, PLY or VTKHDF.

The export proceeds voxel by voxel, in the memory of one voxel.

A box is half open, low <= coordinate < high on each axis, as voxels are. Adjacent boxes therefore
share no point. Coordinates are the archive's, world = lattice * step + origin in float64, exact to
the last bit in PLY and VTKHDF, and as a LAS reader computes them (las_export.py). A file gets its
name once it is complete.
"""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.archive import Archive
from ...schemas.archive.index import Header
from ...schemas.archive.voxel_grid import MAX_COORDINATE, Lattice
from ...schemas.archive.vtkhdf import vtk_file
from ...schemas.errors import BadRequestError
from ...schemas.runtime.new_file import new_path
from ..run.executor import Progress, Silent
from ..voxel.record_points import PointBlock, iter_points, read_columns, record_columns, stored_columns
from .export_contents import Contents

# Properties of a colour in PLY.
_CHANNELS = ("red", "green", "blue")

FORMATS = ("laz", "las", "ply", "vtkhdf")


class ExportSummary(NamedTuple):
    """Result of an export. low, high: (3,) least and greatest coordinates [m]; None without points.

    notes: sentences about what the file does not contain, although a user might expect it.
    """

    file: Path
    format: str
    points: int
    bytes: int
    low: list[float] | None
    high: list[float] | None
    notes: tuple[str, ...]


class Writer(Protocol):
    """Writer of points (m, 3) int64 [lattice], the same as float64 [m], and their columns, (m,) or (m, 3)."""

    def append(
        self, lattice: NDArray[np.int64], world: NDArray[np.float64], columns: dict[str, NDArray]
    ) -> None:
        """Append points to the file."""
        ...


def export_archive(
    folder: Path,
    output: Path,
    *,
    box: tuple[float, ...] | None = None,
    form: str | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> ExportSummary:
    """Write the points of the archive in `folder` that lie in `box` to the file `output`.

    box: (x0, y0, z0, x1, y1, z1) [m], half open; None: all points.  form: one of FORMATS; None: by
    the suffix of `output`. A file without points is also valid. An archive that changes during the
    export is written in its initial state. Raise BadRequestError for an invalid box, format or
    output, or if the format cannot hold the points; CorruptError, FormatError, OSError.
    """
    output, progress = Path(output), progress or Silent()
    form = _format_of(output, form)
    if output.is_dir() or (output.exists() and not overwrite):
        raise BadRequestError(f"{output}: already exists: give another name, or --overwrite")
    if Path(folder).resolve() in output.resolve().parents:
        raise BadRequestError(
            f"{output}: inside the archive itself, expected a path outside: give another name"
        )
    if not output.parent.is_dir():
        found = "a file, expected a folder: give another name"
        raise BadRequestError(
            f"{output.parent}: {found if output.parent.exists() else 'no such folder: make it first'}"
        )
    with Archive(folder) as archive:
        limits = lattice_box(archive.header.lattice, box)
        base = archive.coordinates * archive.header.lattice.voxel_steps
        near = (base + archive.voxels["low"] <= limits[1]) & (base + archive.voxels["high"] >= limits[0])
        rows = np.flatnonzero(near.all(axis=1))
        points = archive.voxels["rows"][rows, 2].astype(np.int64)
        progress.start("look", int(points.sum()), "points")
        contents = _survey_points(archive, rows, base, limits, progress)
        progress.finish()
        notes = [] if contents.points else ["no point is in the box"]
        with new_path(output) as temporary:
            progress.start("export", contents.points, "points")
            with _writer(form, temporary, archive.header, contents, notes) as writer:
                _write_points(archive, rows, base, limits, contents, writer, progress)
            progress.finish()
        bounds = archive.header.lattice.to_world(np.stack([contents.low, contents.high])).tolist()
    low, high = bounds if contents.points else (None, None)
    return ExportSummary(output, form, contents.points, output.stat().st_size, low, high, tuple(notes))


def lattice_box(lattice: Lattice, box: tuple[float, ...] | None) -> NDArray[np.int64]:
    """Convert a half-open box to lattice coordinates (2, 3), both corners inclusive.

    box: (x0, y0, z0, x1, y1, z1) [m]; None: everything. The result holds exactly the points whose
    world coordinates lie in the box. Raise BadRequestError for an invalid box.
    """
    if box is None:
        return np.array([[-(1 << 62)] * 3, [1 << 62] * 3])
    low, high = np.array(box[:3], np.float64), np.array(box[3:], np.float64)
    if not (np.isfinite(low).all() and np.isfinite(high).all() and (low < high).all()):
        numbers = " ".join(f"{v:g}" for v in box)
        raise BadRequestError(f"--box {numbers}: expected x0 y0 z0 x1 y1 z1, each low below its high")
    return np.stack([_first_from(lattice, low), _first_from(lattice, high) - 1])


def _first_from(lattice: Lattice, corner: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the least lattice coordinate of each axis whose world coordinate reaches `corner`.

    corner: (3,) [m]. World coordinates are compared as rounded.
    """
    corner = np.clip(corner, -4 * MAX_COORDINATE, 4 * MAX_COORDINATE)
    guess = np.floor((corner - np.array(lattice.origin)) / lattice.step).astype(np.int64) - 4
    # World coordinates of lattice points never decrease. Their rounding shifts the guess by a few
    # steps at most.
    window = guess + np.arange(9)[:, None]
    world = lattice.to_world(window)
    return guess + (world < corner).sum(axis=0)


def _format_of(output: Path, form: str | None) -> str:
    """Return the requested format; raise BadRequestError for an unknown one."""
    found = (form or output.suffix.removeprefix(".")).lower()
    if found not in FORMATS:
        raise BadRequestError(f"{output}: format {found!r}, expected {', '.join(FORMATS)}: give --format")
    return found


def _blocks(
    archive: Archive, row: int, base: NDArray[np.int64], box: NDArray[np.int64], columns: dict[str, np.dtype]
) -> Iterator[tuple[PointBlock, dict[str, NDArray]]]:
    """Yield the points of one voxel in a box, with columns, a block at a time."""
    record = archive.open_voxel(row, columns=record_columns(columns))
    with archive.locating(row):
        for block in iter_points(record, base[row], box=box):
            yield block, read_columns(record, columns, block.rows)


def _survey_points(
    archive: Archive,
    rows: NDArray[np.int64],
    base: NDArray[np.int64],
    box: NDArray[np.int64],
    progress: Progress,
) -> Contents:
    """Scan the points to be written once. This takes 10 ns per point.

    Writing LAS takes 80 ns, LAZ 300 ns.
    """
    columns = stored_columns(archive.header)
    wanted = {name: kind for name, kind in columns.items() if name == "intensity"}
    points, whole = 0, True
    low, high = np.full(3, 1 << 62), np.full(3, -(1 << 62))
    for row in rows.tolist():
        for block, held in _blocks(archive, row, base, box, wanted):
            points += len(block.xyz)
            low = np.minimum(low, block.xyz.min(axis=0) + base[row])
            high = np.maximum(high, block.xyz.max(axis=0) + base[row])
            if "intensity" in held:
                values = held["intensity"]
                whole = whole and bool(
                    ((values >= 0) & (values <= 65535) & (values == np.rint(values))).all()
                )
        progress.advance(int(archive.voxels["rows"][row, 2]))
    if not points:
        low, high = np.zeros(3, np.int64), np.zeros(3, np.int64)
    return Contents(points, low, high, columns, whole)


def _write_points(
    archive: Archive,
    rows: NDArray[np.int64],
    base: NDArray[np.int64],
    box: NDArray[np.int64],
    contents: Contents,
    writer: Writer,
    progress: Progress,
) -> None:
    lattice = archive.header.lattice
    for row in rows.tolist():
        for block, columns in _blocks(archive, row, base, box, contents.columns):
            steps = block.xyz + base[row]
            writer.append(steps, lattice.to_world(steps), columns)
            progress.advance(len(steps))


class _VtkWriter:
    """VTKHDF file (vtkhdf.py) as a `Writer`; a context manager."""

    def __init__(self, path: Path, contents: Contents) -> None:
        self._file = vtk_file(path, contents.columns)

    def __enter__(self) -> "_VtkWriter":
        self._points = self._file.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        self._file.__exit__(*error)  # type: ignore[arg-type]  # passed on unchanged

    def append(
        self, lattice: NDArray[np.int64], world: NDArray[np.float64], columns: dict[str, NDArray]
    ) -> None:
        """Append points to the file."""
        self._points.append(world, columns)


class _PlyWriter:
    """Binary PLY file of doubles; a context manager. The number of vertices is known in advance."""

    _TYPES = {"<f4": "float", "<u2": "ushort", "|u1": "uchar"}  # noqa: RUF012  never changed

    def __init__(self, path: Path, contents: Contents) -> None:
        fields = [(axis, "<f8") for axis in "xyz"]
        for name, kind in contents.columns.items():
            fields += [(each, kind.base.str) for each in (_CHANNELS if name == "rgb" else (name,))]
        self._dtype = np.dtype(fields)
        names = "".join(f"property {self._TYPES.get(kind, 'double')} {name}\n" for name, kind in fields)
        head = f"ply\nformat binary_little_endian 1.0\nelement vertex {contents.points}\n{names}end_header\n"
        self._file = path.open("wb")
        self._file.write(head.encode("ascii"))

    def __enter__(self) -> "_PlyWriter":
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def append(
        self, lattice: NDArray[np.int64], world: NDArray[np.float64], columns: dict[str, NDArray]
    ) -> None:
        """Append points to the file."""
        rows = np.empty(len(world), self._dtype)
        for axis, name in enumerate("xyz"):
            rows[name] = world[:, axis]
        for name, column in columns.items():
            if name == "rgb":
                for channel, values in zip(_CHANNELS, column.T, strict=True):
                    rows[channel] = values
            else:
                rows[name] = column
        self._file.write(rows.data)


def _writer(
    form: str, path: Path, header: Header, contents: Contents, notes: list[str]
) -> AbstractContextManager[Writer]:
    """Return the writer of a format; append to `notes` what the format cannot hold."""
    if form in ("las", "laz"):
        from .las_export import LasWriter, wkt_of

        crs, note = wkt_of(header.sources)
        notes += [note] if note else []
        out = LasWriter(path, header.lattice, contents, crs, compressed=form == "laz")
        notes += out.notes
        return out
    makers: dict[str, Callable[[Path, Contents], AbstractContextManager[Writer]]] = {
        "ply": _PlyWriter,
        "vtkhdf": _VtkWriter,
    }
    return makers[form](path, contents)
