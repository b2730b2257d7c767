"""Test what a new user meets in the viewer, with a real browser: hints, small screens, a scene with a spawn."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from solidcloud.server.cli.scene_files.viewed_scene import archive_scene
from solidcloud.server.report.walk.server_process import served
from solidcloud.server.viewer import clash_session
from solidcloud.server.viewer.viewer import viewing
from viewed_page import ViewedPage, needs_chromium, viewed_page

pytestmark = [needs_chromium, pytest.mark.slow]

SPAWN = (-7.0, -9.0, 0.1)
# Beside the spawn without anything between, and beyond the wall.
REACHED, BEYOND = "-6.5,-9,0.1,90", "-12,-9,0.1,90"
# A place on the forecourt from which nothing is above, and the direction away from the façade.
TO_THE_SKY = "-6.5,-9,0.1,-90"
PHONE = {"width": 390, "height": 844}


@pytest.fixture(scope="module")
def url(facade_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Serve the façade with a spawn at which users begin."""
    scene = tmp_path_factory.mktemp("spawn") / "viewer.toml"
    spawn = f"\n[spawn]\nposition = {list(SPAWN)}\nheading = 0.0\n"
    scene.write_text(archive_scene(facade_file.parent / "archive") + spawn)
    with served(scene, None) as endpoint, viewing(endpoint) as url:
        yield url


@contextmanager
def phone_page(browser: Any, url: str) -> Iterator[ViewedPage]:
    """Open a page on a screen that is touched, as large as a phone's."""
    context = browser.new_context(viewport=PHONE, has_touch=True, is_mobile=True)
    context.add_init_script(
        """localStorage.setItem("solidcloud.settings", '{"budget": 0.1, "shading": false}')"""
    )
    try:
        viewed = ViewedPage(context.new_page())
        viewed.page.goto(url)
        yield viewed
    finally:
        context.close()


def test_link_begins_elsewhere_as_far_as_the_way_from_the_spawn_is_free(browser: Any, url: str) -> None:
    with viewed_page(browser, f"{url}?at={REACHED}") as viewed:
        viewed.wait("s.place", lambda place: place and np.allclose(place[:2], (-6.5, -9.0), atol=0.01))
        assert "place" not in viewed.read("s.notices")


def test_user_who_cannot_be_at_the_links_place_is_told_why(browser: Any, url: str) -> None:
    with viewed_page(browser, f"{url}?at={BEYOND}") as viewed:
        viewed.wait("s.place && s.notices.includes('place')")
        assert viewed.read("s.place")[0] > -9
        text = viewed.page.inner_text("#notices")
        assert "You are not at the link's place" in text and "spawn" in text
        viewed.check_clean(url)


def test_user_who_sees_nothing_of_the_scan_is_told_how_to_find_it(browser: Any, url: str) -> None:
    with viewed_page(browser, f"{url}?at={TO_THE_SKY}") as viewed:
        viewed.wait_complete()
        assert not {"sight", "standing"} & set(viewed.read("s.notices"))
        mouse = viewed.page.mouse
        mouse.move(600, 500)
        mouse.down()
        mouse.move(600, 20, steps=4)
        mouse.up()
        viewed.page.keyboard.press("v")
        viewed.wait("s.notices.includes('sight')")
        assert "H goes back to the start" in viewed.page.inner_text("#notices")
        mouse.move(600, 20)
        mouse.down()
        mouse.move(600, 400, steps=4)
        mouse.up()
        viewed.wait("!s.notices.includes('sight')")
        viewed.check_clean(url)


def test_keys_do_not_frame_the_scan_and_a_column_that_goes_on_says_so(browser: Any, url: str) -> None:
    with viewed_page(browser, url) as viewed:
        viewed.wait("s.place")
        page = viewed.page
        page.locator("#view").click(position={"x": 600, "y": 300})
        with viewed.held("ArrowUp"):
            viewed.wait("s.frames > 3")
        assert page.evaluate("document.querySelector('#view').matches(':focus-visible')")
        assert page.evaluate("getComputedStyle(document.querySelector('#view')).outlineStyle") == "none"
        toggle = page.get_by_role("button", name="Settings")
        toggle.focus()
        assert (
            page.evaluate("getComputedStyle(document.querySelector('#panel-toggle')).outlineStyle") != "none"
        )
        hint = page.locator("#panel .more")
        assert hint.is_visible()
        page.evaluate("document.querySelector('#panel').scrollTo(0, 1e6)")
        hint.wait_for(state="hidden")
        viewed.check_clean(url)


def test_phone_shows_one_column_at_a_time_and_nothing_beyond_its_screen(browser: Any, url: str) -> None:
    with phone_page(browser, url) as viewed:
        viewed.wait("s.place")
        page = viewed.page
        assert "round stick" in page.inner_text("#notices")
        assert not page.locator("#panel").is_visible()
        page.tap("#panel-toggle")
        assert page.locator("#panel").is_visible()
        page.tap("#instruments-toggle")
        assert page.locator("#instruments").is_visible()
        assert not page.locator("#panel").is_visible()
        for selector in ("#title", "#status", "#instruments", "#stick", "#status dl div:visible >> nth=-1"):
            box = page.locator(selector).bounding_box()
            assert box["x"] >= 0 and box["x"] + box["width"] <= PHONE["width"], selector
            assert box["y"] >= 0 and box["y"] + box["height"] <= PHONE["height"], selector
        title, column = (page.locator(each).bounding_box() for each in ("#title", "#instruments"))
        assert title["y"] + title["height"] <= column["y"]
        page.tap("#instruments-toggle")
        before = viewed.read("s.place")
        stick = page.locator("#stick").bounding_box()
        x, y = stick["x"] + stick["width"] / 2, stick["y"] + stick["height"] / 2
        finger = page.context.new_cdp_session(page)
        finger.send("Input.dispatchTouchEvent", {"type": "touchStart", "touchPoints": [{"x": x, "y": y}]})
        finger.send("Input.dispatchTouchEvent", {"type": "touchMove", "touchPoints": [{"x": x, "y": y - 50}]})
        viewed.wait("s.place", lambda place: np.hypot(*np.subtract(place, before)[:2]) > 0.3)
        finger.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
        viewed.check_clean(url)


def test_camera_keeps_away_from_a_user_with_a_wall_behind(browser: Any, url: str) -> None:
    # The user faces away from the cloister's wall, which is 0.9 m behind.
    with viewed_page(browser, f"{url}?at=-8.1,-9,0.1,0") as viewed:
        viewed.wait_complete()
        pose = viewed.read("s.pose")
        away = viewed.wait(
            "s.camera", lambda camera: np.hypot(camera[0] - pose[0][3], camera[1] - pose[1][3]) < 4
        )
        assert np.hypot(away[0] - pose[0][3], away[1] - pose[1][3]) > 1.3


def test_panel_says_how_many_clashes_a_bcf_file_has(
    browser: Any, url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(clash_session, "MOST_TOPICS", 1)
    # To and fro through the cloister's wall: three clashes.
    ways = [-10 + 0.1 * k for k in range(20)]
    rows = [f"{k},{x:.1f},-9,0.1,1,0,0,0" for k, x in enumerate([*ways, *reversed(ways), *ways])]
    text = "\n".join(["t,x,y,z,qw,qx,qy,qz", *rows]) + "\n"
    with viewed_page(browser, url) as viewed:
        viewed.wait("s.place")
        viewed.page.get_by_label("Load a path").set_input_files(
            {"name": "way.csv", "mimeType": "text/csv", "buffer": text.encode()}
        )
        result = viewed.wait("s.clash.state === 'done' && s.clash.result")
        assert result["topics"] == 1
        cut = viewed.page.locator("#clash-cut")
        assert result["total"] >= 3
        assert cut.inner_text().startswith(f"BCF has the 1 deepest of the {result['total']} clashes")
        # The effect `ground` keeps 3 cm under the feet: a walk on a floor is not near.
        assert viewed.page.get_by_label("Near", exact=True).input_value() == "0.02"
