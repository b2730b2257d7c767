"""Test that a preview holds some of the archive's points, with their columns."""

from pathlib import Path

import numpy as np
import pytest
import solidcloud.builder.passes.preview as preview
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.kernels.points.voxel_records import point_hashes
from solidcloud.builder.passes.preview import write_preview
from solidcloud.builder.pipeline import build_archive
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.archive.vtkhdf import PREVIEW_NAME, read_points
from synthetic_scans import make_scan, write_ply


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An archive of two scans with all columns; not to be changed but for its preview."""
    folder = tmp_path_factory.mktemp("built")
    for i, kind in enumerate(("noise", "duplicates")):
        intensity = np.arange(500, dtype=np.float32) + 1000 * i
        write_ply(folder / f"{i}.ply", make_scan(kind, i, 500) + np.array([5e5, 5.6e6, 0]), intensity)
    config = BuildConfig(
        voxel=1.1, cell_points=50, jobs=1, keep=frozenset(("scan", "intensity")), resolution=0.001
    )
    build_archive([folder], folder / "a", config)
    return folder / "a"


def stored(folder: Path) -> dict[tuple[int, ...], set[tuple[int, float]]]:
    """Lattice point -> the scans and intensities that the archive has there, by the plain decoder."""
    found: dict[tuple[int, ...], set[tuple[int, float]]] = {}
    with Archive(folder) as archive:
        for row, corner in enumerate(archive.coordinates * archive.header.lattice.voxel_steps):
            voxel, links = archive.read_voxel(row)
            assert voxel.scan_index is not None and voxel.intensity is not None
            for node in np.flatnonzero(links.is_leaf).tolist():
                low = corner + voxel.cells.low[links.cell[node]] + voxel.nodes.block_low[node]
                begin = int(links.first[node])
                for i in range(begin, begin + int(voxel.nodes.count[node])):
                    place = tuple((voxel.points[i] + low).tolist())
                    found.setdefault(place, set()).add((int(voxel.scan_index[i]), float(voxel.intensity[i])))
    return found


@pytest.mark.parametrize("most", [100, 200_000])
def test_points_are_chosen_by_hash_and_have_their_columns(
    most: int, built: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(preview, "MAX_PREVIEW_POINTS", most)
    count = write_preview(built)
    found, places = read_points(built / PREVIEW_NAME), stored(built)
    with Archive(built) as archive:
        header = archive.header
    lattice = header.lattice.to_lattice(found.points)
    assert (np.abs(header.lattice.to_world(lattice) - found.points) <= 2.0**-14).all()
    chosen = [tuple(point) for point in lattice.tolist()]
    assert len(chosen) == len(set(chosen)) == count
    if most > len(places):
        assert set(chosen) == set(places)
    else:
        by_hash = sorted(places, key=lambda place: int(point_hashes(np.array([place]))[0]))
        assert 10 < count <= most and set(chosen) == set(by_hash[:count])
    for place, scan, intensity in zip(chosen, found.columns["scan"], found.columns["intensity"], strict=True):
        assert (int(scan), float(intensity)) in places[place]
