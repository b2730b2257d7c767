"""The builder's work units: a run of voxels -> one shard file. Pure and idempotent; run in any process."""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..schemas.archive import shard_name, write_shard
from ..schemas.codec import Record, encode_voxel
from ..schemas.radius_model import RADIUS_CLASSES
from ..schemas.voxel import VoxelData
from ..schemas.voxel_grid import Lattice
from .classes import voxel_classes
from .config import SHARD_POINTS, BuildConfig
from .octree import build_voxel, gather_voxel
from .spool import Spool


class ShardUnit(NamedTuple):
    """One shard to be written. number, generation: its name's.  keys: its voxels, ascending.  points: in all of them.

    spool: where the points lie.  most_near: points around a voxel that may be held beside it, see classes.py.
    folder: where the shard goes.
    """

    number: int
    generation: int
    keys: tuple[int, ...]
    points: int
    spool: Spool
    lattice: Lattice
    config: BuildConfig
    most_near: int
    archive_id: bytes
    folder: Path


class Shard(NamedTuple):
    """A shard written. rows: of the index.  size: of the file [bytes].

    radius_counts: (32,) int64, points of each radius class; radius_capped: see schemas/index.py Header.
    """

    name: str
    rows: NDArray
    size: int
    radius_counts: NDArray[np.int64]
    radius_capped: int


def plan_shards(keys: NDArray[np.uint64], counts: NDArray[np.int64]) -> list[tuple[tuple[int, ...], int]]:
    """Cut voxels (ascending keys, points of each) into runs of about SHARD_POINTS: (keys, points) each.

    A function of the points alone, so that the archive does not depend on the number of jobs.
    """
    plans: list[tuple[tuple[int, ...], int]] = []
    held: list[int] = []
    points = 0
    for key, count in zip(keys.tolist(), counts.tolist(), strict=True):
        if held and points + count > SHARD_POINTS:
            plans.append((tuple(held), points))
            held, points = [], 0
        held.append(key)
        points += count
    if held:
        plans.append((tuple(held), points))
    return plans


def build_shard(unit: ShardUnit) -> Shard:
    """Gather, build, compress and write the voxels of one shard, one at a time."""
    with_classes = unit.config.models != {"mean"}
    counts, capped = np.zeros(RADIUS_CLASSES, np.int64), 0

    def voxels() -> Iterator[tuple[VoxelData, Record, NDArray[np.int64], NDArray[np.int64]]]:
        nonlocal counts, capped
        for key in unit.keys:
            points = gather_voxel(unit.spool.rows(key))
            if with_classes:
                classes = voxel_classes(key, points.local, unit.config.models, unit.spool, unit.most_near)
                counts += np.bincount(classes.of_point, minlength=RADIUS_CLASSES)
                capped += classes.few
                points = points._replace(radius_class=classes.of_point)
            voxel = build_voxel(key, points, unit.lattice.voxel_steps, unit.config)
            record = encode_voxel(voxel, unit.archive_id)
            yield (
                voxel,
                record,
                points.local.min(axis=0).astype(np.int64),
                points.local.max(axis=0).astype(np.int64),
            )

    path = unit.folder / shard_name(unit.number, unit.generation)
    rows = write_shard(path, unit.number, unit.archive_id, voxels(), version=2 if with_classes else 1)
    return Shard(path.name, rows, path.stat().st_size, counts, capped)
