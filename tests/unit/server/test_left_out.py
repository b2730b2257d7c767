"""Points in boxes left out: what is served is, bit for bit, an archive of the points that are left."""

import hashlib
import os
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import cases
import classes
import naive
import naive_distance
import numpy as np
import pytest
import scans
from msgspec.structs import asdict
from numpy.typing import NDArray
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.pipeline import build_archive
from solidcloud.builder.radius import voxel_points
from solidcloud.schemas.archive import Archive
from solidcloud.schemas.columns import array_fields
from solidcloud.schemas.effects import Through, ThroughBox
from solidcloud.schemas.errors import BadRequestError, BadTransformError, SolidcloudError
from solidcloud.server import left_out
from solidcloud.server.effects.through import store_without
from solidcloud.server.left_out import LeftOut
from solidcloud.server.posed import moved
from solidcloud.server.scene import Scene

STEP = cases.BINARY_STEP
# Voxels of half a metre, points from 0 to 2 m an axis: 0.5 and 1 are borders between them.
OPTIONS: dict[str, Any] = {
    "voxel": 0.5, "resolution": STEP, "radius": 0.01, "jobs": 1, "leaf": 8, "degree": 3, "cell_points": 24,
    "models": frozenset({"mean", "local", "border"}), "keep": frozenset({"scan", "intensity", "normal"}),
}  # fmt: skip
BODY = np.array([[0.0, 0, 0], [0.11, 0, 0], [0.0, 0.21, 0], [0.05, 0.05, 0.1]])
# The points that give every archive the same lattice and bounds, whatever is left out between them.
ENDS = np.array([[0.0, 0, 0], [2.0, 2.0, 2.0]])
DOOR = ThroughBox("door", (0.375, 0.25, 0.25), (0.625, 1.125, 0.875))
ROOM = ThroughBox("room", (1.0, 1.0, 0.5), (1.5, 1.5, 1.0))


def on_lattice(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """The points moved onto the lattice, so that no build moves them."""
    return np.rint(points / STEP) * STEP


def two_scans() -> list[NDArray[np.float64]]:
    """A scan of free points and one of a corner, some of them on the borders of the boxes and in both scans."""
    first = on_lattice(scans.make_scan("noise", 5, 500))
    second = on_lattice(scans.make_scan("corner", 6, 300))
    edges = np.array(
        [DOOR.low, DOOR.high, ROOM.low, ROOM.high, [0.375, 0.5, 0.875], [0.376953125, 0.25, 0.5]]
    )
    just_out = np.array([[0.625 + STEP, 0.5, 0.5], [0.5, 0.25 - STEP, 0.5], [0.5, 0.5, 0.875 + STEP]])
    return [np.vstack([ENDS, first, edges, just_out]), np.vstack([ENDS, second, edges])]


def in_boxes(points: NDArray[np.float64], boxes: tuple[ThroughBox, ...]) -> NDArray[np.bool_]:
    """The rule, point by point, of an archive at the identity."""
    return np.array(
        [
            any(all(low <= c <= high for low, c, high in zip(b.low, p, b.high, strict=True)) for b in boxes)
            for p in points.tolist()
        ]
    )


def build(folder: Path, parts: list[NDArray[np.float64]]) -> Path:
    """An archive of scans whose points have classes by their place alone, and intensities by theirs."""
    folder.mkdir()
    files: list[Path] = []
    digests = [b""]
    for i, xyz in enumerate(parts):
        # Scans are numbered by their files' hashes: points are turned round until these are in order.
        for turn in range(64):
            points = np.roll(xyz, turn, axis=0)
            intensity = np.floor(points.sum(axis=1) * 64).astype(np.float32)
            file = scans.write_ply(folder / f"{i}.ply", points, intensity)
            digest = hashlib.sha256(file.read_bytes()).digest()
            if digest > digests[-1] and (i > 0 or digest[0] < 64):
                break
        files.append(file)
        digests.append(digest)
    assert digests == sorted(digests)
    with classes.any_classes():
        build_archive(files, folder / "archive", BuildConfig(**OPTIONS))
    return folder / "archive"


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The archive of all points."""
    return build(tmp_path_factory.mktemp("left_out") / "whole", two_scans())


@pytest.fixture(scope="module")
def rest(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The archive of the points that are in neither box."""
    parts = [part[~in_boxes(part, (DOOR, ROOM))] for part in two_scans()]
    return build(tmp_path_factory.mktemp("left_out") / "rest", parts)


def open_without(archive: Path, *boxes: ThroughBox, pose: Any = None, **options: Any) -> Scene:
    """A scene without the points in the boxes."""
    return Scene.open(archive, "hall", open_store=store_without(Through(list(boxes)), pose), **options)


def voxel_bytes(archive: Archive) -> dict[int, list[Any]]:
    """All of every voxel, and what the index says of it, by key."""
    found = {}
    base = archive.coordinates * archive.header.lattice.voxel_steps
    for row in range(len(archive.voxels)):
        voxel, _ = archive.read_voxel(row)
        columns = [*voxel.cells, *voxel.nodes, voxel.points, voxel.scan_index, voxel.intensity, voxel.normal]
        index = [archive.voxels[name][row].tolist() for name in ("rows", "leaves", "low", "high")]
        found[voxel.key] = [
            *(c.tobytes() for c in columns),
            voxel.radius_class.tobytes(),
            *index,
            base[row].tolist(),
        ]
    return found


def assert_same_answers(found: Any, expected: Any, but: tuple[str, ...] = ()) -> None:
    """Every column of the same bytes, costs included."""
    assert type(found) is type(expected)
    for name in array_fields(type(expected)):
        if name not in but:
            assert getattr(found, name).tobytes() == getattr(expected, name).tobytes(), name
    assert asdict(found)["faults"] == asdict(expected)["faults"]


def poses_near(rng: np.random.Generator, count: int = 24) -> NDArray[np.float64]:
    """Poses around what is left out: most put a point of the body into a box."""
    inside = rng.uniform(DOOR.low, DOOR.high, (count, 3))
    poses = [cases.pose_of(cases.random_rotation(rng), at) for at in inside]
    return np.concatenate([poses, cases.near_poses(rng, np.vstack(two_scans()), BODY, count, 0.04)])


def ask_all(scene: Scene, poses: NDArray[np.float64], model: str | None) -> Iterator[Any]:
    """The answers to every question."""
    scene.add_avatar("al", BODY, 0.02)
    ends = np.roll(poses, 1, axis=0)
    places, ways = poses[:, :3, 3].copy(), poses[:, :3, 0].copy()
    yield scene.collide("al", poses, 0.01, radius_model=model)
    yield scene.distance("al", poses, 0.3, radius_model=model)
    yield scene.contacts("al", poses, 20, 0.05, radius_model=model)
    yield scene.sweep("al", poses, ends, radius_model=model)
    yield scene.raycast(places, ways, 3.0, radius_model=model)
    yield scene.within(places, 0.5)
    yield scene.collide("al", poses, 0.01, budget_visits=40, tolerance=1e-3, radius_model=model)
    scene.residency.check()


@pytest.mark.parametrize("model", [None, "local+border:0.3"])
def test_every_question_is_answered_as_by_an_archive_of_the_rest(
    whole: Path, rest: Path, model: str | None, rng: np.random.Generator
) -> None:
    poses = poses_near(rng)
    with open_without(whole, DOOR, ROOM) as scene, Scene.open(rest) as expected, Scene.open(whole) as before:
        answers = [list(ask_all(each, poses, model)) for each in (scene, expected, before)]
    # The bounds, by which a pose is outside, stay the archive's; both are the same here.
    for found, right in zip(answers[0], answers[1], strict=True):
        assert_same_answers(found, right)
    assert answers[0][2].pairs_found.sum() < answers[2][2].pairs_found.sum()


@pytest.mark.interpreted
def test_verdicts_and_distances_are_those_of_the_naive_judges(whole: Path, rng: np.random.Generator) -> None:
    points = np.vstack(two_scans())
    left = points[~in_boxes(points, (DOOR, ROOM))]
    poses = poses_near(rng)
    with open_without(whole, DOOR, ROOM) as scene:
        scene.add_avatar("al", BODY, 0.02)
        verdict = scene.collide("al", poses).verdict
        judged = naive.collide(left, scene.info().origin, STEP, 0.01, BODY, 0.02, poses)
        distance = scene.distance("al", poses, 0.1).signed_distance
        nearest = naive_distance.distance(left, scene.info().origin, STEP, 0.01, BODY, 0.02, poses, 0.1)
    assert verdict.tolist() == judged.astype(int).tolist()
    assert distance.tolist() == [np.inf if pair is None else pair.signed for pair in nearest]
    assert 0 < judged.sum() < len(judged)


@pytest.mark.interpreted
def test_voxels_are_those_that_a_build_of_the_rest_stores(whole: Path, rest: Path) -> None:
    boxes = [(box.low, box.high) for box in (DOOR, ROOM)]
    with LeftOut(whole, boxes) as found, Archive(rest) as expected, Archive(whole) as before:
        served, stored = voxel_bytes(found), voxel_bytes(expected)
        assert served == stored
        # Some are rebuilt, one is gone, most are what they were.
        untouched = {key for key, held in voxel_bytes(before).items() if served.get(key) == held}
        assert 0 < len(untouched) < len(served) < len(before.voxels)
        assert found.header.points == before.header.points
        assert (found.header.low.tolist(), found.header.radius) == (
            before.header.low.tolist(),
            before.header.radius,
        )


def test_a_voxel_left_empty_is_gone_and_clear(whole: Path) -> None:
    with open_without(whole, ROOM) as scene, Scene.open(whole) as before:
        assert scene.info().voxels == before.info().voxels - 1
        assert scene.info().points == before.info().points
        pose = cases.pose_of(np.eye(3), np.array([1.25, 1.25, 0.75]))[None]
        for each, verdict in ((scene, 0), (before, 1)):
            each.add_avatar("ball", [[0.0, 0, 0]], 0.2)
            assert each.collide("ball", pose).verdict.tolist() == [verdict]
        assert scene.collide("ball", pose).misses == 0
        scene.residency.check()


def test_a_box_beside_everything_changes_no_byte(whole: Path, rng: np.random.Generator) -> None:
    outside = ThroughBox("outside", (2.0 + STEP, -9.0, -9.0), (9.0, 9.0, 9.0))
    # Between two lattice planes: it meets voxels, and holds no point.
    between = ThroughBox("between", (0.5 + STEP / 4, 0.0, 0.0), (0.5 + STEP / 2, 2.0, 2.0))
    poses = poses_near(rng, 6)
    with LeftOut(whole, [(b.low, b.high) for b in (outside, between)]) as found, Archive(whole) as before:
        assert found.voxels.tobytes() == before.voxels.tobytes()
        frames = [
            [archive.read_frames(row) for row in range(len(before.voxels))] for archive in (found, before)
        ]
        assert frames[0] == frames[1]
    with open_without(whole, outside, between) as scene, Scene.open(whole, "hall") as expected:
        assert scene.info() == expected.info()
        for answer, right in zip(ask_all(scene, poses, None), ask_all(expected, poses, None), strict=True):
            assert_same_answers(answer, right)


@pytest.mark.interpreted
def test_scan_intensity_and_class_of_the_points_that_stay_are_what_they_were(whole: Path) -> None:
    def stored(archive: Archive) -> list[tuple[Any, ...]]:
        found = []
        for row in range(len(archive.voxels)):
            voxel, links = archive.read_voxel(row)
            base = archive.coordinates[row] * archive.header.lattice.voxel_steps
            world = archive.header.lattice.to_world(voxel_points(voxel, links) + base)
            columns = (voxel.scan_index, voxel.intensity, voxel.radius_class)
            found += zip(map(tuple, world.tolist()), *(c.tolist() for c in columns), strict=True)
        return sorted(found)

    with LeftOut(whole, [(DOOR.low, DOOR.high)]) as archive, Archive(whole) as before:
        found, everything = stored(archive), stored(before)
    held = in_boxes(np.array([point[0] for point in everything]), (DOOR,))
    assert found == [point for point, left_out in zip(everything, held, strict=True) if not left_out]
    numbered = {(tuple(xyz), number) for number, part in enumerate(two_scans()) for xyz in part.tolist()}
    assert {point[:2] for point in everything} == numbered


def corrupt(archive: Path, place: NDArray[np.float64]) -> str:
    """Flip a byte of the points of the voxel that holds a place; returns how messages name the voxel."""
    with Archive(archive) as opened:
        voxel = (place // 0.5).astype(int)
        row = int(np.flatnonzero((opened.coordinates == voxel).all(axis=1))[0])
        entry = opened.voxels[row]
        path = opened.shard_path(int(entry["shard"]))
    with open(path, "r+b") as file:
        offset = int(entry["frame_offset"][2]) + int(entry["frame_bytes"][2]) // 2
        byte = os.pread(file.fileno(), 1, offset)[0]
        os.pwrite(file.fileno(), bytes([byte ^ 0x10]), offset)
    return f"voxel ({', '.join(map(str, voxel.tolist()))})"


def test_a_corrupt_record_in_a_box_says_so_and_is_unknown(tmp_path: Path) -> None:
    archive = build(tmp_path / "own", two_scans())
    place = np.array([0.25, 0.75, 0.75])
    named = corrupt(archive, place)
    pose = cases.pose_of(np.eye(3), place)[None]
    with open_without(archive, DOOR) as scene, Scene.open(archive) as plain:
        answers = []
        for each in (scene, plain):
            each.add_avatar("ball", [[0.0, 0, 0]], 0.01)
            answers.append(each.collide("ball", pose))
        assert answers[0].verdict.tolist() == [2]
        # What zstandard says of it depends on which columns were read; where it lies, and what to do, does not.
        said = [answer.faults[0].partition(" (decompression")[0].partition(" (zstd")[0] for answer in answers]
        assert said[0] == said[1]
        assert named in said[0] and said[0].endswith("damaged frame")
        assert "restore the shard or rebuild the archive" in answers[0].faults[0]
        # Mended, it is not served with the points in the box; a reload serves it without.
        corrupt(archive, place)
        assert scene.collide("ball", pose).verdict.tolist() == [2]
        scene.reload()
        assert scene.collide("ball", pose).verdict.tolist() != [2]
        scene.residency.check()


def test_a_reload_keeps_the_boxes(whole: Path, rng: np.random.Generator) -> None:
    poses = poses_near(rng, 8)
    with open_without(whole, DOOR, ROOM) as scene:
        first = list(ask_all(scene, poses, None))
        assert scene.reload().generation_after == 0
        for again, before in zip(ask_all(scene, poses, None), first, strict=True):
            assert_same_answers(again, before)


def test_a_small_cache_answers_the_same(whole: Path, rng: np.random.Generator) -> None:
    poses = poses_near(rng, 8)
    with open_without(whole, DOOR, ROOM) as scene:
        largest, expected = int(scene._opened.store.sizes.max()), list(ask_all(scene, poses, None))
    for policy, budget in (
        ("lru", largest + 4096),
        ("lru+prefetch", largest + 4096),
        ("lru+prefetch", 64 << 20),
    ):
        with open_without(whole, DOOR, ROOM, budget_bytes=budget, policy=policy) as scene:
            found = list(ask_all(scene, poses, None))
        # The work depends on what fits at a time, and with it what a budget of visits leaves undone.
        for answer, right in zip(found[:-1], expected[:-1], strict=True):
            assert_same_answers(answer, right, ("node_visits", "point_tests", "steps"))


@pytest.mark.interpreted
def test_boxes_are_in_the_world_where_an_archive_lies_at_a_pose(
    whole: Path, rng: np.random.Generator
) -> None:
    pose = cases.pose_of(cases.random_rotation(rng), rng.uniform(-5, 5, 3))
    points = np.vstack(two_scans())
    # A box with two scan points on its border, to the last bit.
    world = np.array(
        [
            [((m[0] * x + m[1] * y) + m[2] * z) + m[3] for m in pose[:3].tolist()]
            for x, y, z in points.tolist()
        ]
    )
    corners = np.sort(world[[10, 11]], axis=0)
    box = ThroughBox("tilted", tuple(corners[0].tolist()), tuple(corners[1].tolist()))
    expected = points[~in_boxes(world, (box,))]
    assert len(points) - 2 >= len(expected) > 0
    with LeftOut(whole, [(box.low, box.high)], pose) as archive:
        found = []
        for row in range(len(archive.voxels)):
            base = archive.coordinates[row] * archive.header.lattice.voxel_steps
            found.append(archive.header.lattice.to_world(voxel_points(*archive.read_voxel(row)) + base))
    assert sorted(np.concatenate(found).tolist()) == sorted(expected.tolist())


def test_boxes_that_hold_everything_are_refused(whole: Path) -> None:
    with pytest.raises(BadRequestError, match="hold all of its points: leave the archive out"):
        open_without(whole, ThroughBox("all", (0.0, 0.0, 0.0), (2.0, 2.0, 2.0)))


@pytest.mark.parametrize(
    ("pose", "said"),
    [
        (np.diag([2.0, 2, 2, 1]), "not rigid"),
        (np.diag([-1.0, 1, 1, 1]), "not rigid"),
        (np.eye(4) * np.nan, "finite"),
        (np.eye(3), r"shape \(3, 3\)"),
        (cases.pose_of(np.eye(3), np.array([2e9, 0, 0])), "within 1e9 m"),
    ],
)
def test_a_pose_that_is_not_rigid_is_refused(whole: Path, pose: NDArray[np.float64], said: str) -> None:
    error = BadTransformError if said == "not rigid" else BadRequestError
    with pytest.raises(error, match=said):
        open_without(whole, DOOR, pose=pose)


@pytest.mark.parametrize(
    ("fails", "said"),
    [
        (
            "pwrite_all",
            ": No space left on device: the voxels that boxes cut are kept there: make room, or set",
        ),
        ("read_points", r"voxel \(.*\): cannot be read \(No space left on device\)"),
    ],
)
def test_what_fails_while_it_is_opened_is_told_and_leaves_no_file_open(
    whole: Path, monkeypatch: pytest.MonkeyPatch, fails: str, said: str
) -> None:
    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    before = len(os.listdir("/proc/self/fd"))
    with open_without(whole, DOOR) as scene:
        scene.add_avatar("al", BODY, 0.02)
        within = len(os.listdir("/proc/self/fd"))
        monkeypatch.setattr(left_out, fails, full)
        with pytest.raises(SolidcloudError, match=said):
            open_without(whole, DOOR)
        with pytest.raises(SolidcloudError, match=said):
            scene.reload()
        # What was served is served on.
        assert len(os.listdir("/proc/self/fd")) == within
        assert len(scene.collide("al", np.eye(4)[None])) == 1
    assert len(os.listdir("/proc/self/fd")) == before


@pytest.mark.interpreted
@pytest.mark.parametrize("posed", [False, True])
def test_voxels_that_lie_in_a_box_whole_are_not_read(
    whole: Path, monkeypatch: pytest.MonkeyPatch, posed: bool
) -> None:
    pose = (
        cases.pose_of(cases.random_rotation(np.random.default_rng(3)), np.array([5.0, 0, 1]))
        if posed
        else None
    )
    low, high = (-9.0, -9.0, -9.0), (1.6, 1.6, 1.6)
    read: list[int] = []
    read_points = left_out.read_points

    def counted(archive: Archive, row: int) -> Any:
        read.append(row)
        return read_points(archive, row)

    with Archive(whole) as before:
        bounds = before.header.lattice.to_world(
            np.stack([before.voxels["low"], before.voxels["high"]])
            + before.coordinates * before.header.lattice.voxel_steps
        )
        every = np.concatenate(
            [
                before.header.lattice.to_world(
                    voxel_points(*before.read_voxel(row))
                    + before.coordinates[row] * before.header.lattice.voxel_steps
                )
                for row in range(len(before.voxels))
            ]
        )
    monkeypatch.setattr(left_out, "read_points", counted)
    if pose is not None:
        middle = moved(pose, np.array([[0.8, 0.8, 0.8]]))[0]
        low, high = tuple((middle - 0.7).tolist()), tuple((middle + 0.7).tolist())
    with LeftOut(whole, [(low, high)], pose) as archive:
        rows = archive.voxels["rows"][:, 2].sum()
    world = every if pose is None else moved(pose, every)
    assert rows == (~in_boxes(world, (ThroughBox("box", low, high),))).sum()
    # Of eight corners all in the box, a voxel's points are.
    corners = np.array([bounds[[i & 1, i >> 1 & 1, i >> 2], :, [0, 1, 2]].T for i in range(8)])
    carried = corners if pose is None else moved(pose, corners.reshape(-1, 3)).reshape(corners.shape)
    inside = ((carried >= low) & (carried <= high)).all(axis=(0, 2))
    assert inside.any() and read and not set(np.flatnonzero(inside)) & set(read)


def test_a_scene_without_boxes_imports_nothing_of_it(whole: Path) -> None:
    program = (
        "import sys; from solidcloud.server.scene import Scene; Scene.open(sys.argv[1]).close(); "
        "print(*(m for m in sys.modules if m.endswith(('left_out', 'without', 'builder.octree', 'through'))))"
    )
    done = partial(subprocess.run, capture_output=True, text=True, check=True)(
        [sys.executable, "-c", program, str(whole)]
    )
    assert done.stdout.split() == []
