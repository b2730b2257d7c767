"""Points over the surface of a mesh: no hole, the same every time, limits."""

import math

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree
from solidcloud.schemas.errors import BadRequestError, TooLargeError
from solidcloud.server.avatars import surface_points
from solidcloud.server.avatars.surface_points import cover_surface

SLIVER = trimesh.Trimesh([[0, 0, 0], [2, 0, 0], [1, 0.001, 0]], [[0, 1, 2]], process=False)
MESHES = {
    "box": trimesh.creation.box((1.0, 0.5, 0.25)),
    "cylinder": trimesh.creation.cylinder(0.3, 1.8),
    "sphere": trimesh.creation.icosphere(4),
    "sliver": SLIVER,
}


def corners(name: str) -> np.ndarray:
    """The triangles (n, 3, 3) of a mesh."""
    return np.asarray(MESHES[name].triangles, np.float64)


@pytest.mark.parametrize("radius", [None, 0.05])
@pytest.mark.parametrize("name", MESHES)
def test_no_part_of_the_surface_is_farther_than_the_radius_from_a_point(
    name: str, radius: float | None, rng: np.random.Generator
) -> None:
    triangles = corners(name)
    points, used, _ = cover_surface(triangles, radius, "mesh")
    assert used is not None and used == (radius or used)
    weights = rng.dirichlet([1, 1, 1], 10_000)
    within = np.einsum("kc,kcx->kx", weights, triangles[rng.integers(len(triangles), size=len(weights))])
    edges = np.concatenate([within, (triangles[:, 0] + triangles[:, 1]) / 2])
    assert cKDTree(points).query(edges)[0].max() <= used


def test_every_corner_is_a_point_and_none_is_there_twice() -> None:
    points, _, _ = cover_surface(corners("box"), 0.05, "mesh")
    found = set(map(tuple, points.tolist()))
    assert len(found) == len(points)
    assert found >= set(map(tuple, MESHES["box"].vertices.tolist()))
    assert not np.signbit(points[points == 0]).any()


def test_the_default_radius_is_a_hundredth_of_the_root_of_the_area() -> None:
    points, radius, _ = cover_surface(corners("box"), None, "mesh")
    assert radius == pytest.approx(math.sqrt(MESHES["box"].area) / 100, abs=2.0**-20)
    assert 5_000 < len(points) < 40_000
    larger, ten, _ = cover_surface(corners("box") * 4, None, "mesh")
    assert len(larger) == len(points) and ten == pytest.approx(4 * (radius or 0), abs=2.0**-18)


@pytest.mark.parametrize(
    ("triangles", "radius", "error", "message"),
    [
        (corners("box") * np.nan, 0.1, BadRequestError, "hall.stl: a vertex that is not finite"),
        (corners("box") + 1.1e9, 0.1, BadRequestError, "beyond 1e\\+09 m: expected finite coordinates"),
        (corners("box"), 0.0, BadRequestError, "radius 0 m: expected a positive length"),
        (corners("box"), -1.0, BadRequestError, "radius -1 m: expected a positive length"),
        (corners("box"), math.nan, BadRequestError, "radius nan m: expected a positive length"),
        (corners("box") * 1e3, None, BadRequestError, "give the unit of its file, scale the mesh, or"),
        (corners("box"), 1e-5, TooLargeError, "more than 1000000 points at a radius of 1e-05 m"),
    ],
)
def test_what_cannot_be_covered_is_refused(
    triangles: np.ndarray, radius: float | None, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        cover_surface(triangles, radius, "hall.stl")


def test_a_mesh_of_too_many_triangles_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(surface_points, "_MAX_TRIANGLES", 11)
    with pytest.raises(TooLargeError, match="simplify the mesh"):
        cover_surface(corners("box"), 10.0, "mesh")
