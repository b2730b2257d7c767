"""Test the choice of the cell size for a number of leaf cells: a build with every size is the judge."""

from pathlib import Path
from typing import Any

import pytest
from archive_edits import built as built  # the fixtures
from archive_edits import files as files
from small_builds import build
from solidcloud.builder import build_limits
from solidcloud.builder.passes.cell_summary import summarize_cells
from solidcloud.schemas.archive.archive import Archive
from synthetic_scans import make_scan, write_xyz


def scans(folder: Path) -> list[Path]:
    """Write two scans: a corner and noise, 250 points each, in several voxels of 0.9 m."""
    return [write_xyz(folder / f"{kind}.xyz", make_scan(kind, 4, 250)) for kind in ("corner", "noise")]


def cells_of(archive: Path) -> tuple[int, int]:
    """Return the number of leaf cells of an archive, and the `cell_points` that it states."""
    with Archive(archive) as opened:
        return summarize_cells(opened).cells, int(opened.header.options["cell_points"])


@pytest.mark.parametrize("kind", ["octree", "balanced"])
@pytest.mark.parametrize("dense", [1 << 20, 40])
def test_cells_are_as_many_as_the_best_of_all_sizes_gives(
    kind: str, dense: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(build_limits, "DENSE_POINTS", dense)
    paths = scans(tmp_path)
    sizes = [4 * 4**h for h in range(4)] if kind == "balanced" else range(1, 26)
    by_size = {}
    # Few voxels, where there are 29 builds.
    options: dict[str, Any] = {
        "voxel": 0.9 if kind == "balanced" else 1.8,
        "leaf": 4,
        "radius": 0.01,
        "overwrite": True,
    }
    for size in sizes:
        build(paths, tmp_path / "a", cells=kind, cell_points=size, **options)
        by_size[size] = cells_of(tmp_path / "a")[0]
    assert len(set(by_size.values())) > 2
    for asked in (1, min(by_size.values()) + 7, 150, 5000):
        build(paths, tmp_path / "b", cells=kind, leaf_cells=asked, **options)
        found, size = cells_of(tmp_path / "b")
        assert asked == 1 or min(by_size.values()) < asked, "larger sizes give still fewer cells"
        least = min(abs(cells - asked) for cells in by_size.values())
        if asked == 1 and kind == "octree":
            assert found <= min(by_size.values()), "more points than any size that was tried"
            continue
        assert abs(found - asked) == least
        assert found == max(cells for cells in by_size.values() if abs(cells - asked) == least)
        assert by_size[size] == found and size == min(s for s in by_size if by_size[s] == found)
