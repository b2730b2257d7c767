"""Test the choice of the cell size for a number of leaf cells: builds with other sizes are the judge."""

from pathlib import Path
from typing import Any

from small_builds import build
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


def test_no_other_size_gives_cells_nearer_the_number_asked_for(tmp_path: Path) -> None:
    paths = scans(tmp_path)
    options: dict[str, Any] = {"voxel": 1.8, "leaf": 4, "radius": 0.01, "overwrite": True}
    build(paths, tmp_path / "a", leaf_cells=150, **options)
    found, size = cells_of(tmp_path / "a")
    assert 2 < size < 60
    for other in (size - 1, size, size + 1, 2 * size):
        build(paths, tmp_path / "b", cell_points=other, **options)
        cells = cells_of(tmp_path / "b")[0]
        assert abs(found - 150) <= abs(cells - 150) and (other != size or cells == found)
