"""Test scripts/draw_walks: each panel fulfils what its caption says, and the pictures are legible."""

from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from draw_walks_cases import mover_options, scenarios, walks_picture
from draw_walks_cases.drawn_case import Case
from draw_walks_cases.made_shapes import HEIGHT, RADIUS, SPHERE, body, body_profile
from draw_walks_cases.simulated_walks import CLEAR, FALL, OTHER, SCAN, Walk
from followed_documents import ROOT
from picture_checks import alike_in_grey, drawn_figures, overlaps
from project_scripts import load_script

PICTURES = load_script("draw_walks").PICTURES
NAMES = [(picture, case.__name__) for picture, cases in PICTURES.items() for case in cases]
# Largest size of a picture [bytes].
MAX_BYTES = 300_000


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("walks")


@lru_cache
def case_of(picture: str, name: str, folder: Path) -> Case:
    """Return a simulated case; each is simulated once."""
    (found,) = [case(folder) for case in PICTURES[picture] if case.__name__ == name]
    return found


def walk_of(picture: str, name: str, folder: Path, row: int = 0) -> Walk:
    """Return the first walk in a row of a case."""
    return case_of(picture, name, folder).rows[row].walks[0]


@pytest.mark.parametrize("picture, name", NAMES)
def test_the_caption_is_true_of_the_walks(picture: str, name: str, folder: Path) -> None:
    case = case_of(picture, name, folder)
    assert case.claims and all(case.claims.values()), case.claims
    for row in case.rows:
        assert len(row.dots) > 50
        for walk in row.walks:
            assert len(walk.places) == len(walk.touched) + 1
            assert np.isfinite(walk.places).all()


def test_the_jamb_is_slid_off_and_passed(folder: Path) -> None:
    walk = walk_of("walks.png", "jamb", folder)
    assert walk.places[0, 0] + RADIUS > scenarios.DOOR / 2, "it begins in the way of the jamb"
    assert walk.places[-1, 1] - RADIUS > scenarios.DEPTH
    assert walk.places[:, 0].max() == walk.places[0, 0], "it moves only away from the jamb"


def test_the_steep_slope_is_not_climbed(folder: Path) -> None:
    walk = walk_of("walks.png", "slope", folder)
    assert walk.places[-1, 2] - walk.places[0, 2] == pytest.approx(1.4 * np.tan(np.pi / 6), abs=0.02)
    assert (np.diff(walk.places[-20:, 0]) < 1e-3).all(), "it stands"


def test_the_drop_of_30_cm_is_fallen_and_that_of_15_cm_is_not(folder: Path) -> None:
    limited = walk_of("mover.png", "snap", folder)
    followed = walk_of("mover.png", "snap", folder, row=1)
    for walk in (limited, followed):
        assert walk.places[0, 2] - walk.places[-1, 2] == pytest.approx(0.45, abs=0.02), "both come down"
    # A drop that is followed takes one frame; free fall takes 0.25 s for 30 cm.
    assert np.diff(limited.places[:, 2]).min() > -0.2
    assert (limited.touched == FALL).sum() >= 6
    assert np.diff(followed.places[:, 2]).min() < -0.25
    assert not (followed.touched == FALL).any()


def test_the_crate_is_pushed_to_the_wall(folder: Path) -> None:
    walk = walk_of("mover.png", "push", folder)
    along = walk.objects[:, 0, 0]
    assert (np.diff(along) >= 0.0).all() and along[0] == 0.0
    face = mover_options.WALL - mover_options.CRATE / 2
    assert face - 0.03 < along[-1] < face
    assert np.array_equal(np.unique(walk.touched), [CLEAR, OTHER])


def test_a_claim_that_does_not_hold_is_false(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mover_options, "DROPS", (0.15, 0.18))
    assert mover_options.snap(folder).claims == {
        "the low drop is followed": True,
        "the high drop is fallen": False,
        "a larger value follows the high drop": True,
    }


def test_outline_is_that_of_the_bodys_spheres() -> None:
    centres, outline = body(), body_profile()
    assert centres[:, 2].min() - SPHERE == pytest.approx(0.0, abs=1e-9)
    assert centres[:, 2].max() + SPHERE == pytest.approx(HEIGHT, abs=1e-3)
    assert np.hypot(centres[:, 0], centres[:, 1]).max() + SPHERE == pytest.approx(RADIUS, abs=1e-9)
    assert outline[:, 1].max() == pytest.approx(HEIGHT) and outline[:, 0].max() == RADIUS
    assert len(centres) <= 8192


@pytest.mark.parametrize("picture", PICTURES)
def test_pictures_are_legible_and_small(picture: str, folder: Path, tmp_path: Path) -> None:
    drawn = [case_of(picture, case.__name__, folder) for case in PICTURES[picture]]
    with drawn_figures() as figures:
        walks_picture.draw(drawn, tmp_path / picture)
    (figure,) = figures
    assert overlaps(figure) == []
    assert alike_in_grey(figure) == []
    for path in (tmp_path / picture, ROOT / ".github" / picture):
        assert path.read_bytes().startswith(b"\x89PNG") and path.stat().st_size < MAX_BYTES


def test_the_guide_shows_all_pictures() -> None:
    guide = (ROOT / "schemas" / "SCENE.md").read_text()
    assert all(f"(../.github/{picture})" in guide for picture in PICTURES)


def test_paths_are_drawn_in_runs_of_one_kind() -> None:
    runs = walks_picture._runs(np.array([CLEAR, SCAN, SCAN, CLEAR, SCAN]) == SCAN)
    assert list(runs) == [(1, 3), (4, 5)]
