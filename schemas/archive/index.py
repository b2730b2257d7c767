"""Content of an archive's index: the dataset as a whole, and every voxel. Pure: no HDF5 here.

Only this module names the index's datasets: `index_columns` makes them, `read_header` parses them,
`index_digest` computes their checksum. FORMAT.md, "index.h5", documents the same.
"""

import hashlib
import json
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NoReturn

import msgspec
import numpy as np
from numpy.typing import NDArray

from .radius_model import LOCAL_CLASSES, RADIUS_CLASSES, local_radii
from .voxel_grid import Lattice

# Default distance within which points contribute to a point's normal [m]: it covers some forty
# points of a façade as a scanner sees it, on an area no larger than a hand.
NORMAL_REACH = 0.08
# Beyond this, points do not belong to one surface. At steps of 0.1 mm, sums fit 63 bits for any
# voxel (normal_reach.py) [m].
MAX_NORMAL_REACH = 1.0

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


@dataclass(frozen=True, slots=True, eq=False)
class Source:
    """One scan that was built in, or was left out.

    index: index of the scan inside its file.  sha256: of the file.
    pose: (4, 4) float64, scan to world.
    count: points stored.  skipped: reason -> points left out.
    fault: why the whole scan was left out, or "".
    crs: text of the coordinate reference system that the file names, or "".
    units, up: the unit of length and the up axis assumed for the file; `pose` includes both.
    unknown: row of the header's `unknown` where a scan that was left out may have had points; -1 if
    that is not known; None: nothing was lost with it.
    one_place: all its points, two or more, lay at one place.
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

    archive_id: 16 bytes, determined by the points and options alone.
    low, high: (3,) int64, least and greatest lattice coordinates of the points, inclusive.
    radius: half the mean closest-point distance [m].
    radius_error: its standard error [m], 0 if all points were sampled.
    radius_sample: number of points sampled.
    moved_max: farthest distance that quantising moved a point along an axis [m].
    lattice_source: "sources", "given" or "default".
    models: the radius models stored, in the order of STORED_MODELS.
    radius_counts: (32,) int64, the points of each radius class, zeros if none are stored.
    radius_capped: points that had too few neighbours for a local class and were given the largest.
    options: the build's.
    unknown: (u, 2, 3) int64, lattice boxes, inclusive, of scans left out.
    unknown_everywhere: a scan was left out whose bounds are not known.
    generation: how often scans were added or removed since the build.
    radius_now: what `radius` would be if it were measured now; None in generation 0, where `radius`
    is that value, and if the radius was given.
    normal_reach: estimation distance of the points' normals [m] (kernels/normal_codes.py); 0: no
    normals.
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
    normal_reach: float = 0.0

    @property
    def radius_class(self) -> bool:
        """Return True if the points have a radius class."""
        return self.models != ("mean",)

    @property
    def normals(self) -> bool:
        """Return True if the points have a normal, or the code for "no normal"."""
        return self.normal_reach > 0

    @property
    def format_version(self) -> int:
        """Return the lowest format version that can represent this header."""
        if self.normals:
            return 4
        if self.generation:
            return 3
        return 2 if self.radius_class else 1


@dataclass(frozen=True, slots=True)
class LocalRadius:
    """Number of points that `local` gives a radius [m]."""

    radius: float
    points: int


@dataclass(frozen=True, slots=True)
class RadiusDistribution:
    """Distribution of an archive's radius classes.

    local: the radii that at least one point has, ascending; empty if `local` is not stored.
    capped: points that had too few neighbours for a local class and have the largest radius.
    rim: points on the rim of a surface.
    None: not stored.
    """

    local: tuple[LocalRadius, ...]
    capped: int | None
    rim: int | None


def radius_distribution(header: Header) -> RadiusDistribution | None:
    """Return the distribution of the radius classes; None for an archive without any."""
    if not header.radius_class:
        return None
    by_class = header.radius_counts.reshape(2, LOCAL_CLASSES)  # the second row: points on a rim
    local = zip(local_radii().tolist(), by_class.sum(axis=0).tolist(), strict=True)
    with_local = "local" in header.models
    return RadiusDistribution(
        tuple(LocalRadius(*held) for held in local if held[1]) if with_local else (),
        header.radius_capped if with_local else None,
        int(by_class[1].sum()) if "border" in header.models else None,
    )


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


def index_columns(header: Header, voxels: NDArray, shards: list[tuple[str, int]]) -> dict[str, NDArray]:
    """Return every dataset of the index by name, for writer, reader and digest alike."""
    lattice = header.lattice
    columns = [header.scan_index, header.intensity]
    classes = {}
    if header.radius_class or header.normals:
        columns += ["local" in header.models, "border" in header.models]
    if header.radius_class:
        classes = {
            "radius_counts": header.radius_counts.astype("<u8"),
            "radius_capped": np.array([header.radius_capped], "<u8"),
        }
    later: dict[str, NDArray] = {}
    if header.normals:
        columns += [True]
        later["normal_reach"] = np.array([header.normal_reach], "<f8")
    if header.generation:
        now = header.radius_now or RadiusNow(header.radius, header.radius_error, 0)
        later["generation"] = np.array([header.generation], "<u4")
        later["radius_now"] = np.array([now.radius, now.error, now.sample], "<f8")
    return {
        "origin": np.array(lattice.origin, "<f8"),
        "step": np.array([lattice.step], "<f8"),
        "voxel_steps": np.array([lattice.voxel_steps], "<u4"),
        "bounds": np.stack([header.low, header.high]).astype("<i8"),
        "points": np.array([header.points], "<u8"),
        "radius": np.array([header.radius, header.radius_error], "<f8"),
        "radius_sample": np.array([header.radius_sample], "<u8"),
        "moved_max": np.array([header.moved_max], "<f8"),
        "tree": np.array([header.degree, header.leaf], "<u4"),
        "columns": np.array(columns, "u1"),
        **classes,
        **later,
        "unknown": header.unknown.reshape(-1, 2, 3).astype("<i8"),
        "unknown_everywhere": np.array([header.unknown_everywhere], "u1"),
        "source_pose": np.array([s.pose for s in header.sources], "<f8").reshape(-1, 4, 4),
        "source_count": np.array([s.count for s in header.sources], "<u8"),
        "texts": np.frombuffer(_texts(header), "u1"),
        "shards": np.array(
            [(name.encode(), size) for name, size in shards], [("name", "S24"), ("bytes", "<u8")]
        ),
        "voxels": voxels,
    }


def index_digest(archive_id: bytes, columns: dict[str, NDArray]) -> bytes:
    """Return the SHA-256 over the id and every dataset of the index, names and shapes included."""
    digest = hashlib.sha256(archive_id)
    for name, column in sorted(columns.items()):
        digest.update(f"{name}:{column.dtype.str}:{column.shape}:".encode())
        digest.update(np.ascontiguousarray(column).tobytes())
    return digest.digest()


def _check_counts(counts: NDArray, capped: int, points: int) -> None:
    """Raise ValueError unless every point has exactly one radius class.

    Radii and the reach of a query depend on these counts.
    """
    counted = counts.tolist()
    if counts.shape != (RADIUS_CLASSES,) or min(counted) < 0 or sum(counted) != points or capped > points:
        raise ValueError(
            f"radius_counts {counted}, radius_capped {capped}: expected those of {points} points"
        )


def _normal_reach(columns: dict[str, NDArray]) -> float:
    """Return the estimation distance of the normals, 0 without normals.

    Raises ValueError if it is invalid.
    """
    if len(columns["columns"]) < 5:
        return 0.0
    reach = float(columns["normal_reach"][0])
    if not (0 < reach <= MAX_NORMAL_REACH and columns["columns"][4] == 1):
        raise ValueError(f"normal_reach {reach}: expected above 0, at most {MAX_NORMAL_REACH:g}")
    return reach


_Count = Annotated[int, msgspec.Meta(ge=0)]


class _SourceTexts(msgspec.Struct):
    """Texts of one source; see `Source`."""

    path: str
    index: _Count
    format: str
    sha256: str
    skipped: dict[str, _Count]
    fault: str
    crs: str = ""
    units: str = "m"
    up: str = "z"
    unknown: int | None = None
    one_place: bool = False


class _Texts(msgspec.Struct):
    """Content of `texts`; see `_texts`."""

    lattice_source: Literal["sources", "given", "default"]
    radius_model: Literal["mean", "given"]
    options: dict[str, Any]
    sources: list[_SourceTexts]


def _no_number(name: str) -> NoReturn:
    """Refuse NaN and infinity, which Python's JSON parser accepts as numbers."""
    raise ValueError(f"texts with {name}: expected JSON")


def _read_texts(columns: dict[str, NDArray]) -> _Texts:
    """Parse `texts` and compare it with the other datasets. Raises ValueError."""
    try:
        texts = msgspec.convert(
            json.loads(columns["texts"].tobytes(), parse_constant=_no_number), _Texts, strict=True
        )
    except (msgspec.ValidationError, RecursionError) as error:
        raise ValueError(f"texts: {error}") from error
    sources, boxes = len(texts.sources), len(columns["unknown"])
    if sources != len(columns["source_pose"]):
        raise ValueError(f"texts of {sources} sources: expected {len(columns['source_pose'])}")
    rows = [s.unknown for s in texts.sources if s.unknown is not None and s.unknown != -1]
    if len(set(rows)) < len(rows) or not all(0 <= row < boxes for row in rows):
        raise ValueError(f"sources with boxes {rows} of {boxes}: expected a different one each, or -1")
    if any(s.unknown == -1 for s in texts.sources) and not columns["unknown_everywhere"][0]:
        raise ValueError("unknown_everywhere 0: expected 1, as a source was left out that may be anywhere")
    return texts


def read_header(archive_id: bytes, columns: dict[str, NDArray]) -> Header:
    """Return the header from the index's datasets, which `check_columns` has accepted.

    Raises ValueError.
    """
    texts = _read_texts(columns)
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
    held = columns["columns"].astype(bool).tolist()
    models = ("mean", *(name for name, here in zip(("local", "border"), held[2:], strict=False) if here))
    counts, capped = np.zeros(RADIUS_CLASSES), 0
    if len(models) > 1:
        counts, capped = columns["radius_counts"], int(columns["radius_capped"][0])
        _check_counts(counts, capped, int(columns["points"][0]))
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
        normal_reach=_normal_reach(columns),
    )
