"""Test the viewer with a real browser: what its page shows, and that the server moves its user."""

import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from solidcloud.schemas.wire.warming_parts import READY_LINE
from solidcloud.server.report.walk.server_process import served
from solidcloud.server.viewer.viewer import viewing
from viewed_page import CHROMIUM, coloured, needs_chromium, viewed_page

pytestmark = needs_chromium

WALL = -9.0
BY_WALL, BEFORE_DOOR = "-7.6,-9,0.1,180", "0,-0.7,0.5,90"


@pytest.fixture
def url(facade_endpoint: str) -> Iterator[str]:
    with viewing(facade_endpoint) as url:
        yield url


def test_page_shows_the_scan_and_a_user_on_the_floor(browser: Any, url: str) -> None:
    with viewed_page(browser, url, full=True) as viewed:
        viewed.wait_complete()
        picture = viewed.picture()
        assert coloured(picture) > 0.15
        assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 200
        # The user's colour: much more green than red, where the scan's heights are blue.
        red, green, blue = np.moveaxis(picture, -1, 0)
        assert ((green > 1.5 * red) & (green >= blue)).sum() > 500
        assert viewed.read("s.verdict") == "clear"
        assert viewed.read("s.voxels.length") > 20
        assert viewed.page.inner_text("#scene-name").startswith("archive · 60,000 points")
        viewed.check_clean(url)


def test_user_walks_is_stopped_by_the_wall_and_slides_along_it(browser: Any, url: str) -> None:
    with viewed_page(browser, f"{url}?at={BY_WALL}") as viewed:
        start = viewed.wait("s.place")
        assert np.allclose(start[:2], (-7.6, -9.0), atol=1e-3)
        with viewed.held("w"):
            viewed.wait("s.verdict === 'stopped' && s.touched")
            viewed.wait("s.contacts > 0")
            (touched, *_) = viewed.wait("s.touched.length && s.touched")
            # The picture of a user who pushes, and does not move, is drawn in full.
            viewed.wait("s.complete")
        stopped = viewed.read("s.place")
        assert WALL < stopped[0] < -8.3
        assert touched["normal"] is not None
        # East is behind: turned to the right, the view is to the north-west, obliquely along the wall.
        with viewed.held("e"):
            viewed.wait("s.yaw", lambda yaw: 1.6 < yaw < 2.2)
        with viewed.held("w"):
            slid = viewed.wait("s.place", lambda place: place[1] > stopped[1] + 0.8)
        assert WALL < slid[0] < -8.3
        viewed.check_clean(url)


def test_first_step_removes_the_hint_for_ever(browser: Any, url: str) -> None:
    with viewed_page(browser, url, full=True) as viewed:
        viewed.wait("s.place && s.notices.includes('hint')")
        assert "Walk with W A S D" in viewed.page.inner_text("#notices")
        with viewed.held("w"):
            viewed.wait("!s.notices.includes('hint')")
        viewed.page.reload()
        viewed.wait("s.place && s.frames > 3")
        assert "hint" not in viewed.read("s.notices")


@pytest.mark.slow
def test_user_passes_the_door_and_looks_from_its_eyes(browser: Any, url: str) -> None:
    with viewed_page(browser, f"{url}?at={BEFORE_DOOR}") as viewed:
        viewed.wait("s.place")
        viewed.page.keyboard.press("v")
        assert viewed.page.get_by_label("First person").is_checked()
        with viewed.held("ArrowUp"):
            inside = viewed.wait("s.place", lambda place: place[1] > 2.0)
        assert abs(inside[0]) < 0.8
        viewed.check_clean(url)


@pytest.mark.slow
def test_voxel_boxes_show_what_is_loaded_as_the_user_walks(browser: Any, facade_file: Path) -> None:
    with (
        served(facade_file, None) as endpoint,
        viewing(endpoint) as url,
        viewed_page(browser, f"{url}?at={BY_WALL}") as viewed,
    ):
        viewed.wait("s.place && s.voxels.some((each) => each.resident)")
        viewed.page.get_by_label("Voxels in memory").check()
        viewed.wait("s.boxes")
        resident = "s.voxels.filter((each) => each.resident).map((each) => each.name)"
        before = set(viewed.read(resident))
        assert len(before) < viewed.read("s.voxels.length")
        with viewed.held("d", "Shift"):
            viewed.wait(resident, lambda names: bool(set(names) - before))
        viewed.check_clean(url)


@pytest.mark.slow
def test_two_browsers_see_one_another(browser: Any, url: str) -> None:
    with (
        viewed_page(browser, f"{url}?at={BY_WALL}") as one,
        viewed_page(browser, f"{url}?at={BEFORE_DOOR}") as other,
    ):
        one.wait("s.place")
        place = other.wait("s.place")
        assert len(one.wait("s.others.length && s.others")) == 1
        seen = other.wait("s.others.length && s.others[0]")
        own = one.read("s.pose")
        assert np.allclose(seen, [row[3] for row in own[:3]], atol=1e-3)
        with other.held("s"):
            other.wait("s.place", lambda now: now[1] < place[1] - 0.3)
        other.page.close()
        one.wait("s.others.length === 0")
        one.check_clean(url)


@contextmanager
def running(scene: Path, endpoint: str) -> Iterator["subprocess.Popen[str]"]:
    """Serve a scene file at an endpoint, by a process that a test may kill."""
    command = [sys.executable, "-P", "-m", "solidcloud.server.cli.main", "serve", str(scene)]
    process = subprocess.Popen([*command, "--listen", endpoint], stdout=subprocess.PIPE, text=True)
    try:
        assert READY_LINE in map(str.strip, process.stdout or ())
        yield process
    finally:
        process.terminate()
        process.communicate()


@pytest.mark.slow
def test_loss_and_return_of_the_server_are_shown_and_the_user_continues(
    browser: Any, facade_file: Path, free_endpoint: Any
) -> None:
    where = free_endpoint()
    with viewing(where, "archive") as url, viewed_page(browser, f"{url}?at={BY_WALL}") as viewed:
        viewed.wait("s.server === 'searching'")
        assert "No server yet" in viewed.page.inner_text("#notices")
        with running(facade_file, where) as process:
            place = viewed.wait("s.server === 'connected' && s.place")
            process.send_signal(signal.SIGKILL)
            viewed.wait("s.server === 'lost'")
            assert "The server is lost" in viewed.page.inner_text("#notices")
        with running(facade_file, where):
            viewed.wait("s.server === 'connected'")
            viewed.wait("!s.notices.includes('server')")
            with viewed.held("w"):
                moved = viewed.wait("s.place", lambda now: now[0] < place[0] - 0.2)
        assert abs(moved[1] - place[1]) < 0.3
        viewed.check_clean(url)


@pytest.mark.slow
def test_end_of_the_viewer_is_shown(browser: Any, facade_endpoint: str) -> None:
    with viewing(facade_endpoint) as url, viewed_page(browser, url) as viewed:
        viewed.wait("s.place")
        # A context that outlives the block: the page stays open while the viewer ends.
        context = browser.new_context()
        page = context.new_page()
        page.goto(url)
    try:
        page.wait_for_selector("[data-subject=process]", timeout=60_000)
        assert "The viewer has ended" in page.inner_text("#notices")
    finally:
        context.close()


@pytest.mark.slow
def test_panel_is_operated_by_keyboard(browser: Any, url: str) -> None:
    with viewed_page(browser, url) as viewed:
        viewed.wait_complete()
        before = viewed.picture()
        viewed.page.keyboard.press("c")
        assert viewed.wait("s.colour", lambda name: name != "height") == "verdict"
        viewed.wait("s.complete")
        assert np.abs(viewed.picture() - before).max() > 40
        toggle = viewed.page.get_by_role("button", name="Settings")
        toggle.focus()
        viewed.page.keyboard.press("Enter")
        assert not viewed.page.locator("#panel").is_visible()
        assert toggle.get_attribute("aria-expanded") == "false"
        viewed.page.keyboard.press("Enter")
        unnamed = viewed.page.evaluate(
            "[...document.querySelectorAll('#panel input, #panel select, #panel button')]"
            ".filter((each) => !(each.labels?.length || each.ariaLabel || each.textContent.trim())).length"
        )
        assert unnamed == 0
        viewed.check_clean(url)


@pytest.mark.slow
def test_browser_without_webgl_is_told(browser: Any, url: str) -> None:
    plain = browser.browser_type.launch(executable_path=CHROMIUM, args=["--disable-3d-apis"])
    try:
        page = plain.new_page()
        page.goto(url)
        page.wait_for_selector(".fatal[role=alert]")
        assert "WebGL 2" in page.inner_text(".fatal[role=alert]")
    finally:
        plain.close()


@pytest.mark.slow
def test_command_serves_an_archive_and_prints_the_address(browser: Any, facade_file: Path) -> None:
    command = [sys.executable, "-P", "-m", "solidcloud.server.cli.main", "view"]
    process = subprocess.Popen(
        [*command, str(facade_file.parent / "archive"), "--no-browser"], stdout=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout is not None
        line = next(line for line in process.stdout if line.startswith("viewer: "))
        url = line.split()[1]
        with viewed_page(browser, url) as viewed:
            # Without a place in the link, the user is put where it can stand.
            viewed.wait("s.place")
            viewed.wait("s.verdict === 'clear'")
            viewed.check_clean(url)
    finally:
        process.terminate()
        process.communicate()
    assert process.returncode == 0
