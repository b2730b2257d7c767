"""Index header of a dataset, assembled from the survey, the spool and the shards."""

import hashlib
import json
from collections.abc import Sequence
from itertools import count

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.index import Header, Source
from ...schemas.archive.radius_model import RADIUS_CLASSES
from ...schemas.archive.voxel_grid import Lattice, voxel_coordinates
from ..config import BuildConfig
from ..sources.coincident_scans import is_one_position
from ..sources.common.scan import Scan
from .build_shards import Shard
from .spool_pass import Spooled
from .survey_pass import Survey


def archive_id(spooled: Sequence[Spooled], lattice: Lattice, config: BuildConfig) -> bytes:
    """Compute the 16-byte identifier of points, lattice and options. Order does not affect it."""
    content = [sum(s.content[i] for s in spooled) % (1 << 64) for i in range(2)]
    identity = json.dumps(config.identity(), sort_keys=True).encode()
    origin = np.array([*lattice.origin, lattice.step], "<f8").tobytes()
    return hashlib.sha256(identity + origin + np.array(content, "<u8").tobytes()).digest()[:16]


def make_header(
    surveys: Sequence[Survey],
    faulty: Sequence[Survey],
    filtered: Sequence[dict[str, int]],
    lattice: Lattice,
    lattice_source: str,
    identity: bytes,
    moved_max: float,
    shards: Sequence[Shard],
    config: BuildConfig,
) -> Header:
    """Make the header, except for the radius, which is measured later.

    identity: `archive_id`.  filtered: for each scan of `surveys`, reason -> points left out by
    filters.
    """
    low, high = _bounds(np.concatenate([s.rows for s in shards]), lattice)
    lost = [s for s in faulty if not s.empty]
    boxes = [
        np.stack([lattice.to_lattice(s.region[:1])[0] - 1, lattice.to_lattice(s.region[1:])[0] + 1])
        for s in lost
        if s.region is not None
    ]
    return Header(
        archive_id=identity,
        lattice=lattice,
        lattice_source=lattice_source,
        points=sum(s.count - sum(f.values()) for s, f in zip(surveys, filtered, strict=True)),
        low=low,
        high=high,
        radius=0.0,
        radius_model="mean" if config.radius is None else "given",
        radius_error=0.0,
        radius_sample=0,
        moved_max=moved_max,
        degree=config.degree,
        leaf=config.leaf,
        scan_index="scan" in config.keep,
        intensity="intensity" in config.keep,
        models=config.stored_models(),
        radius_counts=np.sum([s.radius_counts for s in shards], axis=0, dtype=np.int64).reshape(
            RADIUS_CLASSES
        ),
        radius_capped=sum(s.radius_capped for s in shards),
        options=config.identity(),
        sources=(
            *(_good_source(s, f) for s, f in zip(surveys, filtered, strict=True) if s.scan is not None),
            *map(_bad_source, faulty, _unknown_rows(faulty)),
        ),
        unknown=np.array(boxes, np.int64).reshape(-1, 2, 3),
        unknown_everywhere=any(s.region is None for s in lost),
        rgb="rgb" in config.keep,
        classification="classification" in config.keep,
    )


def _bounds(rows: NDArray, lattice: Lattice) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the bounds of all points in lattice coordinates, from the rows of the index."""
    base = voxel_coordinates(rows["key"]) * lattice.voxel_steps
    return (base + rows["low"]).min(axis=0), (base + rows["high"]).max(axis=0)


def _good_source(survey: Survey, filtered: dict[str, int]) -> Source:
    """Return the source entry of a scan that was built."""
    scan = survey.scan
    assert scan is not None
    kept = survey.count - sum(filtered.values())
    skipped = {**survey.dropped, **filtered}
    return Source(
        str(survey.path), scan.index, scan.format, survey.sha256, kept, scan.pose, skipped,
        crs=scan.crs, units=scan.units, up=scan.up, one_place=is_one_position(survey.low, survey.high, survey.count),
    )  # fmt: skip


def _unknown_rows(faulty: Sequence[Survey]) -> list[int | None]:
    """Return `Source.unknown` of each scan that was left out.

    It is the row of the box where the scan may have had points; -1 if the box is not known; None if
    the scan had no points.
    """
    boxes = count()
    return [None if s.empty else -1 if s.region is None else next(boxes) for s in faulty]


def _bad_source(survey: Survey, unknown: int | None) -> Source:
    """Return the source entry of a scan that was left out. unknown: see `Source`."""
    scan: Scan | None = survey.scan
    return Source(
        str(survey.path),
        scan.index if scan else 0,
        scan.format if scan else "",
        survey.sha256,
        0,
        np.eye(4),
        {},
        survey.fault,
        unknown=unknown,
    )
