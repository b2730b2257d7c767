"""Test the generated sheet: positions of its points and places, and its density."""

from pathlib import Path

import numpy as np
import plyfile
import pytest
from scipy.spatial import cKDTree
from solidcloud.builder.synthetic.sheet import DOOR, HALF_WIDTH, HEIGHT, MARGIN, make_sheet


@pytest.mark.parametrize("spacing", [0.02, 0.06])
def test_points_lie_on_the_sheet_up_to_its_door_as_densely_as_is_said(tmp_path: Path, spacing: float) -> None:
    sheet = make_sheet(tmp_path / "sheet.ply", spacing=spacing)
    vertices = plyfile.PlyData.read(sheet.path)["vertex"]
    x, y, z = (np.asarray(vertices[axis]) for axis in "xyz")
    (door,) = sheet.truth.doors
    assert (door.width, door.y_front, door.y_back) == (DOOR, 0.0, 0.0)
    assert np.abs(x).min() >= DOOR / 2 and np.abs(y).max() < 0.01 and 0.001 < y.std() < 0.002
    assert len(x) == pytest.approx((2 * HALF_WIDTH - DOOR) * HEIGHT / spacing**2, rel=0.06)
    # The rim is scanned: no hand's breadth along it is farther from a point than two spacings.
    rim = np.array(
        [[side * DOOR / 2, 0.0, at] for side in (-1, 1) for at in np.arange(0.1, HEIGHT - 0.1, 0.01)]
    )
    assert cKDTree(np.column_stack([x, y, z])).query(rim)[0].max() < 2 * spacing


def test_places_keep_off_the_edges_on_both_sides_of_the_door(tmp_path: Path) -> None:
    places = make_sheet(tmp_path / "sheet.ply", places=500).places
    assert len(places.points) == 500
    aside = np.abs(places.points[:, 0])
    assert aside.min() >= DOOR / 2 + MARGIN and aside.max() <= HALF_WIDTH - MARGIN
    assert 150 < (places.points[:, 0] < 0).sum() < 350
    assert (places.normals == (0, -1, 0)).all() and (places.points[:, 1] == 0).all()
