"""Scans to add and remove, archives of some of them, and comparisons, for tests of changed archives."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import synthetic_scans
from numpy.typing import NDArray
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.edit.rebuild_voxels import ChangeSummary
from solidcloud.builder.passes.verify import verify_archive
from solidcloud.builder.pipeline import build_archive
from solidcloud.builder.voxel.record_points import voxel_points
from solidcloud.schemas.archive.archive import Archive

OPTIONS: dict[str, Any] = {"voxel": 0.5, "resolution": 1e-3, "jobs": 1}
EVERYTHING = frozenset({"scan", "intensity"})


def cloud(kind: str, seed: int, count: int) -> NDArray[np.float64]:
    """Return points on the lattice, away from its border, so that no build moves them."""
    return np.round(0.25 + 0.75 * synthetic_scans.make_scan(kind, seed, count), 3)


# The corner gives every lattice the same origin. B lies partly in voxels of A, partly in new ones.
A = np.vstack([[[0.0, 0, 0]], cloud("corner", 1, 900)])
B = np.vstack([cloud("noise", 2, 150) * [0.5, 0.5, 0.5], [[2.6, 2.6, 2.6], [-0.0, 0.0, 0.0]]]).round(3)
C = cloud("pillar", 3, 300) + np.array([0.75, 0, 0])


class Files(NamedTuple):
    """The scans as files."""

    a: Path
    b: Path
    c: Path


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Files:
    """Write A, B and C with intensities."""
    folder = tmp_path_factory.mktemp("scans")
    rng = np.random.default_rng(9)
    return Files(
        *(
            synthetic_scans.write_ply(
                folder / f"{name}.ply", xyz, rng.integers(0, 4, len(xyz)).astype(np.float32)
            )
            for name, xyz in (("a", A), ("b", B), ("c", C))
        )
    )


Build = Callable[..., Path]


@pytest.fixture(scope="module")
def built(files: Files, tmp_path_factory: pytest.TempPathFactory) -> Build:
    """Builder of archives of some scans: builds each archive once and returns copies."""
    kept: dict[Any, Path] = {}

    def build(target: Path, which: str, **options: Any) -> Path:
        known = (which, *sorted(options.items()))
        if known not in kept:
            kept[known] = tmp_path_factory.mktemp("built") / "archive"
            chosen = [getattr(files, name) for name in which]
            build_archive(chosen, kept[known], BuildConfig(**{**OPTIONS, **options}))
        shutil.copytree(kept[known], target)
        return target

    return build


def content(folder: Path) -> dict[int, dict[str, bytes]]:
    """Return the bytes of every record's columns by voxel key.

    scan_index is replaced by the paths of the scans.
    """
    found = {}
    with Archive(folder) as archive:
        names = [Path(source.path).name for source in archive.header.sources]
        for row in range(len(archive.voxels)):
            voxel, _ = archive.read_voxel(row)
            columns = {
                f"{part}.{name}": column.tobytes()
                for part in ("cells", "nodes")
                for name, column in getattr(voxel, part)._asdict().items()
            }
            columns |= {
                name: getattr(voxel, name).tobytes()
                for name in ("points", "intensity", "radius_class", "rgb", "classification")
                if getattr(voxel, name) is not None
            }
            if voxel.scan_index is not None:
                columns["scan"] = ",".join(names[scan] for scan in voxel.scan_index.tolist()).encode()
            found[int(archive.voxels["key"][row])] = columns
    return found


def all_points(folder: Path) -> NDArray[np.float64]:
    """Return every point of an archive, sorted."""
    with Archive(folder) as archive:
        lattice = archive.header.lattice
        parts = [
            voxel_points(*archive.read_voxel(row)) + archive.coordinates[row] * lattice.voxel_steps
            for row in range(len(archive.voxels))
        ]
        xyz = lattice.to_world(np.concatenate(parts)).round(3) + 0.0
    return xyz[np.lexsort(xyz.T)]


def sort_points(*clouds: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the points of several scans, in the order of `all_points`."""
    xyz = np.concatenate(clouds).round(3) + 0.0
    return xyz[np.lexsort(xyz.T)]


def snapshot(folder: Path) -> dict[str, bytes]:
    """Return the path and content of every file below a folder."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def same_scene(one: Path, other: Path) -> None:
    """Assert that two archives hold the same points, trees, counts, bounds and distances."""
    assert content(one) == content(other)
    with Archive(one) as first, Archive(other) as second:
        a, b = first.header, second.header
        assert (a.points, a.low.tolist(), a.high.tolist(), a.lattice) == (
            b.points, b.low.tolist(), b.high.tolist(), b.lattice,
        )  # fmt: skip
        assert a.radius_counts.tolist() == b.radius_counts.tolist() and a.radius_capped == b.radius_capped
        held = [sorted((Path(s.path).name, s.count) for s in h.sources if not s.fault) for h in (a, b)]
        assert held[0] == held[1]
    assert not verify_archive(one, deep=True).faults


MODELS = [
    frozenset({"mean"}),
    frozenset({"mean", "local"}),
    frozenset({"mean", "border"}),
    frozenset({"mean", "local", "border"}),
]


def refused(target: Path, error: type[Exception], match: str, change: Callable[[], ChangeSummary]) -> None:
    """Assert that a change is refused and leaves nothing behind."""
    before = snapshot(target.parent)
    with pytest.raises(error, match=match):
        change()
    assert snapshot(target.parent) == before
