"""Test the figure: its number of points, its size, and their even distribution."""

from pathlib import Path

import numpy as np
import plyfile
import pytest
import trimesh
from scipy.spatial import cKDTree
from solidcloud.builder.synthetic.figure import figure_points, write_figure


@pytest.mark.parametrize("points", [1, 500, 3617])
def test_count_is_exact(points: int) -> None:
    assert figure_points(points).shape == (points, 3)


def test_figure_has_the_size_of_a_person() -> None:
    figure = figure_points()
    low, high = figure.min(axis=0), figure.max(axis=0)
    assert low[2] == 0.0
    assert high[2] == pytest.approx(1.75, abs=0.01)
    assert 0.50 < high[0] - low[0] < 0.55
    # A stride: feet before and behind the origin, heads up.
    feet = figure[figure[:, 2] < 0.05]
    assert feet[:, 1].min() < -0.2 and feet[:, 1].max() > 0.2
    assert np.abs(figure[figure[:, 2] > 1.6, :2]).max() < 0.12


def test_points_are_two_centimetres_apart_and_even() -> None:
    figure = figure_points()
    nearest = cKDTree(figure).query(figure, k=2)[0][:, 1]
    assert 0.016 < nearest.mean() < 0.022
    assert nearest.min() > 0.8 * nearest.mean()
    assert nearest.max() < 1.7 * nearest.mean()


def test_files_read_back_to_the_same_bits(tmp_path: Path) -> None:
    figure = figure_points(300)
    write_figure(tmp_path / "al.obj", figure)
    write_figure(tmp_path / "al.ply", figure)
    rows = [
        line.split()[1:] for line in (tmp_path / "al.obj").read_text().splitlines() if line.startswith("v ")
    ]
    assert np.array_equal(np.array(rows, float), figure)
    vertices = plyfile.PlyData.read(tmp_path / "al.ply")["vertex"]
    assert np.array_equal(np.column_stack([vertices[axis] for axis in "xyz"]), figure)
    assert np.array_equal(trimesh.load(tmp_path / "al.ply").vertices, figure)
