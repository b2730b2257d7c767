"""Surface normals of an archive as it is served: those of the definition, in whatever order they are asked."""

import math
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import archive_cases
import naive
import naive_normals
import numpy as np
import pytest
import synthetic_scans
from numpy.typing import NDArray
from solidcloud.schemas.errors import BadRequestError, CorruptError
from solidcloud.schemas.kernels.normal_codes import LINE, NO_NORMAL, THICK, decode_normal
from solidcloud.server.archives.archive_generation import ArchiveGeneration
from solidcloud.server.archives.masked_archive import MaskedArchive
from solidcloud.server.kernels.rays.stored_normals import code_at, find_voxel, stored_code_at
from solidcloud.server.queries.context.query_context import with_stop
from solidcloud.server.queries.surface_normals import Normals, warm
from solidcloud.server.residency.voxel_store import VoxelStore
from solidcloud.server.runtime.stop_flag import StopFlag, StoppedError

pytestmark = pytest.mark.interpreted

INTERPRETED = os.environ.get("NUMBA_DISABLE_JIT") == "1"
COUNT = 150 if INTERPRETED else 1500
REACH = 0.4 if INTERPRETED else 0.15
VISITS = [3024, 3396, 4343]
COARSE = 0.56  # of codes [degrees]
UP = np.array([0.0, 0.0, 1.0])


@contextmanager
def serving(archive: Path, budget_bytes: int = 1 << 24) -> Iterator[ArchiveGeneration]:
    """An archive, open."""
    opened = ArchiveGeneration(VoxelStore(archive), budget_bytes)
    try:
        yield opened
    finally:
        opened.release()


@contextmanager
def asked(
    archive: Path, budget_bytes: int = 1 << 24, most_bytes: int | None = None
) -> Iterator[tuple[ArchiveGeneration, Normals]]:
    """An archive, open, and its normals."""
    with serving(archive, budget_bytes) as opened:
        yield opened, Normals(opened.store, opened.data, most_bytes)


def build(tmp_path: Path, kind: str, count: int = COUNT, **options: object) -> archive_cases.Case:
    """An archive of a made scan, small voxels and cells."""
    options = {"voxel": 0.9, "cell_points": 60, "leaf": 16, "degree": 4, **options}
    return archive_cases.build(tmp_path, synthetic_scans.make_scan(kind, 3, count) - 0.7, **options)


def largest(archive: Path) -> int:
    """Bytes of the largest voxel once decoded."""
    store = VoxelStore(archive)
    store.close()
    return int(store.sizes.max())


def judged(
    opened: ArchiveGeneration, points: NDArray[np.float64]
) -> list[tuple[NDArray[np.float64], int, naive_normals.Found | None]]:
    """Each source point as it is stored, world [m], its voxel's row, and what numpy finds there."""
    header = opened.store.archive.header
    lattice = naive.lattice_of(points, header.lattice.origin, header.lattice.step)
    voxel = lattice // header.lattice.voxel_steps
    rows = {tuple(v): row for row, v in enumerate(opened.store.archive.coordinates.tolist())}
    square = int(np.rint((REACH / header.lattice.step) ** 2))
    answers = []
    for at, own in zip(lattice, voxel, strict=True):
        fellows = lattice[(voxel == own).all(axis=1)]
        place = at * header.lattice.step + np.array(header.lattice.origin)
        answers.append((place, rows[tuple(own.tolist())], naive_normals.find(fellows, at, square)))
    return answers


@pytest.mark.parametrize("kind", ["plane", "corner", "pillar", "noise", "duplicates", "one point"])
def test_normals_are_those_of_numpy(tmp_path: Path, kind: str) -> None:
    case = build(tmp_path, kind)
    found = none = 0
    with asked(case.archive) as (opened, normals):
        for place, _, expected in judged(opened, case.points)[:: 1 if INTERPRETED else 3]:
            normal = normals.at(place, UP, REACH)
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
        assert normals.estimated >= found
    assert found > 10 or kind in ("duplicates", "one point")
    assert none > 10 or kind in ("plane", "corner", "pillar", "one point")


@pytest.mark.parametrize("kind", ["corner", "noise"])
def test_heights_over_a_point_are_those_of_all_points_of_its_voxel(tmp_path: Path, kind: str) -> None:
    case = build(tmp_path, kind)
    directions = np.array([[0.0, 0.0, 1.0], [0.6, -0.8, 0.0], [-0.48, 0.6, -0.64]])
    with asked(case.archive) as (opened, normals):
        header = opened.store.archive.header
        lattice = naive.lattice_of(case.points, header.lattice.origin, header.lattice.step)
        voxel = lattice // header.lattice.voxel_steps
        square = int(np.rint((REACH / header.lattice.step) ** 2))
        several = 0
        for at, own in list(zip(lattice, voxel, strict=True))[:: max(1, COUNT // 60)]:
            near = naive_normals.neighbours(lattice[(voxel == own).all(axis=1)], at, square)
            place = at * header.lattice.step + np.array(header.lattice.origin)
            found = normals.highest(place, directions, REACH)
            expected = (near @ directions.T).max(axis=0) * header.lattice.step
            np.testing.assert_allclose(found, expected, atol=1e-12)
            several += len(near) > 3
        assert several > 10
        assert not normals.highest(np.full(3, 1e3), directions, REACH).any(), "there is no voxel"


def test_the_side_is_the_one_that_is_asked_for(tmp_path: Path) -> None:
    case = build(tmp_path, "corner")
    sides = 0
    with asked(case.archive) as (opened, normals):
        for place, _, _ in judged(opened, case.points)[:40]:
            there = [normals.at(place, way, REACH) for way in np.concatenate([np.eye(3), -np.eye(3)])]
            for one, other, way in zip(there[:3], there[3:], np.eye(3), strict=True):
                if one is None or other is None:
                    assert one is None and other is None
                elif abs(one @ way) > 0:
                    assert one @ way > 0 and (other == -one).all()
                    sides += 1
    assert sides > 50


def test_codes_are_the_same_in_any_order_and_whatever_else_is_resident(tmp_path: Path) -> None:
    case = build(tmp_path, "corner")
    with asked(case.archive) as (opened, normals):
        places = [place for place, *_ in judged(opened, case.points)]
        forward = [normals.code(place, REACH) for place in places]
        assert [normals.code(place, REACH) for place in places] == forward
        assert normals.estimated == len(places)
    for other in (case, build(tmp_path, "corner", leaf=5, cell_points=17, degree=2)):
        with asked(other.archive, 2 * largest(other.archive), most_bytes=0) as (opened, normals):
            backward = [normals.code(place, REACH) for place in reversed(places)]
            assert backward[::-1] == forward
            assert opened.data.residency.evictions > 0


def test_what_is_looked_into_is_what_it_was(tmp_path: Path) -> None:
    """What bounds leave out is in no answer: nodes visited for the same points."""
    case = build(tmp_path, "corner", 150, voxel=8.0)
    with asked(case.archive, most_bytes=0) as (opened, normals):
        places = [place for place, *_ in judged(opened, case.points)]
        visits = []
        for reach in (0.02, 0.3, 1.0):
            before = normals.visits
            for place in places:
                normals.code(place, reach)
            visits.append(normals.visits - before)
    assert visits == VISITS


def test_of_an_evicted_voxel_nothing_is_kept_and_the_same_is_found(tmp_path: Path) -> None:
    case = build(tmp_path, "plane")
    with asked(case.archive, 2 * largest(case.archive), most_bytes=1 << 20) as (opened, normals):
        voxels = {row: place for place, row, _ in judged(opened, case.points)}
        (first, at), (second, there) = list(voxels.items())[:2]
        code = normals.code(at, REACH)
        residency = opened.data.residency
        assert (
            residency.is_resident(first)
            and normals.used_bytes == 64 * opened.store.archive.voxels["leaves"][first]
        )
        for row in voxels:
            if row != first and residency.is_resident(first):
                with residency.hold([row]):
                    pass
        assert not residency.is_resident(first)
        normals.code(there, REACH)
        residency.check()
        assert normals.used_bytes == 64 * opened.store.archive.voxels["leaves"][second]
        before = normals.estimated
        assert normals.code(at, REACH) == code
        assert normals.estimated == before + 1


def test_what_is_kept_is_bounded_and_the_oldest_goes_first(tmp_path: Path) -> None:
    case = build(tmp_path, "corner")
    with serving(case.archive) as opened:
        voxels = {row: place for place, row, _ in judged(opened, case.points)}
        sizes = 64 * opened.store.archive.voxels["leaves"].astype(int)
        most = int(np.sort(sizes)[-3:].sum())
        normals = Normals(opened.store, opened.data, most)
        for row, place in voxels.items():
            normals.code(place, REACH)
            assert sizes[row] <= normals.used_bytes <= most
        last = list(voxels.values())[-1]
        before = normals.estimated
        normals.code(last, REACH)
        assert normals.estimated == before
        normals.code(next(iter(voxels.values())), REACH)
        assert normals.estimated == before + 1
        none = Normals(opened.store, opened.data, 0)
        for place in voxels.values():
            none.code(place, REACH)
            assert none.used_bytes == 0
        assert Normals(opened.store, opened.data).most_bytes == opened.data.residency.budget_bytes // 32


def test_each_reach_has_its_own_and_wrong_ones_are_refused(tmp_path: Path) -> None:
    case = build(tmp_path, "corner")
    with asked(case.archive) as (opened, normals):
        places = [place for place, *_ in judged(opened, case.points)][:60]
        near = [normals.code(place, REACH) for place in places]
        far = [normals.code(place, 2 * REACH) for place in places]
        assert near != far
        assert [normals.code(place, REACH) for place in places] == near
        for reach in (0.0, -1.0, math.nan, 1.5):
            with pytest.raises(BadRequestError, match="normal reach"):
                normals.at(places[0], UP, reach)


def test_where_no_point_is_there_is_no_normal(tmp_path: Path) -> None:
    case = build(tmp_path, "plane")
    with asked(case.archive) as (opened, normals):
        header = opened.store.archive.header
        place = next(place for place, *_ in judged(opened, case.points))
        assert normals.code(place, REACH) != NO_NORMAL
        near = place + 0.4 * header.lattice.step
        assert normals.code(near, REACH) == normals.code(place, REACH)
        before = normals.estimated
        for away in (2 * header.lattice.step * UP, [50.0, 0, 0], [-1e9, 1e9, 1e9], 0.1 * UP):
            assert normals.at(place + away, UP, REACH) is None
        assert normals.estimated == before


def test_normals_of_a_voxel_that_cannot_be_read_are_unknown(tmp_path: Path) -> None:
    case = build(tmp_path, "plane")
    with serving(case.archive) as opened:
        places = [place for place, *_ in judged(opened, case.points)]
    for shard in (case.archive / "shards").iterdir():
        data = bytearray(shard.read_bytes())
        with VoxelStore(case.archive).archive as archive:
            for row in range(len(archive.voxels)):
                data[int(archive.voxels["frame_offset"][row][2]) + 9] ^= 0xFF
        shard.write_bytes(data)
    with asked(case.archive) as (opened, normals):
        for place in places[:20]:
            with pytest.raises(CorruptError, match="damaged frame"):
                normals.at(place, UP, REACH)
        assert normals.used_bytes == 0 == normals.estimated


def test_a_stop_ends_a_wait_for_a_voxel_and_no_request_has_that_of_another(tmp_path: Path) -> None:
    case = build(tmp_path, "plane")
    with serving(case.archive) as opened:
        places = [place for place, *_ in judged(opened, case.points)]
        stop = StopFlag()
        stop.set("the client is gone")
        normals = Normals(opened.store, with_stop(opened.data, stop))
        with pytest.raises(StoppedError):
            normals.at(places[0], UP, REACH, stop)
        assert opened.data.residency.resident == 0
        expected = Normals(opened.store, opened.data)
        for place in places[:20]:
            assert normals.code(place, REACH) == expected.code(place, REACH)


def test_nobody_imports_it_but_who_asks() -> None:
    """A scene that calls for no normals has none of their code in memory."""
    code = (
        "import sys; import solidcloud.server.scene, solidcloud.server.zenoh_server.serve_loop; "
        "print([name for name in sys.modules if name.startswith('solidcloud') and 'normals' in name])"
    )
    env = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=env)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("keep", [("normal",), ("normal", "scan", "intensity")])
@pytest.mark.parametrize("models", [{"mean"}, {"mean", "border"}])
def test_what_is_stored_is_what_is_found_at_first_use(
    tmp_path: Path, keep: tuple[str, ...], models: set[str]
) -> None:
    options = {"keep": frozenset(keep), "normal_reach": REACH, "models": frozenset(models)}
    case = build(tmp_path, "corner", COUNT // 3, **options)
    with asked(case.archive) as (opened, normals):
        assert not opened.store.with_normals
        places = [place for place, *_ in judged(opened, case.points)]
        first = [normals.code(place, REACH) for place in places]
        own = opened.store.sizes
        assert normals.estimated == len(places) and len(set(first)) > 20
    opened = ArchiveGeneration(VoxelStore(case.archive, normals=REACH), 2 * int(own.max()))
    try:
        normals = Normals(opened.store, opened.data)
        leaves = opened.store.archive.voxels["leaves"]
        assert (opened.store.sizes == own + 64 * leaves.astype(int)).all()
        assert [normals.code(place, REACH) for place in places] == first
        assert normals.estimated == normals.used_bytes == 0 < opened.data.residency.evictions
        assert normals.code(places[0] + 0.01, REACH) == NO_NORMAL
        opened.data.residency.check()
        # Another reach is found as ever.
        assert normals.code(places[0], REACH / 2) in range(1 << 16) and normals.estimated == 1
    finally:
        opened.release()


@pytest.mark.parametrize("normals", [None, REACH / 2])
def test_of_normals_that_nobody_asks_for_nothing_is_in_memory(tmp_path: Path, normals: float | None) -> None:
    case = build(tmp_path, "plane", COUNT // 3, keep=frozenset({"normal"}), normal_reach=REACH)
    plain = build(tmp_path, "plane", COUNT // 3)
    kept, other = VoxelStore(case.archive, normals=normals), VoxelStore(plain.archive)
    assert (kept.sizes == other.sizes).all() and not kept.with_normals
    kept.close()
    other.close()


def test_what_is_left_out_has_no_say_whether_normals_are_stored_or_not(tmp_path: Path) -> None:
    options = {"keep": frozenset({"normal"}), "normal_reach": REACH}
    case = build(tmp_path, "corner", COUNT // 3, **options)
    box = np.array([[-0.6, -0.6, -0.6], [0.1, 0.4, 1.5]])
    without = partial(MaskedArchive, boxes=[box])
    with asked(case.archive) as (opened, normals):
        places = [place for place, *_ in judged(opened, case.points)]
        left = [place for place in places if not ((box[0] <= place) & (place <= box[1])).all()]
        assert len(places) > len(left) > 20
        whole = [normals.code(place, REACH) for place in left]
    found = []
    for reach in (None, REACH):
        opened = ArchiveGeneration(VoxelStore(case.archive, without, normals=reach), 1 << 24)
        try:
            assert opened.store.with_normals == (reach is not None)
            normals = Normals(opened.store, opened.data)
            found.append([normals.code(place, REACH) for place in left])
            assert normals.estimated == (0 if reach else len(left))
        finally:
            opened.release()
    assert found[0] == found[1] != whole


def test_warming_loads_nothing_and_leaves_nothing_to_compile(tmp_path: Path) -> None:
    case = build(tmp_path, "plane")
    with asked(case.archive) as (opened, normals):
        warm(opened.data)
        assert opened.data.residency.resident == 0
        kernels = (find_voxel, code_at, stored_code_at, decode_normal)
        compiled = [len(getattr(kernel, "signatures", ())) for kernel in kernels]
        places = [place for place, *_ in judged(opened, case.points)][:40]
        assert any(normals.at(place, UP, REACH) is not None for place in places)
        assert [len(getattr(kernel, "signatures", ())) for kernel in kernels] == compiled
