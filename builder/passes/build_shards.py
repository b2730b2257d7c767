"""Third pass: work units that build consecutive voxels and write them as one shard file.

Units are pure and idempotent, and run in any process.
"""

import base64
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.archive_writer import write_shard
from ...schemas.archive.codec import encode_voxel
from ...schemas.archive.index import SHARD_FOLDER, VOXEL_DTYPE, shard_name
from ...schemas.archive.radius_model import RADIUS_CLASSES
from ...schemas.archive.voxel_grid import Lattice
from ...schemas.runtime.interrupts import check_interrupt
from ..build_limits import VOXEL_BYTES_A_POINT, is_dense, shard_points
from ..config import BuildConfig
from ..resume.kept_work import BuildDirectory, ShardIntact, Work, run_unfinished
from ..resume.transaction import Transaction
from ..spool.spool import Spool
from ..voxel.dense_voxel import build_dense
from ..voxel.voxel_octree import BuiltVoxel, build_voxel, gather_voxel
from .radius_classes import ALL_CODES, voxel_classes


class ShardUnit(NamedTuple):
    """Shard to write. number, generation: of its name.  keys: of its voxels, ascending.

    points: total number in its voxels.  spool: source of the points.
    max_neighbours: points around a voxel that may be held beside it, see radius_classes.py.
    folder: destination of the shard.
    """

    number: int
    generation: int
    keys: tuple[int, ...]
    points: int
    spool: Spool
    lattice: Lattice
    config: BuildConfig
    max_neighbours: int
    archive_id: bytes
    folder: Path


class Shard(NamedTuple):
    """Shard as written. rows: of the index.  size: of the file [bytes].

    checksum: `file_checksum` of all its bytes.  radius_counts: (32,) int64, points of each radius
    class.
    radius_capped: see schemas/archive/index.py Header.
    """

    name: str
    rows: NDArray
    size: int
    checksum: int
    radius_counts: NDArray[np.int64]
    radius_capped: int


def plan_shards(keys: NDArray[np.uint64], counts: NDArray[np.int64]) -> list[tuple[tuple[int, ...], int]]:
    """Cut voxels into runs of about `shard_points` points; return (keys, points) of each.

    keys: ascending.  counts: points of each voxel. The result is a function of the points alone,
    which makes the archive independent of the number of jobs.
    """
    most = shard_points(int(counts.sum()))
    plans: list[tuple[tuple[int, ...], int]] = []
    held: list[int] = []
    points = 0
    for key, count in zip(keys.tolist(), counts.tolist(), strict=True):
        if held and points + count > most:
            plans.append((tuple(held), points))
            held, points = [], 0
        held.append(key)
        points += count
    if held:
        plans.append((tuple(held), points))
    return plans


class _ClassCounts:
    """Finder and counter of the radius classes of a unit's voxels.

    of: (32,) int64, points of each class.  capped: points with too few neighbours.
    """

    def __init__(self, unit: ShardUnit) -> None:
        """Start with zero counts."""
        self.unit = unit
        self.of, self.capped = np.zeros(RADIUS_CLASSES, np.int64), 0

    def find(
        self, key: int, local: NDArray[np.int32], codes: range = ALL_CODES, times: int = 1
    ) -> NDArray[np.uint8]:
        """Return the classes (n,) of points (n, 3) of a voxel, see `voxel_classes`.

        times: number of times that each point occurs and is counted.
        """
        unit = self.unit
        found = voxel_classes(key, local, unit.config.models, unit.spool, unit.max_neighbours, codes)
        self.of += times * np.bincount(found.of_point, minlength=RADIUS_CLASSES)
        self.capped += times * found.capped
        return found.of_point


def build_shard(unit: ShardUnit) -> Shard:
    """Gather, build, compress and write the voxels of one shard, one at a time."""
    classes = None if unit.config.models == {"mean"} else _ClassCounts(unit)
    path = unit.folder / shard_name(unit.number, unit.generation)
    version = 1 if classes is None else 2
    if unit.config.keep & {"rgb", "classification"}:
        version = 5
    rows, checksum = write_shard(path, unit.number, unit.archive_id, _voxels(unit, classes), version=version)
    counts, capped = (
        (np.zeros(RADIUS_CLASSES, np.int64), 0) if classes is None else (classes.of, classes.capped)
    )
    return Shard(path.name, rows, path.stat().st_size, checksum, counts, capped)


def _voxels(unit: ShardUnit, classes: _ClassCounts | None) -> Iterator[BuiltVoxel]:
    """Yield each voxel of a unit, built, with its record and the bounds of its points."""
    for key in unit.keys:
        check_interrupt()
        if is_dense(unit.spool.count(key), unit.config):
            classify = None if classes is None else partial(classes.find, key)
            yield build_dense(key, unit.spool, unit.config, unit.archive_id, unit.folder, classify)
            continue
        points = gather_voxel(unit.spool.rows(key))
        low, high = (edge(points.local, axis=0).astype(np.int64) for edge in (np.min, np.max))
        if classes is not None:
            points = points._replace(radius_class=classes.find(key, points.local))
        voxel = build_voxel(key, points, unit.lattice.voxel_steps, unit.config)
        del points
        yield BuiltVoxel(voxel, encode_voxel(voxel, unit.archive_id), low, high)


def max_neighbours(memory_bytes: int) -> int:
    """Return the number of points around a voxel that a job may hold beside it, or a part of it."""
    return max(1 << 16, memory_bytes // (2 * VOXEL_BYTES_A_POINT))


def build_shards(
    spool: Spool,
    identity: bytes,
    build_dir: BuildDirectory,
    build: Transaction,
) -> list[Shard]:
    """Run the third pass: build every voxel and write the shards. The largest are built first."""
    folder = build_dir.archive / SHARD_FOLDER
    most = max_neighbours(build.share)
    plans = plan_shards(spool.keys, spool.counts)
    units = [
        (
            f"done/{number:06d}",
            ShardUnit(number, 0, keys, points, spool, spool.lattice, build.config, most, identity, folder),
        )
        for number, (keys, points) in enumerate(plans)
    ]
    units.sort(key=lambda named: -named[1].points)
    work = Work(build_shard, dump_shard, load_shard, ShardIntact(folder))
    with build.stage("build", sum(points for _, points in plans), "points"):
        shards = run_unfinished(
            build_dir.journal, build.executor, work, units, build.progress, lambda unit: unit.points
        )
    named = {shard.name for shard in shards}
    for path in folder.iterdir():
        if path.name not in named:
            path.unlink(missing_ok=True)
    return [shard for _, shard in sorted(zip((unit.number for _, unit in units), shards, strict=True))]


def dump_shard(shard: Shard) -> dict[str, Any]:
    """Convert a shard to its journal entry."""
    return {
        **shard._asdict(),
        "rows": base64.b85encode(shard.rows.tobytes()).decode(),
        "radius_counts": shard.radius_counts.tolist(),
    }


def load_shard(noted: dict[str, Any]) -> Shard:
    """Convert a journal entry to a shard."""
    rows = np.frombuffer(base64.b85decode(noted["rows"]), VOXEL_DTYPE)
    return Shard(**{**noted, "rows": rows, "radius_counts": np.array(noted["radius_counts"], np.int64)})
