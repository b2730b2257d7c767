"""Files of points as VTKHDF PolyData (vertices only), which ParaView and VTK open as *.vtkhdf.

Besides the archive modules, this is the only user of h5py. The layout follows the VTKHDF file
format, version 2.0 (docs.vtk.org, "VTKHDF format specification"): a group `VTKHDF` with the
attributes Version and Type, `NumberOfPoints` and `Points`, four groups of cells of which only
`Vertices` is non-empty, and `PointData`. There is one partition. Data is written block by block, in
bounded memory, and without timestamps.
"""

import math
import zlib
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, Self

import h5py
import numpy as np
from numpy.typing import NDArray

from ..errors import CorruptError
from ..runtime.new_hdf5_file import NewHdf5File, hdf5_file

PREVIEW_NAME = "preview.vtkhdf"

GROUP = "VTKHDF"
_VERSION = (2, 0)
_CELLS = ("Vertices", "Lines", "Polygons", "Strips")
# Rows per chunk, the unit of compression and checksums.
_CHUNK = 1 << 15
# Limits of a file that `read_sample` reads, in rows and bytes: more than any preview has
# (builder/build_limits.py, MAX_PREVIEW_POINTS). The filters of its datasets.
_MAX_SAMPLE, _MAX_SAMPLE_BYTES = 1 << 18, 1 << 25
_FILTERS = (h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_FLETCHER32)
# For numbers that count upwards: shuffled, they compress to a hundredth.
_SMALL: dict[str, Any] = {"shuffle": True, "compression": "gzip", "compression_opts": 1}
# Compression with a checksum per chunk, so that a flipped bit is found.
_CHECKED: dict[str, Any] = {"shuffle": True, "compression": "gzip", "compression_opts": 6, "fletcher32": True}


class VtkPoints:
    """Writer of points to a file.

    A context manager: the file is complete if it exits without an error.
    """

    def __init__(self, file: h5py.File, columns: Mapping[str, np.dtype], *, compressed: bool) -> None:
        """Begin `/VTKHDF`.

        columns: dtypes of the point data besides the coordinates, by name.
        compressed: compress and add checksums; without, writing is six times as fast.
        """
        self._file, self._options = file, _CHECKED if compressed else {}
        self._root = file.create_group(GROUP, track_times=False)
        self._root.attrs["Version"] = np.array(_VERSION, "<i8")
        self._root.attrs["Type"] = np.bytes_("PolyData")  # of fixed length: VTK requires that
        self._points = self._make("Points", np.dtype("<f8"), (3,))
        data = self._root.create_group("PointData", track_times=False)
        self._columns = {
            name: self._make(f"{data.name}/{name}", kind.base.newbyteorder("<"), kind.shape)
            for name, kind in columns.items()
        }

    def __enter__(self) -> Self:
        """Return the writer."""
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Write the data that depends on the number of points."""
        if kind is None:
            self._finish()

    def _make(self, name: str, kind: np.dtype, tail: tuple[int, ...]) -> h5py.Dataset:
        """Create an empty dataset that can grow."""
        return self._root.create_dataset(
            name, (0, *tail), kind, maxshape=(None, *tail), chunks=(_CHUNK, *tail), **self._options
        )

    def append(self, points: NDArray[np.float64], columns: Mapping[str, NDArray]) -> None:
        """Append points (m, 3) [m] and all columns, (m,) or (m, 3). Raises OSError if a write failed."""
        for dataset, rows in [(self._points, points), *((d, columns[n]) for n, d in self._columns.items())]:
            begin = len(dataset)
            dataset.resize(begin + len(rows), axis=0)
            dataset[begin:] = rows
        if isinstance(self._file, NewHdf5File):
            self._file.check()  # HDF5 does not see write errors and would continue

    def _finish(self) -> None:
        """Write the cells, one vertex per point, and all counts."""
        count = len(self._points)
        self._count(self._root, "NumberOfPoints", count)
        for name in _CELLS:
            group = self._root.create_group(name, track_times=False)
            held = count if name == "Vertices" else 0
            self._count(group, "NumberOfCells", held)
            self._count(group, "NumberOfConnectivityIds", held)
            for numbers, rows in (("Connectivity", held), ("Offsets", held + 1)):
                chunks = {"chunks": (min(rows, _CHUNK),), **(self._options or _SMALL)} if rows else {}
                dataset = group.create_dataset(numbers, (rows,), "<i8", **chunks)
                for begin in range(0, rows, _CHUNK):
                    end = min(begin + _CHUNK, rows)
                    dataset[begin:end] = np.arange(begin, end)

    @staticmethod
    def _count(group: h5py.Group, name: str, count: int) -> None:
        """Write a count of the only partition."""
        group.create_dataset(name, data=np.array([count], "<i8"))


@contextmanager
def vtk_file(path: Path, columns: Mapping[str, np.dtype]) -> Iterator[VtkPoints]:
    """Create an uncompressed file of points, under a name that `new_path` gave.

    Raises OSError, for example if the disk is full.
    """
    with hdf5_file(path) as file, VtkPoints(file, columns, compressed=False) as points:
        yield points


class PointsRead(NamedTuple):
    """Content of a file of points.

    points: (n, 3) [m].  columns: (n,) by name.  attributes: of the file's root.
    """

    points: NDArray[np.float64]
    columns: dict[str, NDArray]
    attributes: dict[str, NDArray]


def read_points(path: Path) -> PointsRead:
    """Read a file that `VtkPoints` wrote.

    Raises CorruptError for anything else, OSError if the file cannot be opened.
    """
    with open(path, "rb"):
        pass  # HDF5's OSError does not give the reason
    try:
        with h5py.File(path, "r") as file:
            return _read(file)
    except (OSError, KeyError, ValueError, TypeError, AttributeError, RuntimeError) as error:
        raise CorruptError(f"{path}: not a complete file of points ({error}): write it anew") from error


def read_sample(path: Path, columns: Mapping[str, np.dtype], attributes: Collection[str]) -> PointsRead:
    """Read points, some of their columns, and some attributes of a small file, in bounded memory.

    Nothing is read before its size is known, and the cells are not looked at.
    Raises CorruptError for a file that lacks one of them or is larger than a preview, OSError if
    the file cannot be opened.
    """
    if (size := path.stat().st_size) > _MAX_SAMPLE_BYTES:
        raise CorruptError(f"{path}: {size} bytes, expected at most {_MAX_SAMPLE_BYTES}: write it anew")
    try:
        with h5py.File(path, "r") as file:
            root = file[GROUP]
            points = _read_rows(root["Points"], np.dtype(("<f8", 3)), None)
            found = {
                name: _read_rows(root["PointData"][name], kind, len(points)) for name, kind in columns.items()
            }
            return PointsRead(points, found, {name: _read_attribute(file, name) for name in attributes})
    except (
        OSError,
        KeyError,
        ValueError,
        TypeError,
        AttributeError,
        RuntimeError,
        zlib.error,
    ) as error:
        raise CorruptError(f"{path}: not a complete file of points ({error}): write it anew") from error


def _read_rows(dataset: h5py.Dataset, kind: np.dtype, rows: int | None) -> NDArray:
    """Read a dataset of a dtype that `VtkPoints` wrote compressed. Raises ValueError for another one.

    rows: expected number; None: any up to `_MAX_SAMPLE`.
    HDF5 would inflate a chunk to whatever it holds. Here it cannot grow beyond its size.
    """
    shape, tail = dataset.shape, kind.shape
    if dataset.dtype != kind.base or dataset.chunks != (_CHUNK, *tail) or shape[1:] != tail:
        raise ValueError(f"{dataset.name}: {dataset.dtype} {shape} in chunks of {dataset.chunks}")
    count = shape[0]
    if count != (min(count, _MAX_SAMPLE) if rows is None else rows):
        raise ValueError(f"{dataset.name}: {count} rows, expected {_MAX_SAMPLE if rows is None else rows}")
    properties = dataset.id.get_create_plist()
    if tuple(properties.get_filter(i)[0] for i in range(properties.get_nfilters())) != _FILTERS:
        raise ValueError(f"{dataset.name}: other filters than {_FILTERS}")
    found, width = np.empty(shape, kind.base), kind.base.itemsize
    size = _CHUNK * kind.itemsize
    for begin in range(0, count, _CHUNK):
        mask, stored = dataset.id.read_direct_chunk((begin, *(0 for _ in tail)))
        inflater = zlib.decompressobj()
        # Its Adler-32 is in front of the last four bytes, the checksum of HDF5.
        data = inflater.decompress(stored[:-4], size + 1)
        if mask or len(data) != size or not inflater.eof:
            raise ValueError(f"{dataset.name}: a chunk that is not {size} bytes")
        block = np.frombuffer(data, np.uint8).reshape(width, -1).T  # undoes the shuffle
        block = np.ascontiguousarray(block).view(kind.base).reshape(_CHUNK, *tail)
        found[begin : begin + _CHUNK] = block[: count - begin]
    return found


def _read_attribute(file: h5py.File, name: str) -> NDArray:
    """Read an attribute of a few numbers. Raises ValueError, or KeyError if it does not exist."""
    if name not in file.attrs:
        raise KeyError(name)
    attribute = file.attrs.get_id(name)
    if attribute.dtype.kind != "u" or math.prod(attribute.shape) > _CHUNK:
        raise ValueError(f"attribute {name} {attribute.dtype} {attribute.shape}")
    return np.asarray(file.attrs[name])


def _read(file: h5py.File) -> PointsRead:
    """Read an open file; raise ValueError or another exception for content that is never written."""
    root = file[GROUP]
    if bytes(root.attrs["Type"]) != b"PolyData" or int(root.attrs["Version"][0]) != _VERSION[0]:
        raise ValueError("not PolyData of version 2")
    count = int(root["NumberOfPoints"][0])
    points = root["Points"][()]
    columns = {name: column[()] for name, column in root["PointData"].items()}
    for name in _CELLS:
        held = count if name == "Vertices" else 0
        group = root[name]
        if (
            [int(group[n][0]) for n in ("NumberOfCells", "NumberOfConnectivityIds")] != [held, held]
            or not np.array_equal(group["Connectivity"][()], np.arange(held))
            or not np.array_equal(group["Offsets"][()], np.arange(held + 1))
        ):
            raise ValueError(f"{name} are not one vertex per point")
    if points.shape != (count, 3) or points.dtype != "<f8" or any(len(c) != count for c in columns.values()):
        raise ValueError(f"{len(points)} points, expected {count}")
    return PointsRead(points, columns, dict(file.attrs))
