"""Floor plans: what is drawn, what is refused, and what is read."""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import archive_cases
import numpy as np
import pytest
from effect_rooms import plane
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure
from PIL import Image
from solidcloud.schemas.errors import BadRequestError, SolidcloudError
from solidcloud.schemas.wire.question_table import COLLIDE
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


@pytest.mark.parametrize("suffix", [".png", ".svg", ".pdf"])
def test_the_plan_is_written(scene: Scene, tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"plan{suffix}"
    assert isinstance(scene.plot("post", POSES, path=path), Figure)
    assert path.stat().st_size > 1_000
    if suffix == ".png":
        with Image.open(path) as image:
            assert image.width > 500


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
