"""A voxel built in parts is the voxel built at once, whatever the runs, and memory is bounded by a part."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import solidcloud.builder.build_limits as build_limits
from dense_voxels import COLUMNS, KEY, assert_same, decoded, hashed, rows_of, spooled
from numpy.typing import NDArray
from solidcloud.builder.build_limits import is_dense
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.kernels.points.octree_cells import voxel_codes
from solidcloud.builder.voxel import dense_record
from solidcloud.builder.voxel.dense_voxel import build_dense, plan_parts
from solidcloud.builder.voxel.voxel_octree import VoxelPoints, build_voxel
from solidcloud.schemas.errors import BadRequestError, CorruptError
from synthetic_scans import make_steps

PART = 200


@pytest.fixture(autouse=True)
def small_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Parts of a few hundred points, passed on in windows of a few cells."""
    monkeypatch.setattr(build_limits, "DENSE_POINTS", PART)
    monkeypatch.setattr(dense_record, "WINDOW_POINTS", 70)


@pytest.mark.parametrize("kind", ["plane", "corner", "pillar", "noise", "duplicates"])
@pytest.mark.parametrize("steps", [1000, 200_000])
def test_a_voxel_built_in_parts_is_the_voxel(kind: str, steps: int, tmp_path: Path) -> None:
    points = make_steps(kind, 3, 1500, steps)
    names = {
        "corner": ("scan_index", "intensity"), "duplicates": tuple(COLUMNS), "noise": ("classification",)
    }.get(kind, ())  # fmt: skip
    rows = rows_of(points, *names)
    config = BuildConfig(cell_points=40, leaf=8, degree=3, with_slab=kind != "pillar")
    classify = hashed if kind == "corner" else None
    whole = VoxelPoints(
        points, radius_class=hashed(points, range(0)) if classify else None, **{n: rows[n] for n in names}
    )
    spool = spooled(tmp_path / "spool", rows, steps, [400, 900])
    built = build_dense(KEY, spool, config, bytes(16), tmp_path, classify)
    assert_same(decoded(built, steps), build_voxel(KEY, whole, steps, config))
    assert [built.low.tolist(), built.high.tolist()] == [
        points.min(axis=0).tolist(),
        points.max(axis=0).tolist(),
    ]
    assert [path.name for path in tmp_path.iterdir()] == ["spool"]


@pytest.mark.parametrize(
    ("points", "config"),
    [
        (np.full((3000, 3), 77), BuildConfig(leaf=8, degree=3)),
        (np.full((257, 3), 77), BuildConfig(leaf=1, degree=2)),
        (np.concatenate([np.full((900, 3), 7), make_steps("noise", 1, 300, 1000)]), BuildConfig(cell_points=20)),
        (make_steps("plane", 1, 900, 1000), BuildConfig(cell_points=700)),
        (make_steps("plane", 1, 900, 1000), BuildConfig(cell_points=5000)),
        (make_steps("noise", 1, 900, 1000), BuildConfig(cell_points=1, leaf=1, degree=2)),
        # 210 and 30 points of two places in one part, as the cube around them and 100 others is one too many.
        (np.repeat([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [210, 30, 100], axis=0), BuildConfig(cell_points=250)),
    ],
    ids=["one place", "one place, nodes of one and two", "a heap", "large cells", "one cell", "a cell a point",
         "a heap in a part"],
)  # fmt: skip
def test_cells_of_more_points_than_a_part_are_one_part(
    points: NDArray[np.int32], config: BuildConfig, tmp_path: Path
) -> None:
    spool = spooled(tmp_path / "spool", rows_of(points), 1000, [100])
    found = decoded(build_dense(KEY, spool, config, bytes(16), tmp_path), 1000)
    assert_same(found, build_voxel(KEY, VoxelPoints(points.astype(np.int32)), 1000, config))


@pytest.mark.parametrize("names", [(), ("scan_index",)])
@pytest.mark.parametrize("classified", [True, False])
def test_a_heap_keeps_its_columns(names: tuple[str, ...], classified: bool, tmp_path: Path) -> None:
    points = np.concatenate([np.full((900, 3), 7), make_steps("plane", 1, 300, 1000)]).astype(np.int32)
    rows = rows_of(points, *names)
    config = BuildConfig(cell_points=20, leaf=5, degree=3)
    spool = spooled(tmp_path / "spool", rows, 1000, [300])
    classify = hashed if classified else None
    found = decoded(build_dense(KEY, spool, config, bytes(16), tmp_path, classify), 1000)
    whole = VoxelPoints(
        points,
        rows["scan_index"] if names else None,
        None,
        hashed(points, range(0)) if classified else None,
    )
    assert_same(found, build_voxel(KEY, whole, 1000, config))


def test_the_bytes_do_not_depend_on_the_runs(tmp_path: Path) -> None:
    rows = rows_of(make_steps("duplicates", 3, 1500, 1000), "scan_index", "intensity")
    config = BuildConfig(cell_points=40)
    found = set()
    for number, cuts in enumerate(([], [700], list(range(50, 1500, 50)))):
        order = np.random.default_rng(number).permutation(len(rows))
        spool = spooled(tmp_path / str(number), rows[order], 1000, cuts)
        record = build_dense(KEY, spool, config, bytes(16), tmp_path).record
        found.add((bytes(record.cells), bytes(record.nodes), bytes(record.points)))
    assert len(found) == 1


def test_parts_are_few_and_hold_all_points_in_order(tmp_path: Path) -> None:
    points = make_steps("corner", 3, 3000, 1000)
    spool = spooled(tmp_path / "spool", rows_of(points), 1000, [1000])
    parts = list(plan_parts(spool, KEY, BuildConfig(cell_points=40)))
    codes = voxel_codes(points)
    past = 0
    for part in parts:
        assert sum(cube.points for cube in part) <= PART
        for cube in part:
            assert cube.code >= past and cube.code % (1 << 3 * cube.log2) == 0
            past = cube.code_end
            assert cube.points == np.count_nonzero((codes >= cube.code) & (codes < cube.code_end))
    assert sum(cube.points for part in parts for cube in part) == len(points)
    # Two neighbours hold more than a part together, or they would be one.
    sizes = [sum(cube.points for cube in part) for part in parts]
    assert all(size + part[0].points > PART for size, part in zip(sizes[:-1], parts[1:], strict=True))


def test_which_voxels_are_dense() -> None:
    assert [is_dense(n, BuildConfig()) for n in (PART, PART + 1)] == [False, True]
    assert not is_dense(10 * PART, BuildConfig(cells="balanced"))


def test_a_frame_too_long_for_the_index_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spool = spooled(tmp_path / "spool", rows_of(make_steps("noise", 3, 600, 1000)), 1000, [])
    monkeypatch.setattr("solidcloud.schemas.archive.zstd_frame.MAX_FRAME_BYTES", 500)
    with pytest.raises(BadRequestError, match=r"a voxel of [0-9]+ rows takes .* smaller --voxel"):
        build_dense(KEY, spool, BuildConfig(cell_points=40), bytes(16), tmp_path)


def test_a_spill_cut_short_is_seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spool = spooled(tmp_path / "spool", rows_of(make_steps("noise", 3, 600, 1000)), 1000, [])
    monkeypatch.setattr(dense_record, "by_cell", lambda xyz, starts: xyz.reshape(-1)[:-900])
    with pytest.raises(CorruptError, match="spill file"):
        build_dense(KEY, spool, BuildConfig(cell_points=40), bytes(16), tmp_path)


MEMORY = """
import sys
from pathlib import Path
import numpy as np
from solidcloud.builder import build_limits
from solidcloud.builder.voxel import dense_voxel as dense
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.spool.spool import Spool
from solidcloud.schemas.archive.voxel_grid import Lattice

def peak():
    return int(next(l for l in open("/proc/self/status") if l.startswith("VmHWM")).split()[1]) << 10

build_limits.DENSE_POINTS = 1 << 15
folder, count = Path(sys.argv[1]), int(sys.argv[2])
spool = Spool(folder, np.dtype([("local", "<i4", (3,))]), Lattice((0.0, 0.0, 0.0), 0.001, 4000))
small = Spool(folder.parent / "small", spool.dtype, spool.lattice)
dense.build_dense(KEY, small, BuildConfig(), bytes(16), folder)  # what is loaded once
before = peak()
record = dense.build_dense(KEY, spool, BuildConfig(), bytes(16), folder).record
print(record.point_rows, peak() - before)
""".replace("KEY", str(KEY))


@pytest.mark.parametrize("kind", ["scan", "one place"])
def test_memory_is_bounded_by_a_part(kind: str, tmp_path: Path) -> None:
    """1.2 million points in parts of 2^15: in many cells, and in one place, which is one cell."""
    count = 1_200_000
    rng = np.random.default_rng(1)
    points = np.full((count, 3), 1234)
    if kind == "scan":
        points = rng.integers(0, 4000, (count, 3))
        points[:, 2] = points[:, 0] // 3 + rng.integers(0, 9, count)
    spooled(tmp_path / "spool", rows_of(points), 4000, [500_000, 900_000])
    spooled(tmp_path / "small", rows_of(points[:70_000]), 4000, [])
    command = [sys.executable, "-c", MEMORY, str(tmp_path / "spool"), str(count)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    rows, grown = map(int, done.stdout.split())
    assert rows == count
    # A part takes 2^15 * 60 bytes, which the small voxel took before; cells some 300 bytes each, for 500 points.
    # Frames are files, and mapped where they are asked for. Held, the points' rows alone were 7 MB.
    assert grown < 6 << 20
