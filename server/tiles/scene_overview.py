"""Sample of all points of a scene: the first picture, whose cost does not grow with the scene.

An archive keeps a preview of up to 200,000 points (builder/passes/preview.py). Where it has none,
or one that is not trusted, some voxels are read instead, up to a number of points.
"""

import logging
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...builder.voxel.record_points import voxel_points
from ...schemas.archive.index import Header
from ...schemas.archive.vtkhdf import PREVIEW_NAME, read_sample
from ...schemas.errors import CorruptError
from ...schemas.wire.overview_messages import OverviewAnswer, OverviewRequest
from ..archives.placed_archive import PlacedArchive
from ..residency.voxel_store import VoxelStore

log = logging.getLogger(__name__)

# Without a preview, as many voxels are read as hold this many points together, for all archives of
# a scene: some 0.2 s.
_READ_POINTS = 1 << 20
# Column of an answer -> field of a record, and its type.
_COLUMNS: dict[str, tuple[str, np.dtype]] = {
    "rgb": ("rgb", np.dtype(("u1", (3,)))),
    "intensity": ("intensity", np.dtype("<f4")),
    "classification": ("classification", np.dtype("u1")),
    "scan": ("scan_index", np.dtype("<u2")),
}
_STAMP = ("archive_id", "generation")


class _Sample(NamedTuple):
    """Points (n, 3) of an archive, in its frame [m], and the columns that it keeps, by name."""

    points: NDArray[np.float64]
    columns: dict[str, NDArray]
    is_preview: bool

    def thinned(self, most: int) -> "_Sample":
        """Return at most `most` points, evenly spread over the order of the sample."""
        count = len(self.points)
        if count <= most:
            return self
        kept = np.arange(most, dtype=np.int64) * count // most
        return self.where(kept)

    def where(self, kept: NDArray) -> "_Sample":
        """Return the points of an index or mask."""
        columns = {name: column[kept] for name, column in self.columns.items()}
        return _Sample(self.points[kept], columns, self.is_preview)


def read_overview(
    request: OverviewRequest, placed: Sequence[PlacedArchive], stores: Sequence[VoxelStore]
) -> OverviewAnswer:
    """Sample the points of archives. placed: their places in the scene."""
    headers = [store.archive.header for store in stores]
    points = [header.points for header in headers]
    total = sum(points)
    # Exact integers: a share is that of the archive's points, and all shares add up to the limit.
    ends = [request.limit * sum(points[: k + 1]) // total for k in range(len(points))]
    samples = [
        _sample(store, end - begin, _READ_POINTS * store.archive.header.points // total)
        for store, begin, end in zip(stores, [0, *ends[:-1]], ends, strict=True)
    ]
    names = [name for name in _COLUMNS if any(name in _kept(header) for header in headers)]
    columns = {name: _joined(name, samples, name in names) for name in _COLUMNS}
    corners = [header.lattice.to_world(np.stack([header.low, header.high])) for header in headers]
    low, high = (np.stack([corner[side] for corner in corners]) for side in (0, 1))
    finite = columns["intensity"][np.isfinite(columns["intensity"])]
    return OverviewAnswer(
        total,
        headers[0].radius,
        names,
        (float(finite.min()), float(finite.max())) if len(finite) else None,
        np.unique(columns["classification"]).tolist(),
        np.stack([np.eye(4) if each.pose is None else each.pose for each in placed]),
        np.array([header.lattice.voxel_size for header in headers]),
        low,
        high,
        np.array(points, np.uint64),
        np.array([len(store.archive.voxels) for store in stores], np.uint32),
        np.array([len(header.sources) for header in headers], np.uint32),
        np.cumsum([0, *(len(sample.points) for sample in samples)]).astype(np.uint32),
        np.array([sample.is_preview for sample in samples]),
        np.concatenate(
            [(sample.points - corner).astype(np.float32) for sample, corner in zip(samples, low, strict=True)]
        ),
        columns["rgb"],
        columns["intensity"],
        columns["classification"],
        columns["scan"],
    )


def _kept(header: Header) -> dict[str, np.dtype]:
    """Return the columns that an archive keeps, by name in an answer."""
    names = header.point_dtype.names or ()
    return {name: kind for name, (field, kind) in _COLUMNS.items() if field in names}


def _joined(name: str, samples: Sequence[_Sample], is_kept: bool) -> NDArray:
    """Return a column of all samples, 0 where an archive does not keep it; empty if none does."""
    kind = _COLUMNS[name][1]
    if not is_kept:
        return np.empty((0, *kind.shape), kind.base)
    return np.concatenate(
        [
            sample.columns[name] if name in sample.columns else np.zeros(len(sample.points), kind)
            for sample in samples
        ]
    )


def _sample(store: VoxelStore, most: int, read: int) -> _Sample:
    """Return at most `most` points of an archive. read: points to read without a preview, at most."""
    found = _read_preview(store)
    if found is None:
        found = _read_voxels(store, read)
    return found.thinned(most)


def _read_preview(store: VoxelStore) -> _Sample | None:
    """Return the points of an archive's preview; None if there is none of this archive."""
    path, header = store.archive.folder / PREVIEW_NAME, store.archive.header
    if not path.exists():
        return None
    try:
        found = read_sample(path, _kept(header), _STAMP)
        stamp = found.attributes["archive_id"].tobytes(), int(found.attributes["generation"])
    except (CorruptError, OSError, ValueError, TypeError) as error:
        log.warning("%s: an overview does without the preview", error)
        return None
    if stamp != (header.archive_id, header.generation):
        return None
    sample = _Sample(found.points, found.columns, True)
    low, high = header.lattice.to_world(np.stack([header.low, header.high]))
    # The preview is rounded, and not written by this process.
    kept = np.asarray(np.isfinite(found.points).all(axis=1))
    sample = sample.where(kept)._replace(points=np.clip(found.points[kept], low, high))
    sample = sample.where(~store.hides(sample.points))
    return sample if len(sample.points) else None


def _read_voxels(store: VoxelStore, most: int) -> _Sample:
    """Return the points of voxels that are spread over an archive, at most `most` points.

    A voxel that cannot be read is left out.
    """
    archive = store.archive
    columns, lattice = _kept(archive.header), archive.header.lattice
    counts = archive.voxels["rows"][:, 2].astype(np.int64)
    found = [
        _Sample(np.empty((0, 3)), {n: np.empty((0, *k.shape), k.base) for n, k in columns.items()}, False)
    ]
    left = most
    for row in _spread(counts, most):
        if counts[row] > left:
            break
        left -= int(counts[row])
        try:
            voxel, links = archive.read_voxel(row)
        except (CorruptError, OSError) as error:
            log.warning("%s: an overview does without this voxel", error)
            continue
        corner = archive.coordinates[row].astype(np.int64) * lattice.voxel_steps
        places = lattice.to_world(voxel_points(voxel, links) + corner)
        own = {name: np.asarray(getattr(voxel, _COLUMNS[name][0])) for name in columns}
        found.append(_Sample(places, own, False))
    joined = {name: np.concatenate([each.columns[name] for each in found]) for name in columns}
    sample = _Sample(np.concatenate([each.points for each in found]), joined, False)
    return sample.where(~store.hides(sample.points))


def _spread(counts: NDArray[np.int64], most: int) -> list[int]:
    """Return rows that are spread over an index, voxels of more than `most` points left out.

    counts: (v,), points of each voxel. Rows are in the order of a space-filling curve, so that every
    k-th of them is near another place.
    """
    rows = np.flatnonzero(counts <= most)
    if not len(rows):
        return []
    number = max(1, min(len(rows), int(most // max(1, counts[rows].mean()))))
    return rows[np.arange(number) * len(rows) // number].tolist()
