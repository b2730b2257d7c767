"""Surface normals of an archive as it is served: those of all points within reach, whatever voxels hold them."""

import math
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import archive_cases
import naive
import naive_normals
import numpy as np
import pytest
import synthetic_scans
from numpy.typing import NDArray
from solidcloud.schemas.errors import BadRequestError, CorruptError
from solidcloud.server.archives.masked_store import MaskedStore
from solidcloud.server.archives.placed_archive import ArchiveGeneration
from solidcloud.server.kernels.core.normal_codes import LINE, THICK
from solidcloud.server.kernels.rays.surface import voxels_near
from solidcloud.server.queries.query_inputs import with_stop
from solidcloud.server.queries.surface_normals import Normals
from solidcloud.server.residency.arena import ArenaBuffer
from solidcloud.server.residency.voxel_store import VoxelStore
from solidcloud.server.runtime.stop_flag import StopFlag, StoppedError

pytestmark = pytest.mark.interpreted

INTERPRETED = os.environ.get("NUMBA_DISABLE_JIT") == "1"
COUNT = 150 if INTERPRETED else 1500
REACH = 0.4 if INTERPRETED else 0.15
COARSE = 0.56  # of codes [degrees]
UP = np.array([0.0, 0.0, 1.0])
KINDS = ["plane", "corner", "noise", "duplicates", "one point"]
if not INTERPRETED:  # of so few points, those of the pillar have no surface within reach
    KINDS.append("pillar")


@contextmanager
def asked(
    archive: Path, budget_bytes: int = 1 << 24, store: VoxelStore | None = None
) -> Iterator[tuple[ArchiveGeneration, Normals]]:
    """An archive, open, and its normals."""
    opened = ArchiveGeneration(store or VoxelStore(archive), budget_bytes)
    try:
        yield opened, Normals(opened.data, opened.store.archive)
        opened.data.residency.check()
    finally:
        opened.release()


def build(tmp_path: Path, kind: str, count: int = COUNT, **options: object) -> archive_cases.Case:
    """An archive of a made scan, small voxels and cells."""
    options = {"voxel": 0.9, "cell_points": 60, "leaf": 16, "degree": 4, **options}
    return archive_cases.build(tmp_path, synthetic_scans.make_scan(kind, 3, count) - 0.7, **options)


def largest(archive: Path) -> int:
    """Bytes that the largest voxel takes in a cache."""
    store = VoxelStore(archive)
    store.close()
    return ArenaBuffer.rounded(int(store.sizes.max()))


def lattice_points(
    opened: ArchiveGeneration, points: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64], int]:
    """Source points as they are stored: on the lattice, and in the world [m]; and the reach squared."""
    lattice = opened.store.archive.header.lattice
    stored = naive.lattice_of(points, lattice.origin, lattice.step)
    return stored, lattice.to_world(stored), int(np.rint((REACH / lattice.step) ** 2))


def voxels_of(opened: ArchiveGeneration, lattice: NDArray[np.int64]) -> NDArray[np.int64]:
    """The index row of the voxel of each lattice point."""
    rows = {tuple(v): row for row, v in enumerate(opened.store.archive.coordinates.tolist())}
    steps = opened.store.archive.header.lattice.voxel_steps
    return np.array([rows[tuple(v)] for v in (lattice // steps).tolist()])


@pytest.mark.parametrize("kind", KINDS)
def test_normals_are_those_of_numpy(tmp_path: Path, kind: str) -> None:
    case = build(tmp_path, kind)
    found = none = across = 0
    with asked(case.archive) as (opened, normals):
        lattice, places, square = lattice_points(opened, case.points)
        rows = voxels_of(opened, lattice)
        for n in range(0, len(lattice), 1 if INTERPRETED else 3):
            normal = normals.at(places[n], UP, REACH)
            expected = naive_normals.find(lattice, lattice[n], square)
            if expected is None:
                assert normal is None
                none += 1
                continue
            line = expected.values[1] / expected.values[2] / LINE
            thick = expected.values[0] / max(expected.values[1], 1e-300) / THICK
            if expected.count >= 3 and min(abs(line - 1), abs(thick - 1)) < 1e-9:
                continue
            if expected.count < 3 or line <= 1 or thick > 1:
                assert normal is None
                none += 1
                continue
            assert normal is not None
            assert naive_normals.angle(normal, expected.normal) < COARSE
            assert abs((normal**2).sum() - 1) < 1e-15 and normal[2] >= 0
            found += 1
            across += len(set(rows[((lattice - lattice[n]) ** 2).sum(axis=1) <= square])) > 1
    assert found > 10 or kind in ("duplicates", "one point")
    assert none > 10 or kind in ("plane", "corner", "pillar", "one point")
    assert across > 10 or kind in ("duplicates", "one point"), "points of several voxels"


@pytest.mark.parametrize("kind", ["corner", "noise"])
def test_heights_over_a_point_are_those_of_all_points_within_reach(tmp_path: Path, kind: str) -> None:
    case = build(tmp_path, kind)
    directions = np.array([[0.0, 0.0, 1.0], [0.6, -0.8, 0.0], [-0.48, 0.6, -0.64]])
    with asked(case.archive) as (opened, normals):
        lattice, places, square = lattice_points(opened, case.points)
        several = 0
        for n in range(0, len(lattice), max(1, COUNT // 60)):
            near = naive_normals.neighbours(lattice, lattice[n], square)
            found = normals.highest(places[n], directions, REACH)
            expected = (near @ directions.T).max(axis=0) * opened.store.archive.header.lattice.step
            np.testing.assert_allclose(found, expected, atol=1e-12)
            several += len(near) > 3
        assert several > 10
        assert not normals.highest(np.full(3, 1e3), directions, REACH).any(), "there is no point"


def test_the_side_is_the_one_that_is_asked_for(tmp_path: Path) -> None:
    case = build(tmp_path, "corner")
    sides = 0
    with asked(case.archive) as (opened, normals):
        for place in lattice_points(opened, case.points)[1][:40]:
            there = [normals.at(place, way, REACH) for way in np.concatenate([np.eye(3), -np.eye(3)])]
            for one, other, way in zip(there[:3], there[3:], np.eye(3), strict=True):
                if one is None or other is None:
                    assert one is None and other is None
                elif abs(one @ way) > 0:
                    assert one @ way > 0 and (other == -one).all()
                    sides += 1
    assert sides > 50


def test_normals_are_the_same_in_voxels_of_any_size_and_with_room_for_one(tmp_path: Path) -> None:
    """A cache that holds the largest voxel alone: the sums of neighbours are found one after the other."""

    def answers(archive: Path, places: NDArray[np.float64], budget: int = 1 << 24) -> list[bytes]:
        with asked(archive, budget) as (opened, normals):
            found = [normals.at(place, UP, REACH) for place in places]
            heights = [normals.highest(place, np.eye(3), REACH) for place in places]
            assert (opened.data.residency.stats.evicted > 0) == (budget < 1 << 24)
        return [b"" if each is None else each.tobytes() for each in (*found, *heights)]

    case = build(tmp_path, "corner", COUNT // 2)
    with asked(case.archive) as (opened, _):
        places = lattice_points(opened, case.points)[1]
    expected = answers(case.archive, places)
    assert answers(case.archive, places, largest(case.archive)) == expected
    for options in ({"voxel": 8.0}, {"voxel": 0.33}, {"leaf": 5, "cell_points": 17, "degree": 2}):
        other = build(tmp_path, "corner", COUNT // 2, **options).archive
        assert answers(other, places) == expected
        if options != {"voxel": 8.0}:
            assert answers(other, places, largest(other)) == expected


def test_each_reach_has_its_own_and_wrong_ones_are_refused(tmp_path: Path) -> None:
    case = build(tmp_path, "corner")
    with asked(case.archive) as (opened, normals):
        places = lattice_points(opened, case.points)[1][:60]
        near, far = ([normals.at(place, UP, reach) for place in places] for reach in (REACH, 2 * REACH))
        assert any(one is not None and (one != other).any() for one, other in zip(near, far, strict=True))
        for reach in (0.0, -1.0, math.nan, 1.5):
            with pytest.raises(BadRequestError, match="normal reach"):
                normals.at(places[0], UP, reach)
        assert normals.squares((0.1, 2.0)).tolist() == [1_000_000, 0]


def test_a_place_counts_to_half_a_step_and_far_from_all_points_there_is_no_normal(tmp_path: Path) -> None:
    case = build(tmp_path, "plane")
    with asked(case.archive) as (opened, normals):
        step, place = opened.store.archive.header.lattice.step, lattice_points(opened, case.points)[1][0]
        normal = normals.at(place, UP, REACH)
        assert normal is not None
        assert (normals.at(place + 0.4 * step, UP, REACH) == normal).all()
        for away in ([50.0, 0, 0], [-1e9, 1e9, 1e9], (REACH + 1.0) * UP):
            assert normals.at(place + away, UP, REACH) is None


def border(opened: ArchiveGeneration, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], int, int]:
    """A point with points of one other voxel within reach: its place, and the rows of both voxels."""
    lattice, places, square = lattice_points(opened, points)
    rows = voxels_of(opened, lattice)
    for n, at in enumerate(lattice):
        low, high = opened.data.tree.low[: rows.max() + 1], opened.data.tree.high[: rows.max() + 1]
        near = np.flatnonzero(
            ((low <= at + math.isqrt(square) + 1) & (high >= at - math.isqrt(square) - 1)).all(axis=1)
        )
        if len(near) == 2:
            return places[n], int(rows[n]), int(near[near != rows[n]][0])
    raise AssertionError("no such point")


def test_a_neighbour_that_cannot_be_read_makes_the_normal_unknown(tmp_path: Path) -> None:
    case = build(tmp_path, "plane")
    with asked(case.archive) as (opened, _):
        place, own, other = border(opened, case.points)
        path = opened.store.archive.shard_path(int(opened.store.archive.voxels["shard"][other]))
        offset = int(opened.store.archive.voxels["frame_offset"][other][2])
    data = bytearray(path.read_bytes())
    data[offset + 9] ^= 0xFF
    path.write_bytes(data)
    with asked(case.archive) as (opened, normals):
        with pytest.raises(CorruptError, match="damaged frame"):
            normals.at(place, UP, REACH)
        assert normals.at(place, UP, 2e-4) is None, "only its own voxel is within reach"
        assert opened.data.residency.is_resident(own)


def test_a_neighbour_that_is_not_in_memory_is_loaded_or_the_normal_is_unknown(tmp_path: Path) -> None:
    case = build(tmp_path, "plane")
    with asked(case.archive) as (opened, normals):
        place, own, other = border(opened, case.points)
        residency = opened.data.residency
        with residency.hold([own]):
            pass
        with pytest.raises(StoppedError):
            normals.at(place, UP, REACH, waits=False)
        expected = normals.at(place, UP, REACH)
        assert residency.is_resident(other) and expected is not None
        assert (normals.at(place, UP, REACH, waits=False) == expected).all()


def test_a_stop_ends_a_wait_for_a_voxel_and_no_request_has_that_of_another(tmp_path: Path) -> None:
    case = build(tmp_path, "plane")
    with asked(case.archive) as (opened, expected):
        places = lattice_points(opened, case.points)[1]
        stop = StopFlag()
        stop.set("the client is gone")
        normals = Normals(with_stop(opened.data, stop), opened.store.archive)
        with pytest.raises(StoppedError):
            normals.at(places[0], UP, REACH, stop)
        assert opened.data.residency.resident == 0
        for place in places[:20]:
            assert (normals.at(place, UP, REACH) == expected.at(place, UP, REACH)).all()


@pytest.mark.parametrize("capacity", [2, 64])
def test_voxels_near_a_point_are_those_whose_points_may_be_within_reach(
    tmp_path: Path, capacity: int
) -> None:
    case, rng = build(tmp_path, "noise"), np.random.default_rng(4)
    with asked(case.archive) as (opened, _):
        header, tree = opened.store.archive.header, opened.data.tree
        low, high = (side[: tree.voxels].astype(np.int64) for side in (tree.low, tree.high))
        held = opened.data.references.to(opened.data.arrays, tree)
        counts = set()
        for reach in (0, 1000, 9000, 1 << 20):
            for _ in range(20):
                place, rows = rng.integers(header.low - 9000, header.high + 9000), np.full(capacity, -1)
                away = (np.maximum(np.maximum(low - place, place - high), 0) ** 2).sum(axis=1)
                needed = held.call(voxels_near, held.reference, *place.tolist(), reach * reach, rows)
                # Widened by a step, and by more than the rounding.
                least, most = ((away <= far * far).sum() for far in (reach, reach + 2))
                assert least <= needed <= most
                if needed <= capacity:
                    found = rows[:needed].tolist()
                    assert set(np.flatnonzero(away <= reach * reach).tolist()) <= set(found)
                    assert (np.diff(away[found]) >= 0).all(), "nearest first"
                counts.add(needed)
    assert {0, 1, 2} < counts


def test_nobody_imports_it_but_who_asks() -> None:
    """A scene that calls for no normals has none of their code in memory."""
    code = (
        "import sys; import solidcloud.server.scene, solidcloud.server.zenoh_server.serve_loop; "
        "print([name for name in sys.modules if name.startswith('solidcloud') and 'normals' in name])"
    )
    env = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=env)
    assert done.stdout.strip() == "[]"


@pytest.mark.skipif(INTERPRETED, reason="too few points for those left out to matter")
def test_what_is_left_out_has_no_say(tmp_path: Path) -> None:
    case = build(tmp_path, "corner", COUNT // 3)
    box = np.array([[-0.6, -0.6, -0.6], [0.1, 0.4, 1.5]])
    with asked(case.archive) as (opened, normals):
        places = lattice_points(opened, case.points)[1]
        stays = ~((box[0] <= places) & (places <= box[1])).all(axis=1)
        assert len(places) > stays.sum() > 20
        whole = [normals.at(place, UP, REACH) for place in places[stays]]
    rest = archive_cases.build(tmp_path, case.points[stays], voxel=0.9, radius=0.01)
    with asked(rest.archive) as (_, normals):
        expected = [normals.at(place, UP, REACH) for place in places[stays]]
    store = MaskedStore(case.archive, [box])
    with asked(case.archive, store=store) as (_, normals):
        found = [normals.at(place, UP, REACH) for place in places[stays]]
    assert str(found) == str(expected) != str(whole)
