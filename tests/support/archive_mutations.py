"""Archives with changed numbers and recomputed checksums, and the outcome of reading each.

A mutation changes one or two numbers of the index or of a record. In half of the cases, bounds,
sums of points and counts of leaf nodes are adjusted, so that one check does not hide the others.
Each archive is opened, validated with `deep` and queried. The expected verdicts come from brute
force over the points in its records (naive.py).
"""

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from forged_archives import Columns, RawIndex, put_rows, read_index, read_rows, row_types, write_index
from naive import placed_units, reach_units, scan_units, touches
from numpy.typing import NDArray
from small_builds import build
from solidcloud.builder.passes.verify import verify_archive
from solidcloud.builder.voxel.record_points import voxel_points
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.archive.codec import decode_voxel
from solidcloud.schemas.archive.voxel_grid import voxel_coordinates
from solidcloud.schemas.errors import BadRequestError, CorruptError, FormatError
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.scene import Scene
from synthetic_scans import WITH_POINTS, make_scan, write_xyz
from zstandard import ZstdError

POSES = 200
AVATAR = np.array([[0.0, 0.0, 0.0], [0.05, 0.0, 0.02], [0.0, 0.08, 0.0]])
AVATAR_RADIUS = 0.01
# Only `validate --deep` checks the bounds in a record (FORMAT.md, "What a reader cannot find").
ENCLOSING = ("nodes.center", "nodes.radius", "nodes.normal", "nodes.slab", "points.xyz", "nodes.block_low")
ENCLOSING_TOO = ("nodes.axis", "cells.low", "cells.log2_size")
RADIUS = 0.02


class Template(NamedTuple):
    """Archive to be changed. poses: (POSES, 4, 4).  points: of each voxel, (n, 3) int64 [voxel steps]."""

    folder: Path
    index: RawIndex
    poses: NDArray[np.float64]
    points: dict[int, NDArray[np.int64]]


class Outcome(NamedTuple):
    """Outcome of a case.

    name: of what was changed.
    outcome: one of GOOD, or a fault. "found": validate found the change, and no answer was wrong.
    unknown: number of unknown verdicts.
    """

    name: str
    outcome: str
    message: str = ""
    unknown: int = 0


GOOD = ("refused", "found", "right", "bounds found by validate --deep")


def make_template(folder: Path, classes: bool) -> Template:
    """Build an archive of six scans in several voxels; with `classes`, scan numbers and radius classes."""
    folder.mkdir(parents=True)
    files = [write_xyz(folder / f"{i}.xyz", make_scan(kind, i, 150)) for i, kind in enumerate(WITH_POINTS)]
    more = {"keep": frozenset({"scan"}), "models": frozenset({"mean", "local"})} if classes else {}
    build(files, folder / "archive", radius=RADIUS, **more)
    archive = folder / "archive"
    rng = np.random.default_rng(7)
    points = {}
    with Archive(archive) as opened:
        for row, key in enumerate(opened.voxels["key"].tolist()):
            points[key] = voxel_points(*opened.read_voxel(row)).astype(np.int64)
        steps, lattice = opened.header.lattice.voxel_steps, opened.header.lattice
        world = lattice.to_world(
            np.concatenate([p + c * steps for p, c in zip(points.values(), opened.coordinates, strict=True)])
        )
    poses = np.tile(np.eye(4), (POSES, 1, 1))
    offsets = rng.normal(0, 0.03, (POSES, 3)) * rng.integers(0, 3, (POSES, 1))
    poses[:, :3, 3] = world[rng.integers(0, len(world), POSES)] + offsets
    return Template(archive, read_index(archive), poses, points)


def numeric_fields(columns: Columns) -> list[str]:
    """Return the names of all numbers of an index and of a record."""
    names = []
    for name, column in columns.items():
        if name == "texts":
            continue
        if column.dtype.names:
            names += [f"{name}.{field}" for field in column.dtype.names if column.dtype[field].kind != "S"]
        elif column.size:
            names.append(name)
    for dataset, dtype in zip(("cells", "nodes", "points"), row_types(columns), strict=True):
        names += [f"{dataset}.{field}" for field in dtype.names or ()]
    return names


def _changed(rng: np.random.Generator, values: NDArray) -> None:
    """Change one number, or all of them, in place."""
    flat = values.reshape(-1)
    at = slice(None) if rng.random() < 0.15 else int(rng.integers(len(flat)))
    how = int(rng.integers(9))
    if how == 8:  # swapped with another
        other = int(rng.integers(len(flat)))
        flat[at], flat[other] = flat[other], flat[at].copy() if isinstance(at, slice) else flat[at]
        return
    if values.dtype.kind == "f":
        special: list[Any] = [
            np.nan,
            np.inf,
            -np.inf,
            0.0,
            -1.0,
            1e300,
            flat[at] * 0.5,
            flat[at] * 2.0 + 1e-3,
        ]
        flat[at] = special[how]
        return
    most = np.iinfo(values.dtype).max
    before = flat[at].astype(object)
    wanted = [
        np.zeros_like(before), before * 0 - 1, before * 0 + most, before + 1, before - 1, before // 2, before * 2,
        before + int(rng.integers(-1000, 1000)),
    ][how]  # fmt: skip
    wrapped = np.asarray(wanted, object) % (2 * (most + 1) if values.dtype.kind == "i" else most + 1)
    flat[at] = np.asarray(wrapped).astype(np.uint64).astype(values.dtype)


def _make_fit(rng: np.random.Generator, columns: Columns) -> None:
    """Adjust the sums and bounds of the dataset to those of the voxels, as a careful forger does."""
    voxels = columns["voxels"]
    points = int(voxels["rows"][:, 2].sum(dtype=np.int64))
    columns["points"][0] = points
    counts = columns["source_count"]
    counts[:] = 0
    counts[int(rng.integers(len(counts)))] = points
    base = voxel_coordinates(voxels["key"] & np.uint64((1 << 63) - 1)) * int(columns["voxel_steps"][0])
    columns["bounds"][:] = [(base + voxels["low"]).min(axis=0), (base + voxels["high"]).max(axis=0)]


def _mutate(rng: np.random.Generator, folder: Path, columns: Columns, name: str) -> None:
    """Change one field."""
    dataset, _, field = name.partition(".")
    if dataset in ("cells", "nodes", "points") and field:
        i = ("cells", "nodes", "points").index(dataset)
        voxel = int(rng.integers(len(columns["voxels"])))
        rows = read_rows(folder, columns, voxel, i)
        values = rows[field].copy()
        _changed(rng, values)
        rows[field] = values
        put_rows(folder, columns, voxel, i, rows)
        return
    column = columns[dataset]
    values = (column[field] if field else column).copy()
    _changed(rng, values)
    if field:
        column[field] = values
    else:
        columns[dataset] = values


def mutate(template: Template, seed: int, number: int, folder: Path) -> str:
    """Write case `number` into `folder`; return the names of what was changed."""
    rng = np.random.default_rng([seed, number])
    shutil.copytree(template.folder, folder)
    index = template.index
    columns = {name: column.copy() for name, column in index.columns.items()}
    fields = numeric_fields(columns)
    names = [fields[number % len(fields)]]
    if rng.random() < 0.25:
        names.append(fields[int(rng.integers(len(fields)))])
    with np.errstate(all="ignore"):
        for name in names:
            try:
                _mutate(rng, folder, columns, name)
            except (
                IndexError,
                ValueError,
                OSError,
                MemoryError,
                ZstdError,
            ) as error:  # the first one hid the record
                names.append(f"({type(error).__name__})")
                break
        if rng.random() < 0.5:
            _make_fit(rng, columns)
    write_index(folder, index._replace(columns=columns))
    return " + ".join(names)


def _record_points(archive: Archive, row: int) -> NDArray[np.int64] | None:
    """Return the points of a record (n, 3) [voxel steps]; None if it is not readable.

    The position that the index gives does not matter.
    """
    shape = archive._shape(row)._replace(bounds=None, classes=None, leaves=None)
    header = archive.header
    try:
        frames = archive.read_frames(row)
        key = int(archive.voxels["key"][row])
        voxel = decode_voxel(*frames, shape, key, header.archive_id, header.lattice.voxel_steps)
    except CorruptError:
        return None
    return voxel_points(*voxel).astype(np.int64)


def _truth(folder: Path, template: Template) -> Iterator[bool]:
    """Return the contact of each pose, by brute force over the points of the records.

    If a record is not readable, its original points are used.
    """
    with Archive(folder) as archive:
        lattice, radius = archive.header.lattice, archive.header.radius
        parts = []
        for row, key in enumerate(archive.voxels["key"].tolist()):
            local = _record_points(archive, row)
            local = template.points.get(key) if local is None else local
            if local is not None:
                parts.append(local + archive.coordinates[row] * lattice.voxel_steps)
    units = scan_units(np.concatenate(parts), lattice.step)
    for pose in template.poses:
        placed = placed_units(AVATAR, pose, lattice.origin)
        yield touches(placed, units, reach_units(AVATAR_RADIUS, radius, 0.0))


def judge(template: Template, folder: Path, name: str) -> Outcome:
    """Open, validate and query an archive. Raises an error if it fails in a way that it must not."""
    try:
        faults = verify_archive(folder, deep=True).faults
    except FormatError as refused:
        try:
            Scene.open(folder).close()
        except FormatError:
            return Outcome(name, "refused", str(refused))
        return Outcome(name, "validate refuses what a server opens", str(refused))
    try:
        scene = Scene.open(folder, budget_bytes=32 << 20)
    except BadRequestError as refused:  # the cache is too small for what the index claims
        return Outcome(name, "found" if faults else "a cache too small for a sound archive", str(refused))
    except FormatError as refused:  # the level does not describe this archive
        return Outcome(
            name, "refused" if faults else "a server refuses what validate finds sound", str(refused)
        )
    with scene:
        scene.add_avatar("a", AVATAR, AVATAR_RADIUS)
        found = scene.collide("a", template.poses).verdict
    truth = np.array(list(_truth(folder, template)))
    clear, contact = found == Verdict.CLEAR, found == Verdict.CONTACT
    unknown = int((found == Verdict.UNKNOWN).sum())
    message = faults[0] if faults else ""
    wrong = int((clear & truth).sum()), int((contact & ~truth).sum())
    if not any(wrong):
        return Outcome(name, "found" if faults else "right", message, unknown)
    if faults and any(field in name for field in (*ENCLOSING, *ENCLOSING_TOO)):
        return Outcome(name, "bounds found by validate --deep", message, unknown)
    told = f"{wrong[0]} wrong clear, {wrong[1]} wrong contact, of {len(faults)} faults: {message}"
    return Outcome(name, "wrong answers", told, unknown)
