"""Level of detail of an archive: units that write the representatives of its voxels as shards.

schemas/archive/level.py says what a level is. The pass reads the finished records, so that a level
can be made for any archive, and its bytes depend on those of the archive alone.
"""

import os
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.archive import Archive
from ...schemas.archive.archive_writer import write_index, write_shard
from ...schemas.archive.codec import encode_voxel
from ...schemas.archive.index import SHARD_FOLDER, Header, Source, shard_name
from ...schemas.archive.level import LEVEL_COLUMNS, LEVEL_FOLDER, level_id, open_level, squared_covers
from ...schemas.archive.radius_model import RADIUS_CLASSES
from ...schemas.archive.voxel import VoxelData
from ...schemas.archive.voxel_grid import KEY_BIAS, voxel_coordinates, voxel_keys
from ...schemas.errors import CorruptError
from ...schemas.runtime.interrupts import check_interrupt
from ...schemas.runtime.new_file import sync_path
from ..config import BuildConfig
from ..run.executor import Executor, Progress, Silent, run_units
from ..voxel.level_voxel import LevelVoxel, level_voxels
from ..voxel.voxel_octree import BuiltVoxel
from .build_shards import plan_shards

# Least mean number of representatives in a voxel of a level that is smaller than the archive's: a
# voxel costs 1.2 KB of HDF5 and a row of the index.
LEVEL_VOXEL = 4096
_DELETE = "delete the folder of the level"


class _Unit(NamedTuple):
    """Shard of a level to write.

    archive, level: folders of the archive and of the level.  first, past: rows of the index.
    number: of the shard.  points: of the archive in these voxels.  halvings: see `level_halvings`.
    """

    archive: Path
    level: Path
    first: int
    past: int
    number: int
    points: int
    halvings: int
    config: BuildConfig


class _Written(NamedTuple):
    """Shard of a level. rows: of its index.  size: [bytes].  counts: (32,), by cover class."""

    number: int
    rows: NDArray
    size: int
    counts: NDArray[np.int64]


def write_level(
    folder: Path,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> None:
    """Write the level of the archive in `folder` to its folder LEVEL_FOLDER, in place of what is there.

    Progress advances by the points of the archive. Without its index, which is written last, a level
    does not exist. Raise CorruptError if a record cannot be read.
    """
    target = folder / LEVEL_FOLDER
    shutil.rmtree(target, ignore_errors=True)
    (target / SHARD_FOLDER).mkdir(parents=True)
    with Archive(folder) as archive:
        header, keys = archive.header, archive.voxels["key"].astype(np.uint64)
        counts, halvings = archive.voxels["rows"][:, 2].astype(np.int64), level_halvings(archive)
    config = _config(header)
    units, first = [], 0
    for number, (held, points) in enumerate(plan_shards(keys, counts)):
        units.append(_Unit(folder, target, first, first + len(held), number, points, halvings, config))
        first += len(held)
    results = run_units(executor, _write_shard, units, progress or Silent(), lambda unit: unit.points)
    shards = sorted(results, key=lambda shard: shard.number)
    rows = np.concatenate([shard.rows for shard in shards])
    names = [(shard_name(shard.number), shard.size) for shard in shards]
    steps = header.lattice.voxel_steps >> halvings
    write_index(target, _level_header(header, steps, rows, [s.counts for s in shards]), rows, names)


def level_halvings(archive: Archive) -> int:
    """Return how often the edge of the voxels of an archive is halved for its level.

    A level is read by the voxel, and where points are dense, a request needs little of one. On
    surfaces, halving leaves a quarter of the representatives in a voxel.
    """
    mean = float(archive.voxels["leaves"].mean())
    steps, farthest = archive.header.lattice.voxel_steps, int(np.abs(archive.coordinates).max()) + 1
    halvings = 0
    while mean >= 4 * LEVEL_VOXEL and steps % 2 == 0 and farthest < KEY_BIAS >> (halvings + 1):
        mean, steps, halvings = mean / 4, steps // 2, halvings + 1
    return halvings


def replace_level(folder: Path, new: Path, aside: Path) -> None:
    """Replace the level of the archive in `folder` by that in the folder `new`.

    aside: a path for the old level. If the process is killed in between, there is none.
    """
    level = folder / LEVEL_FOLDER
    if level.exists():
        os.rename(level, aside)
    os.rename(new, level)
    sync_path(folder)


def _config(header: Header) -> BuildConfig:
    """Return the options with which the hierarchies of a level are built, from its archive's."""
    with_slab = bool(header.options.get("with_slab", True))
    return BuildConfig(degree=header.degree, leaf=header.leaf, with_slab=with_slab)


def _level_header(header: Header, steps: int, rows: NDArray, counts: list[NDArray[np.int64]]) -> Header:
    """Return the header of the level of an archive. steps: edge of its voxels.  rows: of its index."""
    base = voxel_coordinates(rows["key"]) * steps
    points = int(rows["rows"][:, 2].sum())
    source = Source(f"archive {header.archive_id.hex()}", 0, "level", "", points, np.eye(4), {})
    return replace(
        header,
        archive_id=level_id(header),
        lattice=header.lattice._replace(voxel_steps=steps),
        points=points,
        low=(base + rows["low"]).min(axis=0),
        high=(base + rows["high"]).max(axis=0),
        radius_sample=0,
        scan_index=False,
        models=("mean",),
        radius_counts=np.sum(counts, axis=0, dtype=np.int64),
        radius_capped=0,
        sources=(source,),
        generation=0,
        radius_now=None,
        is_level=True,
    )


def _write_shard(unit: _Unit) -> _Written:
    """Write one shard of a level, a voxel at a time; runs in any process."""
    counts = np.zeros(RADIUS_CLASSES, np.int64)
    path = unit.level / SHARD_FOLDER / shard_name(unit.number)
    with Archive(unit.archive) as archive:
        identity = level_id(archive.header)

        def voxels() -> Iterator[BuiltVoxel]:
            for row in range(unit.first, unit.past):
                check_interrupt()
                for made in _make_voxels(archive, row, unit.halvings, unit.config):
                    np.add(counts, np.bincount(_classes(made.voxel), minlength=RADIUS_CLASSES), out=counts)
                    yield BuiltVoxel(made.voxel, encode_voxel(made.voxel, identity), made.low, made.high)

        rows, _ = write_shard(path, unit.number, identity, voxels(), version=5)
    return _Written(unit.number, rows, path.stat().st_size, counts)


def _make_voxels(archive: Archive, row: int, halvings: int, config: BuildConfig) -> list[LevelVoxel]:
    """Make the level of the voxel of an index row. Raise CorruptError."""
    squares = squared_covers(archive.header.lattice.step)
    record = archive.open_voxel(row, columns=LEVEL_COLUMNS)
    with archive.locating(row):
        return level_voxels(record, archive.coordinates[row], halvings, squares, config)


def _classes(voxel: VoxelData) -> NDArray[np.uint8]:
    """Return the cover classes of a voxel of a level."""
    assert voxel.radius_class is not None
    return voxel.radius_class


class _CheckUnit(NamedTuple):
    """Voxels whose representatives are compared. points: of the archive."""

    archive: Path
    rows: range
    points: int


def check_level(
    folder: Path, executor: Executor | None, units: list[range], points: NDArray[np.int64]
) -> list[str]:
    """Return the faults of the level of the archive in `folder`: where it is not that of the points.

    units: ranges of rows.  points: (v,) points of each voxel.
    """
    checks = [_CheckUnit(folder, rows, int(points[rows.start : rows.stop].sum())) for rows in units]
    found = run_units(executor, _check_rows, checks, Silent(), lambda unit: unit.points)
    return [fault for faults in found for fault in faults]


def _check_rows(unit: _CheckUnit) -> list[str]:
    """Compare the representatives of a range of voxels with those stored; runs in any process."""
    faults: list[str] = []
    with Archive(unit.archive) as archive:
        level = open_level(archive)
        if level is None:
            return faults
        with level:
            config, halvings = _config(archive.header), level_halvings(archive)
            expected_steps = archive.header.lattice.voxel_steps >> halvings
            if level.header.lattice.voxel_steps != expected_steps:
                return [f"{level.folder}: voxels of other size than expected: {_DELETE}"]
            inside = voxel_keys(level.coordinates >> halvings)
            for row in unit.rows:
                check_interrupt()
                own = np.flatnonzero(inside == archive.voxels["key"][row])
                try:
                    made = _make_voxels(archive, row, halvings, config)
                    stored = [(int(level.voxels["key"][at]), *level.read_frames(at)) for at in own.tolist()]
                except (CorruptError, OSError) as error:
                    faults.append(str(error))
                    continue
                identity = level.header.archive_id
                records = [(each.voxel.key, encode_voxel(each.voxel, identity)) for each in made]
                if stored != [(key, r.cells, r.nodes, r.points) for key, r in records]:
                    where = level.where(int(own[0])) if len(own) else str(level.folder)
                    faults.append(f"{where}: is not the level of the archive's points: {_DELETE}")
    return faults
