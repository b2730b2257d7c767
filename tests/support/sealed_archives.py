"""A sealed archive of two generations with a level and an unknown region, and forgeries of it.

Every forgery is consistent with itself: it passes all checks of a reader without the key.
"""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
from forged_archives import Columns, forge, put_frame, put_rows, read_index, read_rows
from numpy.typing import NDArray
from small_builds import build
from solidcloud.builder.edit.edit_archive import add_scans
from solidcloud.builder.voxel.masked_voxel import build_masked_voxel, read_points
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.archive.seal import SEAL_NAME, make_seal
from solidcloud.schemas.archive.voxel_grid import voxel_coordinates, voxel_keys
from solidcloud.schemas.archive.vtkhdf import PREVIEW_NAME
from synthetic_scans import make_scan, write_las, write_xyz

KEY, OTHER_KEY = bytes(range(32)), bytes(range(1, 33))


def build_unsealed(folder: Path) -> Path:
    """Build an archive with radius classes, generation 1, a level, and a truncated scan left out."""
    first = write_xyz(folder / "first.xyz", make_scan("corner", 1, 1500))
    second = write_xyz(folder / "second.xyz", make_scan("noise", 2, 600))
    cut = folder / "cut.las"
    write_las(cut, np.random.default_rng(3).integers(-1500, 1500, (250, 3)))
    cut.write_bytes(cut.read_bytes()[:-100])
    models = frozenset({"mean", "local", "border"})
    target = folder / "archive"
    build([first, cut], target, keep=frozenset({"scan"}), models=models, skip_bad=True)
    add_scans(target, [second], jobs=1)
    return target


def key_file(folder: Path, key: bytes = KEY) -> Path:
    """Write a key."""
    path = folder / "archives.key"
    path.write_bytes(key)
    return path


def reseal(folder: Path, key: bytes = KEY) -> None:
    """Seal an index as it is, whatever it says, as only one with the key can."""
    from solidcloud.schemas.archive.index import index_digest

    index = read_index(folder)
    digest = index_digest(index.archive_id, index.columns)
    (folder / SEAL_NAME).write_bytes(make_seal(key, index.version, digest))


def change(name: str, to: Callable[[NDArray], NDArray]) -> Callable[[Path], None]:
    """Return a forgery of one dataset."""

    def forgery(folder: Path) -> None:
        forge(
            folder, lambda columns: columns.__setitem__(name, to(columns[name]).astype(columns[name].dtype))
        )
        if name in ("origin", "step"):
            _remove_copies(folder)

    return forgery


def _remove_copies(folder: Path) -> None:
    """Remove what would contradict a forged index, and what no reader needs: the level and the preview."""
    shutil.rmtree(folder / "level")
    (folder / PREVIEW_NAME).unlink()


def _first(value: Callable[[float], float]) -> Callable[[NDArray], NDArray]:
    """Return a change of the first number of a dataset."""

    def changed(column: NDArray) -> NDArray:
        column = column.copy()
        column.flat[0] = value(column.flat[0])
        return column

    return changed


def _move_scan(poses: NDArray) -> NDArray:
    poses = poses.copy()
    poses[0, 0, 3] += 5
    return poses


def _other_path(folder: Path) -> None:
    def changed(columns: Columns) -> None:
        texts = json.loads(columns["texts"].tobytes())
        texts["sources"][0]["path"] = "another.xyz"
        data = json.dumps(texts, sort_keys=True, separators=(",", ":")).encode()
        columns["texts"] = np.frombuffer(data, np.uint8)

    forge(folder, changed)


def _forget_the_unknown_region(folder: Path) -> None:
    def changed(columns: Columns) -> None:
        texts = json.loads(columns["texts"].tobytes())
        (row,) = (i for i, source in enumerate(texts["sources"]) if "unknown" in source)
        del texts["sources"][row]
        data = json.dumps(texts, sort_keys=True, separators=(",", ":")).encode()
        columns["texts"] = np.frombuffer(data, np.uint8)
        columns["unknown"] = columns["unknown"][:0]
        for name in ("source_pose", "source_count"):
            columns[name] = np.delete(columns[name], row, axis=0)
        assert not columns["unknown_everywhere"][0]

    forge(folder, changed)
    _remove_copies(folder)  # it names the region too


def _sum_up(columns: Columns, classes: NDArray, points: int) -> None:
    """Bring bounds and counts in line with the voxels, `points` fewer points with these classes."""
    rows, steps = columns["voxels"], int(columns["voxel_steps"][0])
    base = voxel_coordinates(rows["key"]) * steps
    columns["bounds"] = np.stack([(base + rows["low"]).min(axis=0), (base + rows["high"]).max(axis=0)])
    columns["points"] = columns["points"] - np.uint64(points)
    columns["source_count"] = columns["source_count"].copy()
    columns["source_count"][int(np.argmax(columns["source_count"]))] -= np.uint64(points)
    columns["radius_counts"] = columns["radius_counts"] - classes.astype(np.uint64)
    columns["radius_sample"] = np.minimum(columns["radius_sample"], columns["points"])
    columns["radius_capped"] = np.minimum(columns["radius_capped"], columns["points"])
    if "radius_now" in columns:
        columns["radius_now"] = columns["radius_now"].copy()
        columns["radius_now"][2] = min(columns["radius_now"][2], float(columns["points"][0]))


def _leave_out_a_voxel(folder: Path) -> None:
    with Archive(folder) as archive:
        row = int(np.argmin(archive.voxels["rows"][:, 2]))
        classes = archive.open_voxel(row).class_counts()

    def changed(columns: Columns) -> None:
        gone = int(columns["voxels"]["rows"][row, 2])
        for name in {"voxels", "record_digest"} & columns.keys():
            columns[name] = np.delete(columns[name], row, axis=0)
        _sum_up(columns, classes, gone)

    forge(folder, changed)
    _remove_copies(folder)  # it has this voxel; without it, answers are slower and the same


def _leave_out_points(folder: Path) -> None:
    with Archive(folder) as archive:
        row = int(np.argmax(archive.voxels["rows"][:, 2]))
        points, key = read_points(archive, row), int(archive.voxels["key"][row])
        stays = np.arange(len(points.local)) % 3 != 0
        built = build_masked_voxel(archive.header, key, points, stays)
    classes = np.bincount(points.radius_class[~stays], minlength=32)

    def changed(columns: Columns) -> None:
        entry = columns["voxels"][row]
        for i, frame in enumerate((built.record.cells, built.record.nodes, built.record.points)):
            put_frame(folder, columns, row, i, bytes(frame))
        entry["rows"] = built.record.cell_rows, built.record.node_rows, built.record.point_rows
        entry["leaves"], entry["low"], entry["high"] = built.record.leaf_rows, built.low, built.high
        _sum_up(columns, classes, int(np.count_nonzero(~stays)))

    forge(folder, changed)
    _remove_copies(folder)


def _move_points(folder: Path) -> None:
    """Move the points of a voxel by some steps along x; everything in it moves with them."""
    with Archive(folder) as archive:
        row = int(np.argmax(archive.voxels["rows"][:, 2]))
        points, key = read_points(archive, row), int(archive.voxels["key"][row])
        room = archive.header.lattice.voxel_steps - 1 - int(points.local[:, 0].max())
        shift = np.array([min(room, 40) or -min(int(points.local[:, 0].min()), 40), 0, 0], np.int32)
        assert shift.any()
        moved = points._replace(local=points.local + shift)
        built = build_masked_voxel(archive.header, key, moved, np.ones(len(moved.local), bool))

    def changed(columns: Columns) -> None:
        entry = columns["voxels"][row]
        for i, frame in enumerate((built.record.cells, built.record.nodes, built.record.points)):
            put_frame(folder, columns, row, i, bytes(frame))
        entry["rows"] = built.record.cell_rows, built.record.node_rows, built.record.point_rows
        entry["leaves"], entry["low"], entry["high"] = built.record.leaf_rows, built.low, built.high
        _sum_up(columns, np.zeros(32), 0)

    forge(folder, changed)
    _remove_copies(folder)


def _give_a_voxel_another_cell(folder: Path) -> None:
    def changed(columns: Columns) -> None:
        rows = columns["voxels"]
        held = set(rows["key"].tolist())
        for at in range(len(rows)):
            for shift in np.eye(3, dtype=np.int64).tolist():
                key = int(voxel_keys(voxel_coordinates(rows["key"][at : at + 1]) + np.array(shift))[0])
                others = np.append(np.delete(rows["key"], at), np.uint64(key))
                if key not in held and (others[1:] > others[:-1]).sum() >= len(others) - 2:
                    rows["key"][at] = key
                    order = np.argsort(rows["key"])
                    for name in {"voxels", "record_digest"} & columns.keys():
                        columns[name] = columns[name][order]
                    _sum_up(columns, np.zeros(32), 0)
                    return
        raise AssertionError("no free cell")

    forge(folder, changed)
    _remove_copies(folder)


def _shrink_spheres(folder: Path) -> None:
    def changed(columns: Columns) -> None:
        nodes = read_rows(folder, columns, 0, 1)
        nodes["radius"] = 0
        put_rows(folder, columns, 0, 1, nodes)

    forge(folder, changed)


def _shrink_covers(folder: Path) -> None:
    level = folder / "level"

    def changed(columns: Columns) -> None:
        counts = np.zeros(32, np.uint64)
        counts[0] = columns["points"][0]
        columns["radius_counts"] = counts
        for row in range(len(columns["voxels"])):
            points = read_rows(level, columns, row, 2)
            points["radius_class"] = 0
            put_rows(level, columns, row, 2, points)

    forge(level, changed)


def _hide_the_largest_class(folder: Path) -> None:
    def changed(columns: Columns) -> None:
        counts = columns["radius_counts"].copy()
        first, last = np.flatnonzero(counts)[[0, -1]]
        counts[first] += counts[last]
        counts[last] = 0
        columns["radius_counts"] = counts

    forge(folder, changed)


# What FORMAT.md lists under "What a reader cannot find", by a name for each.
FORGERIES: dict[str, Callable[[Path], None]] = {
    "origin": change("origin", lambda column: column + 0.5),
    "step": change("step", lambda column: column * 1.01),
    "radius": change("radius", lambda column: column / 2),
    "radius_now": change("radius_now", _first(lambda radius: radius / 2)),
    "moved_max": change("moved_max", lambda column: column * 0),
    "source_pose": change("source_pose", _move_scan),
    "texts": _other_path,
    "points moved": _move_points,
    "points left out": _leave_out_points,
    "a voxel left out": _leave_out_a_voxel,
    "a voxel in another cell": _give_a_voxel_another_cell,
    "an unknown region left out": _forget_the_unknown_region,
    "spheres that do not enclose": _shrink_spheres,
    "covers that do not reach": _shrink_covers,
    "classes that are not counted": _hide_the_largest_class,
}
