"""Archives that store scan numbers, and the expected answers of `contacts`."""

from pathlib import Path
from typing import Any, NamedTuple

import naive
import naive_contacts
import numpy as np
import radius_class_archives
import synthetic_scans
from kept_archives import build_or_copy
from numpy.typing import NDArray
from solidcloud.builder.config import BuildConfig
from solidcloud.schemas.wire.answers import ContactsAnswers, Verdict
from solidcloud.server.archives.scene_info import describe
from solidcloud.server.avatars.avatar_model import AvatarModel, make_avatar
from solidcloud.server.queries.contacts import contacts
from solidcloud.server.queries.query_inputs import (
    EXACT,
    QueryBudget,
    SceneData,
    make_scene_data,
    with_radius_model,
)
from solidcloud.server.residency.voxel_cache import VoxelCache
from solidcloud.server.residency.voxel_store import VoxelStore


class ScanCase(NamedTuple):
    """An archive, its points (n, 3) [m] and the scan number (n,) of each; -1 if not stored.

    radii: (n,) of the points' spheres, exact units.
    """

    store: VoxelStore
    data: SceneData
    points: NDArray[np.float64]
    numbers: NDArray[np.int64]
    radii: NDArray[np.int64]


def open_case(
    folder: Path,
    points: NDArray[np.float64],
    rng: np.random.Generator,
    *,
    scan_count: int = 2,
    kept: bool = True,
    budget_bytes: int = 64 << 20,
    **options: Any,
) -> ScanCase:
    """Spread points over scans, none empty; build and open their archive.

    The archive lies in a new folder inside `folder`.
    """
    number = sum(1 for _ in folder.iterdir())
    own = folder / str(number)
    own.mkdir()
    scan_count = min(scan_count, len(points))
    which = rng.permutation(np.arange(len(points)) % scan_count)
    paths = [synthetic_scans.write_ply(own / f"{i}.ply", points[which == i]) for i in range(scan_count)]
    options = {"voxel": 0.5, "resolution": 1e-4, "radius": 0.01, "jobs": 1} | options
    keep = frozenset({"scan"}) if kept else frozenset()
    build_or_copy(paths, own / "archive", BuildConfig(keep=keep, **options))
    store = VoxelStore(own / "archive")
    data = make_scene_data(store.archive, VoxelCache(store, budget_bytes))
    # Scan numbers as users see them: rows of SceneInfo.sources.
    listed = [Path(source.path).name for source in describe(store, "scene").sources]
    rows = np.array([listed.index(path.name) for path in paths])
    radii = np.full(len(points), data.radius_units)
    return ScanCase(store, data, points, rows[which] if kept else np.full(len(points), -1), radii)


def with_model(case: ScanCase, model: str | None) -> ScanCase:
    """Return the case with a radius model.

    Coinciding points share a class, as `classes.any_classes` assigns it.
    """
    archive = case.store.archive
    stored, radii = radius_class_archives.stored_radii(archive.folder, model)
    of = dict(zip(map(tuple, stored.tolist()), radii.tolist(), strict=True))
    lattice = naive.lattice_of(case.points, archive.header.lattice.origin, archive.header.lattice.step)
    own = np.array([of[tuple(point)] for point in lattice.tolist()], np.int64)
    return case._replace(data=with_radius_model(case.data, archive, model), radii=own)


def tight(case: ScanCase, budget_bytes: int) -> ScanCase:
    """Return the case with an empty cache of budget_bytes."""
    small = make_scene_data(case.store.archive, VoxelCache(case.store, budget_bytes))
    arrays = small.arrays._replace(radius_deficit=case.data.arrays.radius_deficit)
    return case._replace(data=small._replace(arrays=arrays, radius_units=case.data.radius_units))


def compare(
    case: ScanCase,
    avatar: NDArray[np.float64],
    radius: float,
    poses: NDArray[np.float64],
    limit: int = 100,
    margin: float = 0.0,
    cluster_distance: float | None = None,
    budget: QueryBudget = EXACT,
) -> ContactsAnswers:
    """Query, and compare every column with the expected answers, bit for bit. Returns the answers."""
    model = make_avatar(avatar, radius)
    answers = contacts(case.data, model, poses, limit, margin, cluster_distance, budget)
    assert answers.exact.all() and not answers.voxels_missing.any()
    expect(answers, case, model, poses, limit, margin, cluster_distance)
    return answers


def expect(
    answers: ContactsAnswers,
    case: ScanCase,
    model: AvatarModel,
    poses: NDArray[np.float64],
    limit: int,
    margin: float,
    cluster_distance: float | None,
) -> None:
    """Compare answers with the expected ones."""
    header = case.store.archive.header
    step, origin = header.lattice.step, np.array(header.lattice.origin)
    margin_units = round(margin * naive.UNITS)
    lattice = naive.lattice_of(case.points, origin, step)
    assert len(answers) == len(answers.pair_starts) - 1 == len(answers.cluster_starts) - 1 == len(poses)
    for i, pose in enumerate(poses):
        reach = case.radii + naive.reach_units(model.radius, 0.0, margin)
        pairs = naive_contacts.pairs_of(lattice, case.numbers, step, origin, model.points, pose, reach)
        cluster_units = 2 * (naive.reach_units(model.radius, 0.0, margin) + case.data.radius_units)
        if cluster_distance is not None:
            cluster_units = round(cluster_distance * naive.UNITS)
        clusters, of_pair = naive_contacts.clusters_of(pairs, naive_contacts.edge_steps(cluster_units, step))
        assert answers.pairs_found[i] == len(pairs)
        assert answers.verdict[i] == (Verdict.CONTACT if pairs else Verdict.CLEAR)
        own = slice(answers.pair_starts[i], answers.pair_starts[i + 1])
        listed = pairs[:limit]
        assert answers.avatar_index[own].tolist() == [pair.row for pair in listed]
        assert answers.scan_index[own].tolist() == [pair.scan for pair in listed]
        assert answers.cluster[own].tolist() == of_pair[:limit]
        centers = np.array([pair.center for pair in listed]).reshape(-1, 3) / naive.UNITS + origin
        assert np.array_equal(answers.avatar_point[own], centers)
        assert np.array_equal(answers.cloud_point[own], world(lattice_points(listed), step, origin))
        signed = [naive_contacts.signed_distance(pair.square, pair.reach - margin_units) for pair in listed]
        assert answers.signed_distance[own].tolist() == signed
        own = slice(answers.cluster_starts[i], answers.cluster_starts[i + 1])
        deepest = [cluster.deepest for cluster in clusters]
        assert answers.cluster_count[own].tolist() == [cluster.count for cluster in clusters]
        assert answers.cluster_scan[own].tolist() == [pair.scan for pair in deepest]
        signed = [naive_contacts.signed_distance(pair.square, pair.reach - margin_units) for pair in deepest]
        assert answers.cluster_deepest[own].tolist() == signed
        centers = np.array([pair.center for pair in deepest]).reshape(-1, 3) / naive.UNITS + origin
        assert np.array_equal(answers.cluster_avatar[own], centers)
        assert np.array_equal(answers.cluster_cloud[own], world(lattice_points(deepest), step, origin))
        for column, corner in ((answers.cluster_low, "low"), (answers.cluster_high, "high")):
            corners = np.array([getattr(cluster, corner) for cluster in clusters]).reshape(-1, 3)
            assert np.array_equal(column[own], world(corners, step, origin))


def lattice_points(pairs: list[naive_contacts.Pair]) -> NDArray[np.int64]:
    """Return the scan points (p, 3) of pairs, lattice."""
    return np.array([pair.point for pair in pairs], np.int64).reshape(-1, 3)


def world(lattice: NDArray[np.int64], step: float, origin: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the world positions of lattice points [m]."""
    return np.asarray(lattice * step + origin)
