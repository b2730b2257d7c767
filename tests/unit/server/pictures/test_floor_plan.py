"""Floor plans: what is drawn, what is refused, and what is read."""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import archive_cases
import numpy as np
import pytest
from effect_rooms import plane
from matplotlib.collections import PathCollection, PolyCollection
from matplotlib.figure import Figure
from PIL import Image
from solidcloud.schemas.errors import BadRequestError, SolidcloudError
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.schemas.wire.question_table import COLLIDE
from solidcloud.server.archives.placed_archive import PlacedArchive
from solidcloud.server.pictures.floor_plan import plan_axes, standing_heights
from solidcloud.server.pictures.plan_points import read_plan_points
from solidcloud.server.scene import Scene

POST = np.column_stack([np.zeros(20), np.zeros(20), np.linspace(0.0, 1.8, 20)])


def room() -> np.ndarray:
    """A room of 4 by 3 m with a door in its wall at y = 0, at x from 1 to 2."""
    floor = plane((0, 0, 0), (4, 3, 0))
    walls = [plane((0, y, 0), (4, y, 2.5)) for y in (0.0, 3.0)] + [
        plane((x, 0, 0), (x, 3, 2.5)) for x in (0.0, 4.0)
    ]
    points = np.unique(np.round(np.concatenate([floor, *walls]), 6), axis=0)
    door = (
        (points[:, 1] == 0)
        & (points[:, 0] > 1)
        & (points[:, 0] < 2)
        & (points[:, 2] < 2.1)
        & (points[:, 2] > 0)
    )
    return points[~door]


def standing(*places: tuple[float, float]) -> np.ndarray:
    """Upright poses just above the floor."""
    poses = np.tile(np.eye(4), (len(places), 1, 1))
    poses[:, :2, 3], poses[:, 2, 3] = places, 0.12
    return poses


# Through the door, then into the wall beside it.
POSES = standing((1.5, -0.4), (1.5, 0.0), (1.5, 0.5), (3.0, 0.0), (3.0, 3.0))


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return archive_cases.build(tmp_path_factory.mktemp("room"), room(), radius=0.05, voxel=1.0).archive


@pytest.fixture
def scene(archive: Path) -> Iterator[Scene]:
    with Scene.open(archive, "room") as scene:
        scene.add_avatar("post", POST, 0.05)
        yield scene


def marked(figure: Figure) -> dict[str, int]:
    """The label of each kind of mark and the number of its marks."""
    found = [each for each in figure.axes[0].collections if isinstance(each, PathCollection)]
    return {str(each.get_label()): len(each.get_offsets()) for each in found}  # type: ignore[arg-type]


def image_of(figure: Figure) -> Any:
    """The image of the scan's points."""
    return figure.axes[0].images[0].get_array()


def test_poses_are_marked_by_verdict(scene: Scene) -> None:
    figure = scene.plot("post", POSES)
    assert marked(figure) == {"clear: 3": 3, "contact: 2": 2}
    axes = figure.axes[0]
    assert axes.get_title() == "room: plan, z from 0.27 to 1.92 m"
    assert (axes.get_xlabel(), axes.get_ylabel(), axes.get_aspect()) == ("x [m]", "y [m]", 1.0)
    (low, high), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    assert (POSES[:, 0, 3] > low).all() and (POSES[:, 0, 3] < high).all()
    assert (POSES[:, 1, 3] > bottom).all() and (POSES[:, 1, 3] < top).all()
    assert scene.stats().answers == len(POSES)


def test_given_answers_are_not_asked_again(scene: Scene) -> None:
    answers = scene.distance("post", POSES, 0.5)
    before = scene.stats().answers
    assert marked(scene.plot("post", POSES, answers)) == {"clear: 3": 3, "contact: 2": 2}
    unknown = COLLIDE.unknown(5)
    assert marked(scene.plot(poses=POSES, answers=unknown)) == {"unknown: 5": 5}
    assert scene.stats().answers == before


def test_the_slice_leaves_the_floor_and_the_door_out(scene: Scene) -> None:
    sliced, whole = scene.plot("post", POSES), scene.plot(poses=POSES, answers=COLLIDE.unknown(5))
    assert image_of(sliced).count() < image_of(whole).count() / 2, "the floor is not drawn"
    axes = sliced.axes[0].images[0]
    left, right, bottom, top = axes.get_extent()
    image = image_of(sliced)
    across = np.linspace(left, right, image.shape[1])
    row = slice(*(int((y - bottom) / (top - bottom) * image.shape[0]) for y in (-0.05, 0.05)))
    drawn = ~np.ma.getmaskarray(image[row]).all(axis=0)
    assert not drawn[(across > 1.1) & (across < 1.9)].any(), "the door is open"
    assert drawn[(across > 2.2) & (across < 3.8)].mean() > 0.1, "the wall is there"


def test_heights_are_as_given(scene: Scene) -> None:
    assert scene.plot(heights=(0.5, 1.0)).axes[0].get_title() == "room: plan, z from 0.50 to 1.00 m"
    assert scene.plot().axes[0].get_title() == "room: plan"


def test_an_empty_slice_is_drawn(scene: Scene) -> None:
    assert not scene.plot(heights=(50.0, 51.0)).axes[0].images


def test_what_is_beyond_the_budget_is_drawn_as_boxes(scene: Scene) -> None:
    def boxes(figure: Figure) -> int:
        found = [each for each in figure.axes[0].collections if isinstance(each, PolyCollection)]
        return sum(len(each.get_paths()) for each in found)

    assert boxes(scene.plot()) == 0
    assert boxes(scene.plot(points=0)) == scene.info().voxels
    assert 0 < boxes(scene.plot("post", POSES[:1], points=2_000)) < scene.info().voxels


def test_voxels_near_the_poses_are_read_first(scene: Scene) -> None:
    low, high = np.full(3, -9.0), np.full(3, 9.0)
    near = np.array([[0.0, 0, 0]])
    found = read_plan_points(scene.archives, low, high, near, 3_000)
    assert 0 < len(found.points) <= 3_000
    farthest = np.linalg.norm(found.points - near, axis=1).max()
    assert farthest < np.linalg.norm(found.boxes.mean(axis=1) - near, axis=1).max() + 1.0
    every = read_plan_points(scene.archives, low, high, near, 10**9)
    assert len(every.points) == scene.info().points and not len(every.boxes)
    expected = room()
    assert np.allclose(np.sort(every.points, axis=0), np.sort(expected, axis=0), atol=1e-4)


def test_a_placed_archive_is_drawn_in_the_world(archive: Path, tmp_path: Path) -> None:
    file = tmp_path / "moved.toml"
    file.write_text(
        f'format = 1\nup = [0.0, 1.0, 0.0]\n[[archives]]\npath = "{archive}"\n'
        "pose = [[1.0, 0.0, 0.0, 10.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]\n"
    )
    with Scene.open(file) as scene:
        found = read_plan_points(scene.archives, np.full(3, -99.0), np.full(3, 99.0), np.zeros((1, 3)), 10**9)
        points = room()
        expected = np.column_stack([points[:, 0] + 10, points[:, 2], -points[:, 1]])
        assert np.allclose(np.sort(found.points, axis=0), np.sort(expected, axis=0), atol=1e-4)
        axes = scene.plot().axes[0]
        assert (axes.get_xlabel(), axes.get_ylabel()) == ("x [m]", "z [m]")
        assert axes.get_ylim()[0] > axes.get_ylim()[1], "seen from above"


@pytest.mark.parametrize(
    ("up", "axes"),
    [
        ((0, 0, 1), (0, 1, 2, 1.0, False)),
        ((0, 0, -1), (0, 1, 2, -1.0, True)),
        ((0, 1, 0), (0, 2, 1, 1.0, True)),
        ((0.1, -0.9, 0.3), (0, 2, 1, -1.0, False)),
        ((1, 0, 0), (1, 2, 0, 1.0, False)),
    ],
)
def test_axes_follow_the_direction_against_gravity(up: tuple[float, ...], axes: tuple[Any, ...]) -> None:
    assert plan_axes(up) == axes


def test_heights_of_a_standing_avatar() -> None:
    tall = np.array([[0.0, 0, 0], [0, 0, 2.0]])
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 2, 3] = 0.0, 1.0, 50.0
    assert standing_heights(tall, poses, plan_axes((0, 0, 1))) == (1.15, 3.0)
    assert standing_heights(tall / 2, poses, plan_axes((0, 0, 1))) == (1.1, 2.0)
    assert standing_heights(tall, poses[:0], plan_axes((0, 0, 1))) is None


@pytest.mark.parametrize("suffix", [".png", ".svg", ".pdf"])
def test_the_plan_is_written(scene: Scene, tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"plan{suffix}"
    assert isinstance(scene.plot("post", POSES, path=path), Figure)
    assert path.stat().st_size > 1_000
    if suffix == ".png":
        with Image.open(path) as image:
            assert image.width > 500


def test_verdicts_differ_in_shape_and_in_grey(scene: Scene) -> None:
    every = COLLIDE.unknown(3)
    every.verdict[:] = [int(verdict) for verdict in Verdict]
    figure = scene.plot(poses=POSES[:3], answers=every)
    marks = [each for each in figure.axes[0].collections if isinstance(each, PathCollection)]
    greys = sorted(float(each.get_facecolor()[0][:3] @ [0.299, 0.587, 0.114]) for each in marks)
    assert greys[1] - greys[0] > 0.3 and greys[2] - greys[1] > 0.03
    assert len({len(each.get_paths()[0].vertices) for each in marks}) == 3


def test_axes_of_the_caller_are_drawn_into(scene: Scene) -> None:
    figure = Figure()
    axes = figure.subplots(1, 2)
    assert scene.plot("post", POSES, axes=axes[1]) is figure
    assert not axes[0].collections and axes[1].collections


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"poses": POSES}, BadRequestError, "poses without an avatar: expected its name, or the answers"),
        ({"poses": POSES, "answers": COLLIDE.unknown(2)}, BadRequestError, "2 answers about 5 poses"),
        ({"poses": np.eye(3), "avatar": "post"}, BadRequestError, "expected"),
        (
            {"poses": POSES * np.nan, "answers": COLLIDE.unknown(5)},
            BadRequestError,
            "a pose that is not finite",
        ),
        ({"path": "plan.docx"}, SolidcloudError, "plan.docx: cannot write the plan .*: choose another path"),
        ({"path": "no/such/folder/plan.png"}, SolidcloudError, "cannot write the plan"),
    ],
)
def test_what_cannot_be_drawn_is_refused(
    scene: Scene, arguments: dict[str, Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        scene.plot(**arguments)


def test_without_matplotlib_the_extra_is_named(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(SolidcloudError, match=r"matplotlib.* pip install 'solidcloud\[report\]'"):
        scene.plot()


def test_a_voxel_that_cannot_be_read_is_a_box(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    with scene.archives[0].take() as opened:
        archive = opened.store.archive
        read = archive.read_voxel
        broken: list[int] = []

        def read_some(row: int) -> Any:
            if not broken or row in broken:
                broken.append(row)
                raise OSError("the disk is gone")
            return read(row)

        monkeypatch.setattr(archive, "read_voxel", read_some)
    every = np.full(3, 99.0)
    found = read_plan_points(scene.archives, -every, every, np.zeros((1, 3)), 10**9)
    assert len(found.boxes) == 1 and 0 < len(found.points) < scene.info().points
    assert isinstance(scene.archives[0], PlacedArchive)
