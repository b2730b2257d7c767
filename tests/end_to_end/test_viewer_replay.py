"""Test record and replay in the viewer with a real browser."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from solidcloud.server.cli.input.pose_file import read_poses, read_tum_poses, write_poses
from solidcloud.server.viewer.viewer import viewing
from viewed_page import ViewedPage, needs_chromium, viewed_page

pytestmark = [needs_chromium, pytest.mark.slow]

# Before the main door.
COURT = "0,-6,0.1,90"


@pytest.fixture(scope="module")
def viewed(browser: Any, facade_endpoint: str) -> Iterator[ViewedPage]:
    with (
        viewing(facade_endpoint) as url,
        viewed_page(browser, f"{url}?at={COURT}") as viewed,
    ):
        viewed.wait("s.place")
        yield viewed
        viewed.check_clean(url)


def at_rest(viewed: ViewedPage) -> Any:
    """Return the user's place once it stays: states of a busy server arrive late."""
    place = viewed.read("s.place")
    while True:
        viewed.page.wait_for_timeout(1500)
        now = viewed.read("s.place")
        if np.allclose(now, place, atol=1e-3):
            return now
        place = now


def saved(viewed: ViewedPage, button: str, folder: Path) -> Path:
    """Return the file that a button saves."""
    with viewed.page.expect_download() as download:
        viewed.page.get_by_role("button", name=button).click()
    path = folder / download.value.suggested_filename
    download.value.save_as(path)
    return path


def test_walk_is_recorded_saved_and_played_back(viewed: ViewedPage, tmp_path: Path) -> None:
    start = viewed.read("s.place")
    viewed.page.keyboard.press("t")
    viewed.wait("s.walk.recording && s.walk.samples > 3")
    assert "Recording" in viewed.page.inner_text("#panel")
    with viewed.held("w"):
        viewed.wait("s.place", lambda place: place[1] > start[1] + 1.0)
    # The last state that is recorded is the place where the user stopped.
    viewed.wait("s.walk.seconds || s.walk.samples", lambda samples: samples > 20)
    end = at_rest(viewed)
    viewed.page.keyboard.press("t")
    viewed.wait("!s.walk.recording && s.walk.seconds > 0.5")

    times, poses = read_poses(saved(viewed, "Save as CSV", tmp_path))
    assert len(times) == viewed.read("s.walk.samples")
    assert times[0] == 0
    assert (np.diff(times) > 0).all()
    assert np.allclose(poses[0, :3, 3], start[:3], atol=0.02)
    assert np.allclose(poses[-1, :3, 3], end[:3], atol=0.02)
    # The user walked north, and faces where it walks.
    assert np.allclose(poses[-1, :3, 1], (0, 1, 0), atol=0.05)
    tum_times, tum_poses = read_tum_poses(saved(viewed, "Save as TUM", tmp_path))
    assert np.array_equal(tum_times, times)
    assert np.allclose(tum_poses, poses, atol=1e-12)

    ghost = viewed.wait("s.walk.place")
    assert np.allclose(ghost, start[:3], atol=0.02)
    viewed.page.keyboard.press("p")
    viewed.wait("s.walk.time > 0")
    viewed.wait("!s.walk.playing && s.walk.time === s.walk.seconds")
    assert np.allclose(viewed.wait("s.walk.place"), end[:3], atol=0.02)
    # Nobody moved the user.
    assert np.allclose(viewed.read("s.place")[:3], end[:3], atol=0.02)


def test_file_is_loaded_and_its_ghost_moves_stops_and_is_seen(viewed: ViewedPage, tmp_path: Path) -> None:
    place = viewed.read("s.place")
    poses = np.tile(np.eye(4), (3, 1, 1))
    # Beside the user, from where the camera looks at the door.
    poses[:, :3, 3] = np.add(place[:3], [[1.0, 0.5, 0.0], [1.0, 1.5, 0.0], [1.0, 2.5, 0.0]])
    write_poses(tmp_path / "beside.csv", np.array([10.0, 15.0, 80.0]), poses)
    viewed.page.get_by_label("File of poses").set_input_files(tmp_path / "beside.csv")
    viewed.wait("s.walk.seconds === 70 && s.walk.samples === 3")
    assert "beside.csv: 70.0 s, 3 poses" in viewed.page.inner_text("#panel")
    assert np.allclose(viewed.wait("s.walk.place"), poses[0, :3, 3], atol=1e-6)

    viewed.page.get_by_label("Speed").select_option("4")
    viewed.page.get_by_role("button", name="Play", exact=True).click()
    viewed.wait("s.walk.time > 2")
    viewed.page.get_by_role("button", name="Pause", exact=True).click()
    viewed.wait("!s.walk.playing")
    time = viewed.read("s.walk.time")
    assert time < 70
    expected = np.interp(time, (0, 5, 70), poses[:, 1, 3])
    viewed.wait("s.walk.place", lambda at: abs(at[1] - expected) < 1e-6)
    viewed.page.wait_for_timeout(200)
    assert viewed.read("s.walk.time") == time

    viewed.page.get_by_label("Time of the walk").fill("70")
    viewed.wait("s.walk.place", lambda at: abs(at[1] - poses[-1, 1, 3]) < 1e-6)
    viewed.wait_complete()
    with_ghost = viewed.picture()
    viewed.page.get_by_role("button", name="Remove", exact=True).click()
    viewed.wait("s.walk.place === null")
    viewed.page.wait_for_timeout(500)
    viewed.wait_complete()
    changed = np.abs(viewed.picture() - with_ghost).max(axis=-1) > 40
    assert changed.sum() > 300
    # It is pale, where the users are green.
    assert with_ghost[changed].min(axis=-1).mean() > 60


def test_file_that_is_no_walk_is_refused(viewed: ViewedPage, tmp_path: Path) -> None:
    (tmp_path / "wrong.tum").write_text("0 0 0\n")
    viewed.page.get_by_label("File of poses").set_input_files(tmp_path / "wrong.tum")
    viewed.wait("s.notices.includes('walk')")
    assert "wrong.tum, line 1: 3 values" in viewed.page.inner_text("#notices")
