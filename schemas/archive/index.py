"""Content of an archive's index: the dataset as a whole, and every voxel. Pure: no HDF5 here.

`INDEX_COLUMNS` declares the index's datasets. `index_columns` makes them of a `Header`,
`read_header` parses them, `index_digest` computes their checksum. index_limits.py checks their
numbers. FORMAT.md, "index.h5", documents the same; change both together.
"""

import hashlib
import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .codec import point_dtype
from .index_texts import read_texts
from .radius_model import RADIUS_CLASSES
from .voxel_grid import Lattice

# Names of an archive's files, and of the datasets of each record in a shard.
INDEX_NAME = "index.h5"
SHARD_FOLDER = "shards"
SHARD_NAME = re.compile(r"[0-9]{1,9}-[0-9]{1,9}\.h5")
DATASETS = ("cells", "nodes", "points")
# Versions that this software reads. It writes the lowest version that can represent the header.
FORMAT_VERSIONS = (1, 2, 3, 5)

# Most flags of the dataset `columns`; an index without the last columns has fewer.
COLUMN_FLAGS = 7

SHARD_DTYPE = np.dtype([("name", "S24"), ("bytes", "<u8")])
# One row per voxel, sorted by key.
# frame_*: place of each dataset's only chunk in its shard, in the order of DATASETS.
# frame_checksum: the last four bytes of the zstd frame, so that a wrong offset cannot deliver
# another frame.
# leaves: leaf nodes, so that a server knows a voxel's decoded size before it loads it.
VOXEL_DTYPE = np.dtype(
    [
        ("key", "<u8"),
        ("shard", "<u4"),
        ("frame_offset", "<u8", (3,)),
        ("frame_bytes", "<u4", (3,)),
        ("frame_checksum", "<u4", (3,)),
        ("rows", "<u4", (3,)),
        ("leaves", "<u4"),
        ("low", "<i4", (3,)),
        ("high", "<i4", (3,)),
    ]
)


def shard_name(number: int, generation: int = 0) -> str:
    """Return the file name of a shard inside SHARD_FOLDER."""
    return f"{generation}-{number:06d}.h5"


@dataclass(frozen=True, slots=True, eq=False)
class Source:
    """One scan that was built in, or was left out.

    index: index of the scan inside its file.  sha256: of the file.
    pose: (4, 4) float64, scan to world.
    count: points stored.  skipped: reason -> points left out.
    fault: why the whole scan was left out or removed, or "".
    crs: text of the coordinate reference system that the file names, or "".
    units, up: the unit of length and the up axis assumed for the file; `pose` includes both.
    unknown: row of `Header.unknown` with the box where a scan that was left out may have had
    points; -1 if its bounds are not known; None if no points are missing.
    one_place: whether all its points, two or more, were at one place.
    """

    path: str
    index: int
    format: str
    sha256: str
    count: int
    pose: NDArray[np.float64]
    skipped: dict[str, int]
    fault: str = ""
    crs: str = ""
    units: str = "m"
    up: str = "z"
    unknown: int | None = None
    one_place: bool = False


# Fields of a source that texts contain only if they differ from the default, so that archives
# without them keep their bytes.
_OPTIONAL = {"crs": "", "units": "m", "up": "z", "unknown": None, "one_place": False}


@dataclass(frozen=True, slots=True)
class RadiusNow:
    """Radius measured over the points of this generation.

    radius: half the mean closest-point distance [m].  error: its standard error [m].
    sample: number of points sampled.
    """

    radius: float
    error: float
    sample: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Header:
    """Index data of the dataset as a whole.

    archive_id: 16 bytes that depend only on the points and options.
    low, high: (3,) int64, least and greatest lattice coordinates of the points, inclusive.
    radius: half the mean closest-point distance [m].  radius_sample: number of points sampled.
    radius_error: its standard error [m], 0 if all points were sampled.
    moved_max: farthest distance that quantising moved a point along an axis [m].  lattice_source:
    "sources", "given" or "default".
    models: the stored radius models, in the order of STORED_MODELS.  options: of the build.
    radius_counts: (32,) int64, points of each radius class; zeros if none are stored.
    radius_capped: number of points with too few neighbours for a local class, which have the
    largest.
    unknown: (u, 2, 3) int64, lattice boxes, inclusive, of scans that were left out.
    unknown_everywhere: whether a scan with unknown bounds was left out.
    generation: how often scans were added or removed since the build.
    radius_now: `radius` as measured over the points of this generation; None in generation 0, where
    it equals `radius`, and if the radius was given.
    is_level: whether the points and classes are those of a level (level.py).
    rgb, classification: whether the points have these columns.
    """

    archive_id: bytes
    lattice: Lattice
    lattice_source: str
    points: int
    low: NDArray[np.int64]
    high: NDArray[np.int64]
    radius: float
    radius_model: str
    radius_error: float
    radius_sample: int
    moved_max: float
    degree: int
    leaf: int
    scan_index: bool
    intensity: bool
    models: tuple[str, ...]
    radius_counts: NDArray[np.int64]
    radius_capped: int
    options: dict[str, Any]
    sources: tuple[Source, ...]
    unknown: NDArray[np.int64]
    unknown_everywhere: bool
    generation: int = 0
    radius_now: RadiusNow | None = None
    is_level: bool = False
    rgb: bool = False
    classification: bool = False

    @property
    def listed_sources(self) -> int:
        """Return the number of sources that an archive lists: those up to the last one that was built.

        A source that was left out before it keeps its row, because a point's `scan_index` is a row
        of the list.
        """
        return max((number for number, s in enumerate(self.sources, 1) if not s.fault), default=0)

    @property
    def radius_class(self) -> bool:
        """Return True if the points have a radius class, or the cover class of a level."""
        return self.models != ("mean",) or self.is_level

    @property
    def point_dtype(self) -> np.dtype:
        """Return the row dtype of the points dataset."""
        return point_dtype(
            scan_index=self.scan_index,
            intensity=self.intensity,
            radius_class=self.radius_class,
            rgb=self.rgb,
            classification=self.classification,
        )

    @property
    def format_version(self) -> int:
        """Return the lowest format version that can represent this header."""
        if self.is_level or self.rgb or self.classification:
            return 5
        if self.generation:
            return 3
        return 2 if self.radius_class else 1


def _texts(header: Header) -> bytes:
    """Encode the texts and options of the header as canonical JSON.

    Floats whose bits matter are not part of it.
    """
    sources = [
        {
            "path": s.path,
            "index": s.index,
            "format": s.format,
            "sha256": s.sha256,
            "skipped": s.skipped,
            "fault": s.fault,
            **{name: getattr(s, name) for name, usual in _OPTIONAL.items() if getattr(s, name) != usual},
        }
        for s in header.sources
    ]
    document = {
        "lattice_source": header.lattice_source,
        "radius_model": header.radius_model,
        "options": header.options,
        "sources": sources,
    }
    return json.dumps(document, sort_keys=True, separators=(",", ":")).encode()


def _point_columns(header: Header) -> list[bool]:
    """Return a flag for each optional column of the points (`columns` in FORMAT.md)."""
    classes = ["local" in header.models, "border" in header.models]
    flags = [header.scan_index, header.intensity, *classes, False, header.rgb, header.classification]
    # As many as are needed, so that archives without the later columns keep their bytes.
    return flags[: next((n for n, last in ((7, flags[5:]), (4, classes)) if any(last)), 2)]


def _radius_now(header: Header) -> list[float]:
    now = header.radius_now or RadiusNow(header.radius, header.radius_error, 0)
    return [now.radius, now.error, now.sample]


class IndexColumn(NamedTuple):
    """Dataset of the index.

    dtype, shape: as stored; -1 stands for any length.
    values: function that returns its values from the header; None: they are arguments of
    `index_columns`.
    requires: property of the header that must be true for the dataset to exist; "" if every index
    has it.
    """

    dtype: np.dtype
    shape: tuple[int, ...]
    values: Callable[[Header], ArrayLike] | None = None
    requires: str = ""


_F8, _I8, _U8, _U4, _U1 = (np.dtype(name) for name in ("<f8", "<i8", "<u8", "<u4", "|u1"))

# Every dataset that an index may have, in the order in which they are written. To add one, add a
# row, a field of `Header` (which builder/passes/dataset_header.py fills in), a line in
# `read_header`, a check in index_limits.py and a row in FORMAT.md.
INDEX_COLUMNS = {
    "origin": IndexColumn(_F8, (3,), lambda header: header.lattice.origin),
    "step": IndexColumn(_F8, (1,), lambda header: header.lattice.step),
    "voxel_steps": IndexColumn(_U4, (1,), lambda header: header.lattice.voxel_steps),
    "bounds": IndexColumn(_I8, (2, 3), lambda header: np.stack([header.low, header.high])),
    "points": IndexColumn(_U8, (1,), lambda header: header.points),
    "radius": IndexColumn(_F8, (2,), lambda header: [header.radius, header.radius_error]),
    "radius_sample": IndexColumn(_U8, (1,), lambda header: header.radius_sample),
    "moved_max": IndexColumn(_F8, (1,), lambda header: header.moved_max),
    "tree": IndexColumn(_U4, (2,), lambda header: [header.degree, header.leaf]),
    "columns": IndexColumn(_U1, (-1,), _point_columns),
    "radius_counts": IndexColumn(_U8, (RADIUS_CLASSES,), lambda header: header.radius_counts, "radius_class"),
    "radius_capped": IndexColumn(_U8, (1,), lambda header: header.radius_capped, "radius_class"),
    "level": IndexColumn(_U1, (1,), lambda header: header.is_level, "is_level"),
    "generation": IndexColumn(_U4, (1,), lambda header: header.generation, "generation"),
    "radius_now": IndexColumn(_F8, (3,), _radius_now, "generation"),
    "unknown": IndexColumn(_I8, (-1, 2, 3), lambda header: header.unknown),
    "unknown_everywhere": IndexColumn(_U1, (1,), lambda header: header.unknown_everywhere),
    "source_pose": IndexColumn(_F8, (-1, 4, 4), lambda header: [s.pose for s in header.sources]),
    "source_count": IndexColumn(_U8, (-1,), lambda header: [s.count for s in header.sources]),
    "texts": IndexColumn(_U1, (-1,), lambda header: np.frombuffer(_texts(header), _U1)),
    "shards": IndexColumn(SHARD_DTYPE, (-1,)),
    "voxels": IndexColumn(VOXEL_DTYPE, (-1,)),
}


def index_columns(header: Header, voxels: NDArray, shards: list[tuple[str, int]]) -> dict[str, NDArray]:
    """Return every dataset of an index by name.

    voxels: VOXEL_DTYPE rows sorted by key.
    shards: name and bytes of each, in the order of their numbers.
    """
    tables = {
        "shards": np.array([(name.encode(), size) for name, size in shards], SHARD_DTYPE),
        "voxels": voxels,
    }
    columns = {}
    for name, column in INDEX_COLUMNS.items():
        if column.values is None:
            columns[name] = tables[name]
        elif not column.requires or getattr(header, column.requires):
            value = np.asarray(column.values(header), column.dtype)
            # Any other array keeps its shape, so that a reader refuses a wrong one.
            columns[name] = value if value.ndim and value.size else value.reshape(column.shape)
    return columns


def index_digest(archive_id: bytes, columns: dict[str, NDArray]) -> bytes:
    """Return the SHA-256 over the id and every dataset of the index, names and shapes included."""
    digest = hashlib.sha256(archive_id)
    for name, column in sorted(columns.items()):
        digest.update(f"{name}:{column.dtype.str}:{column.shape}:".encode())
        digest.update(np.ascontiguousarray(column).tobytes())
    return digest.digest()


def read_header(archive_id: bytes, columns: dict[str, NDArray]) -> Header:
    """Make the header from the index's datasets, which `check_columns` has checked.

    Raises ValueError.
    """
    texts = read_texts(columns)
    counts = columns["source_count"]
    sources = tuple(
        Source(
            s.path, s.index, s.format, s.sha256, int(counts[i]), columns["source_pose"][i], s.skipped, s.fault,
            s.crs, s.units, s.up, s.unknown, s.one_place,
        )
        for i, s in enumerate(texts.sources)
    )  # fmt: skip
    x, y, z = (float(v) for v in columns["origin"])
    generation, now = 0, None
    if "generation" in columns:
        generation = int(columns["generation"][0])
        radius, error, sample = (float(v) for v in columns["radius_now"])
        now = RadiusNow(radius, error, int(sample)) if sample else None
    flags = columns["columns"].astype(bool)
    held = np.pad(flags, (0, COLUMN_FLAGS - len(flags))).tolist()
    models = ("mean", *(name for name, here in zip(("local", "border"), held[2:4], strict=True) if here))
    counts, capped = np.zeros(RADIUS_CLASSES), 0
    if "radius_counts" in columns:
        counts, capped = columns["radius_counts"], int(columns["radius_capped"][0])
    return Header(
        archive_id=archive_id,
        lattice=Lattice((x, y, z), float(columns["step"][0]), int(columns["voxel_steps"][0])),
        lattice_source=texts.lattice_source,
        points=int(columns["points"][0]),
        low=columns["bounds"][0].astype(np.int64),
        high=columns["bounds"][1].astype(np.int64),
        radius=float(columns["radius"][0]),
        radius_model=texts.radius_model,
        radius_error=float(columns["radius"][1]),
        radius_sample=int(columns["radius_sample"][0]),
        moved_max=float(columns["moved_max"][0]),
        degree=int(columns["tree"][0]),
        leaf=int(columns["tree"][1]),
        scan_index=held[0],
        intensity=held[1],
        models=models,
        radius_counts=counts.astype(np.int64),
        radius_capped=capped,
        options=texts.options,
        sources=sources,
        unknown=columns["unknown"].astype(np.int64),
        unknown_everywhere=bool(columns["unknown_everywhere"][0]),
        generation=generation,
        radius_now=now,
        is_level="level" in columns,
        rgb=held[5],
        classification=held[6],
    )
