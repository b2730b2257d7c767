"""A sealed archive of two generations with a level and an unknown region, and forgeries of it.

Every forgery is consistent with itself: it passes all checks of a reader without the key.
"""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
from forged_archives import Columns, forge, put_rows, read_index, read_rows
from numpy.typing import NDArray
from small_builds import build
from solidcloud.builder.edit.edit_archive import add_scans
from solidcloud.schemas.archive.seal import SEAL_NAME, make_seal
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


# Some of what FORMAT.md lists under "What a reader cannot find", by a name for each.
FORGERIES: dict[str, Callable[[Path], None]] = {
    "origin": change("origin", lambda column: column + 0.5),
    "spheres that do not enclose": _shrink_spheres,
    "covers that do not reach": _shrink_covers,
}
