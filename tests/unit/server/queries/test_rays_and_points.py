"""`raycast` and `within`: what is missing, what a budget cuts off, what is loaded, and what is refused."""

import math
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import archive_cases
import numpy as np
import pytest
import synthetic_scans
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.pipeline import build_archive
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.archive.units import UNITS_PER_METRE
from solidcloud.schemas.errors import BadRequestError
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.kernels.rays.hits import HitBatch, search_hits
from solidcloud.server.queries import rays_and_points
from solidcloud.server.queries.query_inputs import EXACT, SceneData, make_budget, make_scene_data, with_stop
from solidcloud.server.queries.rays_and_points import raycast, within
from solidcloud.server.residency.voxel_cache import VoxelCache
from solidcloud.server.residency.voxel_store import VoxelStore
from solidcloud.server.runtime.stop_flag import NO_STOP, StopFlag

CLEAR, CONTACT, UNKNOWN = Verdict
X, Y = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)


@contextmanager
def opened(archive: Path, budget: int = 64 << 20) -> Iterator[SceneData]:
    """What the questions read of an archive."""
    store = VoxelStore(archive)
    try:
        yield make_scene_data(store.archive, VoxelCache(store, budget))
    finally:
        store.close()


def flip_a_byte(archive: Path, voxel: tuple[int, int, int]) -> None:
    """Damage the points of one voxel's record."""
    with Archive(archive) as index:
        row = int(np.flatnonzero((index.coordinates == voxel).all(axis=1))[0])
        entry, path = index.voxels[row], index.shard_path(int(index.voxels[row]["shard"]))
    with open(path, "r+b") as file:
        offset = int(entry["frame_offset"][2]) + int(entry["frame_bytes"][2]) // 2
        byte = os.pread(file.fileno(), 1, offset)[0]
        os.pwrite(file.fileno(), bytes([byte ^ 1]), offset)


@pytest.fixture
def beads(tmp_path: Path) -> Path:
    """Points every 10 cm from x = 0 to 3.9 m, radius 1 cm, a voxel a metre."""
    row = np.column_stack([np.arange(0, 4, 0.1), np.zeros(40), np.zeros(40)])
    return archive_cases.build(tmp_path, row, voxel=1.0, resolution=1e-3, radius=0.01).archive


@pytest.fixture(scope="module")
def noise(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Points in 2 m, in voxels of 25 cm."""
    points = synthetic_scans.make_scan("noise", 2, 3000)
    return archive_cases.build(tmp_path_factory.mktemp("noise"), points, voxel=0.25, radius=0.03).archive


@pytest.mark.interpreted
def test_the_first_sphere_is_hit_and_no_more_is_loaded(beads: Path) -> None:
    with opened(beads) as data:
        answers = raycast(data, [(-1.0, 0, 0), (0.5, 0, 0), (0.55, 0, 0), (-1, 1.5, 0)], [X] * 4, 100)
        assert answers.verdict.tolist() == [CONTACT, CONTACT, CONTACT, CLEAR]
        np.testing.assert_allclose(answers.distance[:3], [0.99, 0, 0.04], atol=1e-7)
        np.testing.assert_allclose(answers.hit[:3, 0], [-0.01, 0.5, 0.59], atol=1e-7)
        np.testing.assert_allclose(answers.cloud_point[:3, 0], [0, 0.5, 0.6], atol=1e-9)
        np.testing.assert_array_equal(answers.normal[:3], [[-1, 0, 0]] * 3)
        assert np.isnan(answers.hit[3]).all() and answers.lower[3] == 100 and math.isinf(answers.upper[3])
        assert (answers.misses, answers.hits, answers.resident) == (1, 0, 1)
        assert answers.outside.all() and answers.exact.all()
        again = raycast(data, [(-1.0, 0, 0)], [X], 100)
        assert (again.misses, again.hits) == (0, 1)
        # Through the cells of all voxels, whose points are away.
        through = raycast(data, [(-1, 0.5, 0)], [X], 100)
        assert (through.verdict[0], through.misses, through.node_visits[0]) == (CLEAR, 0, 0)
        inside = raycast(data, [(0.55, 0, 0)], [X], 0.03)
        assert inside.verdict.tolist() == [CLEAR] and not inside.outside[0]
        assert raycast(data, [(0.55, 0, 0)], [X], 4.0).outside[0]
        data.residency.check()


@pytest.mark.interpreted
def test_a_missing_voxel_is_unknown_unless_a_hit_is_nearer(beads: Path) -> None:
    flip_a_byte(beads, (1, 0, 0))
    origins = [(-1.0, 0, 0), (1.05, 0, 0), (1.55, -1, 0), (1.55, -1, 0.5), (1.55, -1, 1.5), (5.0, 0, 0)]
    with opened(beads) as data:
        for _ in range(2):  # read once, remembered after
            answers = raycast(data, origins, [X, X, Y, Y, Y, (-2.0, 0, 0)], 10)
            # The fourth passes the missing voxel's points by the index, though not its cell.
            assert answers.verdict.tolist() == [CONTACT, CONTACT, UNKNOWN, CLEAR, CLEAR, CONTACT]
            assert answers.exact.tolist() == [True, False, False, True, True, True]
            assert answers.voxels_missing.tolist() == [0, 1, 1, 0, 0, 0]
            assert len(answers.faults) == 1
            # Beyond the missing voxel a sphere is hit for certain; whether it is the first one is not.
            np.testing.assert_allclose(answers.upper[1], 0.94, atol=1e-7)
            assert answers.lower[1] == 0 and 0.98 < answers.lower[2] <= 0.99 and math.isinf(answers.upper[2])
        near = within(data, [(0.95, 0, 0), (0.95, 0.3, 0), (1.5, 0.1, 0), (1.5, 0.1, 2), (2.3, 0.1, 0)], 0.7)
        assert near.verdict.tolist() == [CONTACT, CONTACT, CONTACT, CLEAR, CONTACT]
        assert near.exact.tolist() == [False, False, False, True, True]
        assert near.voxels_missing.tolist() == [1, 1, 1, 0, 0]
        np.testing.assert_allclose(near.lower[[0, 2]], [0.05, 0.1], atol=2e-3)
        assert (near.lower[:3] <= [0.05, math.hypot(0.05, 0.3), 0.1]).all()
        assert within(data, [(1.5, 0.1, 0)], 0.2).verdict.tolist() == [UNKNOWN]
        data.residency.check()


def test_a_region_left_out_is_unknown(tmp_path: Path) -> None:
    good = synthetic_scans.write_ply(tmp_path / "good.ply", synthetic_scans.make_scan("noise", 1, 200))
    raw = np.random.default_rng(1).integers(0, 1001, (500, 3))
    raw[:2] = [[0, 0, 0], [1000, 1000, 1000]]
    synthetic_scans.write_las(tmp_path / "broken.las", raw, offset=(10.0, 10.0, 10.0))
    os.truncate(tmp_path / "broken.las", (tmp_path / "broken.las").stat().st_size // 2)
    options = BuildConfig(skip_bad=True, jobs=1, resolution=1e-3, radius=0.1)
    build_archive([good, tmp_path / "broken.las"], tmp_path / "archive", options)
    with opened(tmp_path / "archive") as data:
        origins = [(5.0, 10.5, 10.5), (5.0, 10.5, 10.5), (5.0, 11.05, 10.5), (5.0, 11.2, 10.5), (-5.0, 1, 1)]
        answers = raycast(data, origins, [X, (-1, 0, 0), X, X, (1, 0.01, 0.02)], 100)
        assert answers.verdict.tolist() == [UNKNOWN, CLEAR, UNKNOWN, CLEAR, CONTACT]
        # The header's box grows by 1 cm.
        assert 4.88 < answers.lower[0] <= 4.89 and answers.exact.tolist() == [False, True, False, True, True]
        near = within(data, [(9.9, 10.5, 10.5), (9.9, 10.5, 10.5), (5, 5, 5)], 0.2)
        assert near.verdict.tolist() == [UNKNOWN, UNKNOWN, CLEAR]
        assert within(data, [(9.9, 10.5, 10.5)], 0.08).verdict.tolist() == [CLEAR]


def test_where_all_is_unknown_only_hits_are_said(tmp_path: Path) -> None:
    good = synthetic_scans.write_ply(tmp_path / "good.ply", synthetic_scans.make_scan("plane", 1, 200))
    (tmp_path / "broken.e57").write_bytes(b"ASTM-E57" + bytes(100))
    options = BuildConfig(skip_bad=True, jobs=1, resolution=1e-3, radius=0.1)
    build_archive([good, tmp_path / "broken.e57"], tmp_path / "archive", options)
    with opened(tmp_path / "archive") as data:
        answers = raycast(data, [(1.0, 1, 9), (1.0, 1, 9)], [(0, 0, -1), (0, 0, 1)], 100)
        assert answers.verdict.tolist() == [CONTACT, UNKNOWN] and not answers.exact.any()
        assert answers.lower.tolist() == [0, 0]
        assert within(data, [(1.0, 1, 9)], 1).verdict.tolist() == [UNKNOWN]


def test_a_deadline_that_has_passed_leaves_all_unknown_and_loads_nothing(noise: Path) -> None:
    with opened(noise) as data:
        late = make_budget(budget_ms=0)
        questions = (
            lambda budget: raycast(data, [(-1.0, 1, 1)], [X], 9, budget),
            lambda budget: within(data, [(1.0, 1, 1)], 9, budget),
        )
        found = [ask(late) for ask in questions]
        assert data.residency.resident == 0
        for answers, true in zip(found, [ask(EXACT) for ask in questions], strict=True):
            assert answers.verdict.tolist() == [UNKNOWN] and not answers.exact.any()
            assert 0 <= answers.lower[0] <= true.distance[0] < math.inf and answers.misses == 0


def test_what_is_loaded_too_late_is_unknown(beads: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    load = VoxelStore.load

    def slow(self, *arguments):  # type: ignore[no-untyped-def]
        time.sleep(0.4)
        return load(self, *arguments)

    monkeypatch.setattr(VoxelStore, "load", slow)
    with opened(beads) as data:
        origins = [(x, -1.0, 0.0) for x in (0.0, 1.0, 2.0, 3.0)]
        answers = raycast(data, origins, [Y] * 4, 5, make_budget(budget_ms=200))
        late = answers.verdict == UNKNOWN
        assert late.sum() >= 3 and (answers.verdict[~late] == CONTACT).all() and answers.exact[~late].all()
        assert (answers.lower[late] <= 0.99).all() and not answers.exact[late].any() and answers.resident <= 1
        data.residency.check()
        assert raycast(data, origins, [Y] * 4, 5).verdict.tolist() == [CONTACT] * 4


@pytest.mark.parametrize(
    ("origins", "directions", "reach", "text"),
    [
        ([(0.0, 0, 0)], [(0.0, 0, 0)], 1, "direction 0 is zero"),
        ([(0.0, 0, 0)], [(0.0, math.nan, 0)], 1, "expected finite"),
        ([(0.0, 0, 0)], [(0.0, math.inf, 0)], 1, "expected finite"),
        ([(0.0, math.nan, 0)], [X], 1, "expected finite"),
        ([(0.0, 2e9, 0)], [X], 1, "within 1e"),
        ([(0.0, 0, 0)], [X, X], 1, "1 origins and 2 directions"),
        ([(0.0, 0)], [(1.0, 0)], 1, "shape"),
        ([(0.0, 0, 0)], [X], -1, "reach"),
        ([(0.0, 0, 0)], [X], math.nan, "reach"),
        ([(0.0, 0, 0)], [X], 2e6, "reach"),
        ([("a", 0, 0)], [X], 1, "numbers"),
    ],
)
def test_what_is_refused_of_rays(noise: Path, origins, directions, reach, text) -> None:  # type: ignore[no-untyped-def]
    with opened(noise) as data, pytest.raises(BadRequestError, match=text):
        raycast(data, origins, directions, reach)


@pytest.mark.parametrize(
    ("points", "reach"), [([(0.0, 0, 0)], 16.01), ([(0, 0, math.inf)], 1), ([(0, 0, 0)], -1)]
)
def test_what_is_refused_of_points(noise: Path, points, reach) -> None:  # type: ignore[no-untyped-def]
    with opened(noise) as data, pytest.raises(BadRequestError):
        within(data, points, reach)


@pytest.mark.parametrize("kind", ["raycast", "within"])
def test_no_batch_begins_after_a_stop(beads: Path, monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    """The flag is set while the first batch is searched: its answers stay, the others are unknown."""
    monkeypatch.setattr(rays_and_points, "BATCH", 4)
    stop, search, calls = StopFlag(), rays_and_points.search_hits, []

    def search_and_stop(*arguments: Any) -> None:
        search(*arguments)
        calls.append(arguments)
        stop.set("test")

    monkeypatch.setattr(rays_and_points, "search_hits", search_and_stop)
    places, budget = np.tile([1.5, 0.0, 0.0], (11, 1)), EXACT._replace(stop=stop)
    with opened(beads) as data:
        if kind == "raycast":
            found = raycast(data, places, np.tile(X, (11, 1)), 1.0, budget)
        else:
            found = within(data, places, 1.0, budget)
    assert len(calls) == 1
    assert (found.verdict[:4] == CONTACT).all() and (found.verdict[4:] == UNKNOWN).all()
    assert not found.exact[4:].any() and (found.lower[4:] == 0.0).all() and np.isinf(found.distance[4:]).all()
    assert np.isnan(found.cloud_point[4:]).all() and not found.node_visits[4:].any()


@pytest.mark.parametrize("kind", ["raycast", "within"])
def test_a_kernel_searches_nothing_once_it_is_stopped(beads: Path, kind: str) -> None:
    places, stop = np.tile([1.5, 0.0, 0.0], (11, 1)), StopFlag()
    stop.set("test")
    with opened(beads) as data, data.residency.hold(range(len(data.keys))):
        units = np.rint((places - data.arrays.origin) * UNITS_PER_METRE).astype(np.int64)
        direction = np.tile(X, (11 if kind == "raycast" else 0, 1))
        batch = HitBatch(units, direction, UNITS_PER_METRE, data.radius_units)
        lists, best = rays_and_points._list(data, batch), rays_and_points.no_hits(11)
        cursor = lists.starts[:-1].copy()
        for flag in (stop, NO_STOP):
            arrays = with_stop(data, flag).arrays
            search_hits(batch, lists, np.arange(11), cursor, np.empty(0, np.uint8), arrays, best)
            assert np.isfinite(best.value).all() == best.counts[1].all() == (flag is NO_STOP)
            assert (cursor > lists.starts[:-1]).all() == (flag is NO_STOP)
