"""An index that hides voxels: bounds smaller than their points, which no question would ever make the server read."""

import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import archive_cases
import numpy as np
import pytest
import synthetic_scans
from forged_archives import Columns, forge
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.archive.voxel_grid import voxel_coordinates
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.archives.masked_archive import MaskedArchive
from solidcloud.server.avatars.avatar_model import make_avatar
from solidcloud.server.queries.collide import collide
from solidcloud.server.queries.context.query_budget import EXACT
from solidcloud.server.queries.context.query_context import make_scene_data
from solidcloud.server.queries.resident_fast_path import ResidentQueries, distance_fast
from solidcloud.server.residency.voxel_cache import VoxelCache
from solidcloud.server.residency.voxel_store import VoxelStore
from solidcloud.server.scene import Scene

BALL = np.zeros((1, 3))
RADIUS = 0.001


class Hidden(NamedTuple):
    """An archive whose index says of every voxel that its points are at one place.

    hidden: points (n, 3) [m], of each voxel the one farthest from that place.  said: (n, 3) [m], that place.
    """

    folder: Path
    hidden: np.ndarray
    said: np.ndarray


def points_of(archive: Archive, row: int) -> np.ndarray:
    """The points of a voxel (n, 3) [voxel steps]."""
    from solidcloud.builder.voxel.record_points import voxel_points

    return voxel_points(*archive.read_voxel(row)).astype(np.int64)


def shrink(folder: Path, chosen: Callable[[int], bool]) -> Hidden:
    """Forge an index: voxels of the rows that are chosen shrink to one of their points."""
    hidden, said, places = [], [], {}
    with Archive(folder) as archive:
        steps = archive.header.lattice.voxel_steps
        for row in range(len(archive.voxels)):
            local = points_of(archive, row)
            far = np.argmax(np.abs(local - local[0]).max(axis=1))
            if not chosen(row) or np.abs(local[far] - local[0]).max() < 300:
                continue
            places[row] = local[0]
            for found, place in ((hidden, local[far]), (said, local[0])):
                found.append(archive.header.lattice.to_world(place + archive.coordinates[row] * steps))

    def change(columns: Columns) -> None:
        voxels = columns["voxels"]
        for row, place in places.items():
            voxels["low"][row] = voxels["high"][row] = place
        base = voxel_coordinates(voxels["key"]) * int(columns["voxel_steps"][0])
        columns["bounds"][0] = (base + voxels["low"]).min(axis=0)
        columns["bounds"][1] = (base + voxels["high"]).max(axis=0)

    forge(folder, change)
    return Hidden(folder, np.array(hidden).reshape(-1, 3), np.array(said).reshape(-1, 3))


@pytest.fixture(scope="module")
def every(tmp_path_factory: pytest.TempPathFactory) -> Hidden:
    """An archive all of whose voxels are hidden."""
    folder = tmp_path_factory.mktemp("hidden")
    found = shrink(
        archive_cases.build(folder, synthetic_scans.make_scan("noise", 3, 2000)).archive, lambda _: True
    )
    assert len(found.hidden) > 5
    return found


def poses_at(places: np.ndarray) -> np.ndarray:
    """Poses (n, 4, 4) at some places."""
    poses = np.tile(np.eye(4), (len(places), 1, 1))
    poses[:, :3, 3] = places
    return poses


def probed(scene: Scene, at: np.ndarray, question: str) -> Any:
    """What a frame of a simulation asks about one avatar, pose by pose."""
    probe, data = ResidentQueries(scene.avatar("ball", "")), scene._data
    verdicts = []
    for pose in poses_at(at):
        if question == "collide":
            verdicts.append(probe.collide(data, pose, EXACT)[0])
        elif question == "sweep":
            before = pose.copy()
            before[:3, 3] += 0.3
            verdicts.append(probe.sweep(data, before, pose, 1e-6, EXACT).verdict)
        else:
            verdicts.append(distance_fast(data, scene.avatar("ball", ""), pose, 0.05).verdict[0])
    return SimpleNamespace(verdict=np.array(verdicts))


OneQuestion = Callable[[Scene, np.ndarray], Any]
QUESTIONS: dict[str, OneQuestion] = {
    "collide": lambda s, at: s.collide("ball", poses_at(at)),
    "collide in the dark": lambda s, at: s.collide("ball", poses_at(at), budget_ms=0.0),
    "collide bounded": lambda s, at: s.collide("ball", poses_at(at), budget_visits=1 << 30),
    "distance": lambda s, at: s.distance("ball", poses_at(at), RADIUS),
    "distance far": lambda s, at: s.distance("ball", poses_at(at), 0.1),
    "distance bounded": lambda s, at: s.distance("ball", poses_at(at), RADIUS, budget_visits=1 << 30),
    "contacts": lambda s, at: s.contacts("ball", poses_at(at)),
    "sweep": lambda s, at: s.sweep("ball", poses_at(at), poses_at(at + 1e-4)),
    "sweep from afar": lambda s, at: s.sweep("ball", poses_at(at + 5.0), poses_at(at)),
    "sweep in place": lambda s, at: s.sweep("ball", poses_at(at), poses_at(at)),
    "raycast": lambda s, at: s.raycast(at, np.tile([1.0, 0.0, 0.0], (len(at), 1)), RADIUS),
    "raycast from afar": lambda s, at: s.raycast(at - [9.0, 0, 0], np.tile([1.0, 0, 0], (len(at), 1)), 10.0),
    "within": lambda s, at: s.within(at, RADIUS),
    "within in the dark": lambda s, at: s.within(at, RADIUS, budget_ms=0.0),
    "frame, collide": lambda s, at: probed(s, at, "collide"),
    "frame, sweep": lambda s, at: probed(s, at, "sweep"),
    "frame, distance": lambda s, at: probed(s, at, "distance"),
    "objects": lambda s, at: s.objects([("ball", pose) for pose in poses_at(at)]),
}


@pytest.fixture(params=["lru", "lru+prefetch"])
def opened(request: pytest.FixtureRequest) -> Callable[[Path], Scene]:
    """Open a scene with an avatar of one point."""

    def open_(folder: Path, **options: Any) -> Scene:
        scene = Scene.open(folder, policy=request.param, **options)
        scene.add_avatar("ball", BALL, RADIUS)
        return scene

    return open_


@pytest.mark.parametrize("name", QUESTIONS)
def test_no_hidden_voxel_is_clear(name: str, every: Hidden, opened: Callable[[Path], Scene]) -> None:
    """Ask at a third of the places one by one, at other thirds for other questions; then at all."""
    for place in every.hidden[list(QUESTIONS).index(name) % 3 :: 3]:
        with opened(every.folder) as scene:
            answers = QUESTIONS[name](scene, place[None])
            assert (answers.verdict != Verdict.CLEAR).all(), place
            if "dark" not in name:
                # A contact may be known from the level, without a load.
                assert scene.residency.misled or (answers.verdict == Verdict.CONTACT).all()
    with opened(every.folder) as scene:
        assert (QUESTIONS[name](scene, every.hidden).verdict != Verdict.CLEAR).all()


def test_a_path_is_clear_of_no_hidden_voxel(every: Hidden) -> None:
    for place in every.hidden:
        with Scene.open(every.folder) as scene:
            scene.add_avatar("ball", BALL, RADIUS)
            parts = list(scene.path("ball", poses_at(np.linspace(place + 5.0, place, 40))))
            assert (parts[-1].verdict[-1:] != Verdict.CLEAR).all()


@pytest.fixture(scope="module")
def one_each(tmp_path_factory: pytest.TempPathFactory) -> list[Hidden]:
    """Archives in each of which one voxel alone is hidden."""
    folder = tmp_path_factory.mktemp("one")
    built = archive_cases.build(folder, synthetic_scans.make_scan("noise", 3, 2000)).archive
    return [
        shrink(shutil.copytree(built, folder / str(number)), lambda row, number=number: row == number)
        for number in range(0, 40, 5)
    ]


@pytest.mark.parametrize("name", ["collide", "distance", "sweep", "raycast", "within"])
def test_one_hidden_voxel_among_others_is_not_clear(name: str, one_each: list[Hidden]) -> None:
    """In turn: an archive in which one voxel alone is hidden, asked from afar first."""
    hidden = 0
    for found in one_each:
        for place in found.hidden:
            with Scene.open(found.folder) as scene:
                scene.add_avatar("ball", BALL, RADIUS)
                assert (QUESTIONS[name](scene, place[None] + 50.0).verdict == Verdict.CLEAR).all()
                assert (QUESTIONS[name](scene, place[None]).verdict != Verdict.CLEAR).all()
                hidden += 1
    assert hidden > 2


def test_a_box_that_is_passed_through_takes_no_voxel_whole_that_the_index_places_in_it(every: Hidden) -> None:
    for place, said in list(zip(every.hidden, every.said, strict=True))[:8]:
        boxes = [np.stack([said - 0.001, said + 0.001])]
        store = VoxelStore(every.folder, partial(MaskedArchive, boxes=boxes))
        try:
            data = make_scene_data(store.archive, VoxelCache(store, 1 << 26))
            answers = collide(data, make_avatar(BALL, RADIUS), poses_at(place[None]))
            assert answers.verdict.tolist() == [Verdict.UNKNOWN] and data.residency.misled
        finally:
            store.close()
