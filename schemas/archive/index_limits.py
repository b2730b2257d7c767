"""Checks of the numbers in an index, made before anything uses them.

A checksum proves that an index was not altered after it was written. It does not prove that its
writer was correct: a forger computes a new checksum. `check_layout` checks types and shapes before
data is read, `check_columns` and `check_voxels` check every number. FORMAT.md, "What a reader
checks", lists the same; change both together. All functions raise ValueError naming the dataset,
what was found and what was expected.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .codec import CELL_DTYPE, CELL_EXPANSION, NODE_DTYPE, NODE_EXPANSION
from .index import COLUMN_FLAGS, INDEX_COLUMNS
from .voxel import MAX_DEGREE, MAX_LEAF, MAX_LEVELS, MIN_DEGREE
from .voxel_grid import MAX_COORDINATE, MAX_VOXEL_STEPS, MIN_STEP, voxel_coordinates
from .zstd_frame import ANY_EXPANSION

_OPTIONAL = {name: column.requires for name, column in INDEX_COLUMNS.items() if column.requires}

# Limits of the texts of a dataset and of each source [bytes]. A source's text is a path, a
# coordinate reference system and a few words. JSON takes about 10 ms per megabyte.
_MAX_TEXT, _MAX_TEXT_A_SOURCE = 1 << 20, 1 << 18
# Boxes of scans that were left out may lie anywhere; the differences of their corners fit int64.
_MAX_LATTICE = 1 << 61
# Above this, float64 does not represent every integer.
_MAX_SAMPLE = 1 << 53
# Links are int32 (schemas/archive/voxel.py).
_MAX_ROWS = (1 << 31) - 1
# The shortest zstd frame: magic number, header, one block and checksum.
_MIN_FRAME_BYTES = 13


def _refuse(what: str, found: Any, expected: str) -> None:
    """Raise ValueError for an invalid value."""
    raise ValueError(f"{what} {found}: expected {expected}")


def check_layout(name: str, dtype: np.dtype, shape: tuple[int, ...]) -> None:
    """Check the type and shape of one dataset, before it is read."""
    known = INDEX_COLUMNS.get(name)
    if known is None:
        _refuse("dataset", repr(name), f"one of {', '.join(INDEX_COLUMNS)}")
    assert known is not None
    kind, lengths = known.dtype, known.shape
    fits = len(shape) == len(lengths) and all(n in (m, -1) for n, m in zip(lengths, shape, strict=True))
    if dtype != kind or not fits:
        _refuse(name, f"{dtype.str} {shape}", f"{kind.str} {lengths}")


def check_columns(version: int, columns: dict[str, NDArray]) -> None:
    """Check every number of an index that describes the dataset as a whole.

    columns: datasets that `check_layout` accepts and whose checksum is correct.
    """
    missing = [name for name in INDEX_COLUMNS if name not in columns and name not in _OPTIONAL]
    if missing:
        _refuse("datasets", "without " + ", ".join(missing), "all of them")
    _check_lattice(columns)
    _check_point_columns(version, columns)
    _check_radius(columns)
    _check_sources(columns)


def _numbers(columns: dict[str, NDArray], name: str, low: float, high: float) -> list[Any]:
    """Return the values of a dataset; raise ValueError unless all are from low to high.

    NaN is refused.
    """
    values = columns[name]
    if not ((values >= low) & (values <= high)).all():
        _refuse(name, values.tolist(), f"numbers from {low:g} to {high:g}")
    found: list[Any] = values.tolist()
    return found


def _check_lattice(columns: dict[str, NDArray]) -> None:
    """Check origin, step, voxels and bounds.

    Kernels convert them to int64 multiples of 2^-26 m without further checks.
    """
    origin = np.array(_numbers(columns, "origin", -MAX_COORDINATE, MAX_COORDINATE))
    (step,) = _numbers(columns, "step", MIN_STEP, MAX_COORDINATE)
    (steps,) = _numbers(columns, "voxel_steps", 1, MAX_VOXEL_STEPS)
    if steps * step > 2 * MAX_COORDINATE:
        _refuse("step and voxel_steps", [step, steps], f"voxels of at most {2 * MAX_COORDINATE:g} m")
    bounds = columns["bounds"]
    # Corners are compared in float64, because the int64 product could overflow. The tolerance of
    # one step is larger than the rounding error.
    world = bounds.astype(np.float64) * step + origin
    if (bounds[0] > bounds[1]).any() or not (np.abs(world) <= MAX_COORDINATE + step).all():
        _refuse("bounds", bounds.tolist(), f"low up to high, within {MAX_COORDINATE:g} m")
    _numbers(columns, "moved_max", 0.0, step)
    unknown = columns["unknown"]
    if (
        (unknown[:, 0] > unknown[:, 1]).any()
        or (unknown < -_MAX_LATTICE).any()
        or (unknown > _MAX_LATTICE).any()
    ):
        _refuse("unknown", "with an inverted or too distant box", "low up to high, within 2^61")
    _numbers(columns, "unknown_everywhere", 0, 1)


def _check_point_columns(version: int, columns: dict[str, NDArray]) -> None:
    """Check the point columns, the datasets that they require, and the resulting format version."""
    kept = _numbers(columns, "columns", 0, 1)
    classes, later = any(kept[2:4]), "generation" in columns
    colours, is_level = any(kept[5:]), "level" in columns
    if any(kept[4:5]) or len(kept) != (COLUMN_FLAGS if colours else 4 if classes else 2):
        _refuse("columns", kept, "2 flags, 4 with radius classes, 7 with rgb or classification, the fifth 0")
    if is_level and (kept[0] or classes or columns["level"][0] != 1):
        _refuse(
            "level and columns",
            [*columns["level"].tolist(), *kept],
            "1, and no column but intensity, rgb, classification",
        )
    held = {"radius_class": classes or is_level, "generation": later, "is_level": is_level}
    if any((name in columns) != held[requires] for name, requires in _OPTIONAL.items()):
        _refuse("datasets", [name for name in _OPTIONAL if name in columns], f"those of columns {kept}")
    expected = 5 if is_level or colours else 3 if later else 2 if classes else 1
    if version != expected:
        _refuse("format_version", version, f"{expected}, from the datasets")
    degree, leaf = columns["tree"].tolist()
    if not (MIN_DEGREE <= degree <= MAX_DEGREE and 1 <= leaf <= MAX_LEAF):
        _refuse("tree", [degree, leaf], f"{MIN_DEGREE} to {MAX_DEGREE}, 1 to {MAX_LEAF}")


def _check_radius(columns: dict[str, NDArray]) -> None:
    """Check the numbers that determine the sizes of spheres.

    Radii that are too small would turn contacts into clear.
    """
    _numbers(columns, "radius", 0.0, MAX_COORDINATE)
    (points,) = _numbers(columns, "points", 1, 1 << 62)
    # `radius_sample` is that of the build. In a later generation it may exceed the number of
    # points, because points were removed.
    _numbers(columns, "radius_sample", 0, _MAX_SAMPLE if "generation" in columns else points)
    if "radius_counts" in columns:
        # Every point has exactly one radius class. Radii and the reach of a query depend on these
        # counts.
        counts, capped = columns["radius_counts"].tolist(), int(columns["radius_capped"][0])
        if sum(counts) != points or capped > points:
            _refuse(f"radius_counts {counts}, radius_capped", capped, f"those of {points} points")
    if "radius_now" in columns:
        _numbers(columns, "generation", 1, (1 << 32) - 1)
        radius, error, sample = columns["radius_now"].tolist()
        fits = 0 <= radius <= MAX_COORDINATE and 0 <= error <= MAX_COORDINATE
        if not (fits and 0 <= sample <= points and sample == math.floor(sample)):
            _refuse("radius_now", [radius, error, sample], "a radius, its error, and points sampled")


def _check_sources(columns: dict[str, NDArray]) -> None:
    """Check poses and counts of the scans, and the length of their texts before JSON is parsed."""
    pose, count = columns["source_pose"], columns["source_count"]
    if not np.isfinite(pose).all() or (len(pose) and (pose[:, 3] != (0.0, 0.0, 0.0, 1.0)).any()):
        _refuse("source_pose", "with a matrix that is not a pose", "finite numbers, last row 0 0 0 1")
    points = int(columns["points"][0])
    if len(count) != len(pose) or sum(count.tolist()) != points:
        _refuse(
            "source_count",
            f"of {len(count)} sources, {sum(count.tolist())} points",
            f"of {len(pose)}, {points}",
        )
    if columns["columns"][0] and len(count) > 1 << 16:
        _refuse("source_count", f"of {len(count)} sources", "at most 65536, as scan_index has 16 bits")
    most = _MAX_TEXT + _MAX_TEXT_A_SOURCE * len(count)
    if len(columns["texts"]) > most:
        _refuse("texts", f"of {len(columns['texts'])} bytes", f"at most {most}")


def check_voxels(columns: dict[str, NDArray], point_bytes: int) -> None:
    """Check every number of an index that describes one voxel, also against those of the dataset.

    columns: checked with `check_columns`.  point_bytes: size of a row of the points dataset.
    """
    voxels, sizes = columns["voxels"], columns["shards"]["bytes"]
    key = voxels["key"]
    if (
        not len(voxels)
        or (voxels["shard"] >= len(sizes)).any()
        or (key[1:] <= key[:-1]).any()
        # Three coordinates of 21 bits: with one more bit, two keys would denote one voxel.
        or key[-1] >= 1 << 63
    ):
        _refuse("voxels", "is inconsistent", "ascending keys of 63 bits, shards that exist")
    _check_frames(voxels, sizes[voxels["shard"]])
    _check_rows(columns, point_bytes)
    _check_bounds(columns)


def _at(voxels: NDArray, wrong: NDArray[np.bool_]) -> str:
    """Return the name of the first voxel with a fault, for messages.

    wrong: (v,) or (v, k), mask of faults.
    """
    row = int(np.flatnonzero(wrong.reshape(len(voxels), -1).any(axis=1))[0])
    return f"voxel {voxels['key'][row]:#x}"


def _check_frames(voxels: NDArray, sizes: NDArray[np.uint64]) -> None:
    """Check that frames lie inside their shards, and that no two of them share a byte.

    sizes: (v,), the length of each voxel's shard [bytes].
    """
    offset, length = voxels["frame_offset"], voxels["frame_bytes"].astype(np.uint64)
    room = sizes[:, None]
    beyond = (length > room) | (offset > room - np.minimum(length, room))  # a sum would overflow
    if beyond.any():
        _refuse(_at(voxels, beyond), "points beyond a shard's end", "frames inside their shards")
    if (short := length < _MIN_FRAME_BYTES).any():
        _refuse(_at(voxels, short), f"with a frame under {_MIN_FRAME_BYTES} bytes", "whole frames")
    shard = np.repeat(voxels["shard"], 3)
    begin, end = offset.ravel(), (offset + length).ravel()
    order = np.lexsort((begin, shard))
    shard, begin, end = shard[order], begin[order], end[order]
    shared = (shard[1:] == shard[:-1]) & (begin[1:] < end[:-1])
    if shared.any():
        row = int(order[np.flatnonzero(shared)[0]]) // 3
        _refuse(f"voxel {voxels['key'][row]:#x}", "shares bytes with another frame", "disjoint frames")


def _check_rows(columns: dict[str, NDArray], point_bytes: int) -> None:
    """Check row counts against the dataset's points, the shape of trees, and the frames' sizes."""
    voxels = columns["voxels"]
    rows, leaves = voxels["rows"].astype(np.int64), voxels["leaves"].astype(np.int64)
    cells, nodes, points = rows.T
    wrong = (
        (cells < 1)
        | (leaves < cells)
        | (nodes < leaves + (cells > 1))
        | (nodes > leaves * MAX_LEVELS)
        | (points < leaves)
        | (points > leaves * int(columns["tree"][1]))
        | (np.maximum(points, nodes) > _MAX_ROWS)
    )
    if wrong.any():
        row = int(np.flatnonzero(wrong)[0])
        found = f"{[*rows[row].tolist(), int(leaves[row])]}"
        _refuse(
            f"{_at(voxels, wrong)} rows and leaves",
            found,
            "counts of cells, nodes, points and leaf nodes that form trees",
        )
    widths = np.array([CELL_DTYPE.itemsize, NODE_DTYPE.itemsize, point_bytes])
    free, ratio = np.array([CELL_EXPANSION, NODE_EXPANSION, ANY_EXPANSION]).T
    most = np.maximum(free, voxels["frame_bytes"].astype(np.int64) * ratio)
    huge = rows * widths > most
    if huge.any():
        row, i = np.argwhere(huge)[0]
        _refuse(
            f"voxel {voxels['key'][row]:#x} rows",
            f"of {rows[row, i] * widths[i]} bytes of {('cells', 'nodes', 'points')[i]}, more than its frames can hold",
            f"at most {most[row, i]}",
        )
    if int(points.sum()) != int(columns["points"][0]):
        _refuse("points", int(columns["points"][0]), f"{int(points.sum())}, those of all voxels")


def _check_bounds(columns: dict[str, NDArray]) -> None:
    """Check that the bounds of each voxel lie inside its cell, and that their union is the scene's.

    The broad phase searches ascending keys and prunes by these bounds. If they were too small, it
    would report clear for points that they hide.
    """
    voxels, steps = columns["voxels"], int(columns["voxel_steps"][0])
    low, high = voxels["low"], voxels["high"]
    wrong = (low < 0) | (low > high) | (high >= steps)
    if wrong.any():
        row = int(np.flatnonzero(wrong.any(axis=1))[0])
        found = f"{low[row].tolist()} to {high[row].tolist()}"
        _refuse(f"{_at(voxels, wrong)} bounds", found, f"low up to high, 0 to {steps - 1}")
    base = voxel_coordinates(voxels["key"]) * steps
    together = np.stack([(base + low).min(axis=0), (base + high).max(axis=0)])
    if (together != columns["bounds"]).any():
        _refuse("the voxels' bounds are not the scene's:", together.tolist(), f"{columns['bounds'].tolist()}")
