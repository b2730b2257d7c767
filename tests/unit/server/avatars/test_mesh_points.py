"""Points over the surface of a mesh and inside closed ones: no hole, nothing outside, the same every time, limits."""

import math

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from solidcloud.schemas.errors import BadRequestError, TooLargeError
from solidcloud.server.avatars import mesh_points
from solidcloud.server.avatars.avatar_shape import avatar_shape
from solidcloud.server.avatars.mesh_points import closed_parts, cover_surface

Floats = NDArray[np.float64]


def box(size: float, at: tuple[float, float, float] = (0.0, 0.0, 0.0), turned_in: bool = False) -> Floats:
    """The triangles (12, 3, 3) of a cube."""
    triangles = np.asarray(trimesh.creation.box((size,) * 3).triangles, np.float64) + at
    return triangles[:, ::-1] if turned_in else triangles


def mixed(triangles: Floats) -> Floats:
    """The same triangles, every other turned."""
    found = triangles.copy()
    found[::2] = found[::2, ::-1]
    return found


def of(mesh: trimesh.Trimesh, *, turn: bool = False, far: float = 0.0) -> Floats:
    """The triangles (n, 3, 3) of a mesh."""
    if turn:
        mesh = mesh.copy().apply_transform(trimesh.transformations.rotation_matrix(0.7, [1, 2, 3]))
    return np.asarray(mesh.triangles, np.float64) + far


ANNULUS, TORUS = trimesh.creation.annulus(0.3, 0.5, 0.4), trimesh.creation.torus(1.0, 0.3, 16, 10)
# Closed meshes: parts that are oriented alike.
CLOSED: dict[str, list[Floats]] = {
    "cube": [box(1.0)],
    "cube, turned": [of(trimesh.creation.box((1, 1, 1)), turn=True)],
    "cube in a map's coordinates": [box(1.0) + np.array([4e6, 5e6, 100.0])],
    "ball": [of(trimesh.creation.icosphere(2))],
    "torus": [of(TORUS)],
    "annulus, turned": [of(ANNULUS, turn=True)],
    "plate thinner than a sphere": [box(1.0) * [1, 1, 0.004]],
    "cubes that overlap": [box(1.0), box(1.0, (0.5, 0.3, 0.2))],
    "cubes that overlap, one mirrored": [box(1.0), box(1.0, (0.5, 0.3, 0.2), turned_in=True)],
    "cubes that share a side": [box(1.0), box(1.0, (1.0, 0.0, 0.0))],
    "cubes that share an edge": [box(1.0), box(1.0, (1.0, 1.0, 0.0))],
    "bolt in a cube": [box(1.0), box(0.2)],
    "cube turned inside out": [box(1.0, turned_in=True)],
}


def winding(triangles: Floats, places: Floats) -> Floats:
    """The winding number of a mesh around places: solid angles, after van Oosterom and Strackee 1983."""
    a, b, c = (triangles[None, :, n] - places[:, None] for n in range(3))
    la, lb, lc = (np.linalg.norm(each, axis=2) for each in (a, b, c))
    dot = lambda u, v: (u * v).sum(axis=2)  # noqa: E731
    below = la * lb * lc + dot(a, b) * lc + dot(b, c) * la + dot(c, a) * lb
    return np.arctan2(dot(a, np.cross(b, c)), below).sum(axis=1) / (2 * np.pi)


def inside(parts: list[Floats], places: Floats) -> NDArray[np.bool_]:
    """Which places are inside a part."""
    return np.any([np.abs(winding(part, places)) > 0.5 for part in parts], axis=0)


def shape_of(triangles: Floats, radius: float | None = None) -> tuple[Floats, Floats, float, str]:
    """Points of the surface and inside, radius and description of a mesh."""
    mesh = trimesh.Trimesh(**trimesh.triangles.to_kwargs(triangles), process=False)
    shape = avatar_shape(mesh, radius)
    assert shape.radius is not None
    return shape.surface, np.asarray(shape.points)[len(shape.surface) :], shape.radius, shape.description


@pytest.mark.parametrize("name", CLOSED)
def test_every_place_inside_is_within_the_radius_of_a_point(name: str, rng: np.random.Generator) -> None:
    triangles = np.concatenate(CLOSED[name])
    surface, inner, radius, description = shape_of(triangles, None if name == "torus" else 0.15)
    assert description == "closed mesh, filled"
    low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    places = rng.uniform(low, high, (600, 3))
    places = places[inside(CLOSED[name], places)]
    assert len(places) > 100
    tree = cKDTree(np.concatenate([surface, inner]))
    # Places beside the surface too, where a lattice alone would leave holes.
    beside = surface[rng.integers(len(surface), size=600)] + rng.normal(size=(600, 3)) * radius / 3
    beside = beside[inside(CLOSED[name], beside)]
    assert max(tree.query(places)[0].max(), tree.query(beside)[0].max(initial=0.0)) <= radius
    # Each point inside is inside, or on the surface.
    some = inner[rng.permutation(len(inner))[:200]]
    out = some[~inside(CLOSED[name], some)]
    if len(out):
        _, distance, _ = closest(triangles, out)
        assert distance.max() <= 1e-6 * max(1.0, np.abs(low).max() * 1e-6)
    assert not set(map(tuple, inner.tolist())) & set(map(tuple, surface.tolist()))


def closest(triangles: Floats, places: Floats) -> tuple[Floats, Floats, Floats]:
    """The nearest place, distance and triangle of each place."""
    each = np.repeat(places, len(triangles), axis=0)
    near = trimesh.triangles.closest_point(np.tile(triangles, (len(places), 1, 1)), each)
    apart = np.linalg.norm(near - each, axis=1).reshape(len(places), -1)
    best = apart.argmin(axis=1)
    rows = np.arange(len(places))
    return near.reshape(len(places), -1, 3)[rows, best], apart[rows, best], best


def test_a_cavity_stays_empty_and_what_is_in_it_is_filled(rng: np.random.Generator) -> None:
    triangles = np.concatenate([box(1.0), box(0.6, turned_in=True), box(0.2)])
    surface, inner, radius, _ = shape_of(triangles)
    largest = np.abs(inner).max(axis=1)
    assert not ((largest < 0.3) & (largest > 0.1)).any()
    tree = cKDTree(np.concatenate([surface, inner]))
    places = rng.uniform(-0.5, 0.5, (20_000, 3))
    depth = np.abs(places).max(axis=1)
    solid = (depth > 0.3) | (depth < 0.1)
    assert tree.query(places[solid])[0].max() <= radius
    assert tree.query(places[(depth < 0.2) & (depth > 0.19)])[0].max() > radius, "the cavity"


def test_triangles_of_both_orientations_are_turned_alike() -> None:
    for first, second in zip(shape_of(mixed(box(1.0)))[:2], shape_of(box(1.0))[:2], strict=True):
        assert np.array_equal(first, second)


def test_a_mesh_of_both_sides_counts_once() -> None:
    _, inner, _, description = shape_of(np.concatenate([box(1.0), box(1.0, turned_in=True)]))
    assert description == "closed mesh, filled" and len(inner) > 5_000


@pytest.mark.parametrize(
    "added",
    [box(1.0)[:5], box(1.0)[:5, ::-1], box(1.0, (3.0, 0.0, 0.0)).repeat(2, axis=0)],
    ids=["some twice", "some of both sides", "another part of both sides"],
)
def test_repeated_triangles_leave_a_mesh_closed(added: Floats) -> None:
    if len(added) == 24:
        added[::2] = added[::2, ::-1]
    found = closed_parts(np.concatenate([box(1.0), added]))
    _, inner, _, description = shape_of(np.concatenate([box(1.0), added]))
    assert found.open_parts == 0 and description == "closed mesh, filled"
    assert all((np.abs(inner - [3 * n, 0, 0]) < 0.5).all(axis=1).sum() > 5_000 for n in range(found.parts))


@pytest.mark.parametrize(
    ("triangles", "open_parts"),
    [
        (box(1.0)[:-1], 1),
        (np.concatenate([box(1.0), box(1.0)[:1] + 5.0]), 1),
        (np.concatenate([box(1.0), [[[-0.5, 0, -0.5], [0.5, 0, -0.5], [0.5, 0, 0.5]]]]), 1),
        (np.array([[[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]]), 1),
        (np.zeros((1, 3, 3)), 0),
    ],
    ids=["a side is missing", "a loose triangle", "a triangle within", "a line", "a point"],
)
def test_what_is_open_is_not_filled(triangles: Floats, open_parts: int) -> None:
    found = closed_parts(triangles)
    assert found.open_parts == open_parts
    assert found.closed.sum() == 12 * (len(triangles) >= 12 and not np.array_equal(triangles, box(1.0)[:-1]))


def test_open_meshes_say_that_they_are_surfaces() -> None:
    surface = "a surface, with nothing inside"
    cube = trimesh.creation.box((1, 1, 1))
    assert shape_of(box(1.0)[:-1])[3] == f"open mesh: {surface}"
    assert avatar_shape(cube, hollow=True).description == f"mesh, hollow: {surface}"
    assert avatar_shape(cube, hollow=True).inner_points == 0
    _, inner, _, mesh = shape_of(np.concatenate([box(1.0), box(1.0)[:1] + 5.0]))
    assert mesh == f"mesh: 1 of 2 parts closed and filled, the others {surface}" and len(inner) > 1_000
    assert np.abs(inner).max() <= 0.5


def test_too_many_points_offer_a_hollow_mesh_or_a_larger_radius(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mesh_points, "MAX_AVATAR_POINTS", 5_000)  # the surface takes 3,074
    with pytest.raises(TooLargeError, match=r"more than 5000 points .* give `hollow`.* or a larger radius"):
        shape_of(box(1.0), 0.05)


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
    monkeypatch.setattr(mesh_points, "_MAX_TRIANGLES", 11)
    with pytest.raises(TooLargeError, match="simplify the mesh"):
        cover_surface(corners("box"), 10.0, "mesh")
