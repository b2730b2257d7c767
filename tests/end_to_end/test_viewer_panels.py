"""Test the viewer's panels of what is going on, with a real browser: plots, effects, accuracy, hierarchy."""

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from solidcloud.server.cli.commands.viewed_server import ViewedServer
from solidcloud.server.viewer.viewer import viewing
from viewed_page import ViewedPage, needs_chromium, viewed_page

pytestmark = [needs_chromium, pytest.mark.slow]

BY_WALL = "-7.6,-9,0.1,180"
LAST = "s.samples[s.samples.length - 1]"
# Pixels of a chart that are neither transparent nor of its grid and text.
INKED = """(canvas) => {
  const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
  let found = 0;
  for (let k = 0; k < data.length; k += 4) {
    const [r, g, b, a] = data.subarray(k, k + 4);
    if (a > 150 && Math.max(r, g, b) - Math.min(r, g, b) > 60) found += 1;
  }
  return found;
}"""


@pytest.fixture(scope="module")
def server(facade_file: Path) -> Iterator[ViewedServer]:
    with ViewedServer(facade_file) as server:
        yield server


@pytest.fixture
def url(server: ViewedServer) -> Iterator[str]:
    with viewing(server.endpoint, switch=server) as url:
        yield url


def opened(viewed: ViewedPage, *titles: str) -> None:
    """Show the panels of what is going on, and open some of them, by the keyboard."""
    viewed.wait("s.place")
    viewed.page.keyboard.press("g")
    for title in titles:
        button = viewed.page.get_by_role("button", name=title)
        button.focus()
        viewed.page.keyboard.press("Enter")
        assert button.get_attribute("aria-expanded") == "true"


def test_plots_show_frame_times_and_the_cache(browser: Any, url: str) -> None:
    with viewed_page(browser, f"{url}?at={BY_WALL}") as viewed:
        opened(viewed)
        with viewed.held("d"):
            viewed.wait("s.samples.length > 3")
            last = viewed.wait(f"{LAST}.hits > 0 && {LAST}.frame > 0 && {LAST}")
        assert {"effect stop", "effect ground", "effect contacts", "trip", "worst"} <= set(last)
        assert 0 < sum(last[name] for name in last if name.startswith("effect ")) < 1000
        assert last["trip"] <= last["worst"]
        assert 0 < last["voxels"] + last["levels"] < last["budget"]
        figures = viewed.page.locator("#instruments figure")
        assert figures.count() == 5
        frames = figures.first.inner_text()
        assert "[ms]" in frames and "ground" in frames
        for number in range(3):  # frame time, round trip, requested voxels
            canvas = figures.nth(number).locator("canvas")
            assert canvas.evaluate(INKED) > 20
            assert "over the last minute; now" in (canvas.get_attribute("aria-label") or "")
        assert "voxels in memory" in viewed.page.inner_text("#instrument-openPlots")
        # Another browser is given what was before it.
        with viewed_page(browser, url) as other:
            other.wait("s.samples.length > 3")
        viewed.check_clean(url)


def test_dial_changes_node_visits_and_bounds(browser: Any, url: str) -> None:
    with viewed_page(browser, f"{url}?at={BY_WALL}") as viewed:
        opened(viewed, "Dial of accuracy")
        dial = viewed.page.get_by_role("slider", name="Tolerance")
        dial.fill("0")
        at_zero = viewed.wait("s.measured && s.measured.tolerance === 0 && s.measured")
        dial.fill("10")
        dialled = viewed.wait("s.measured.tolerance === 0.1 && s.measured")
        for question in ("collide", "distance"):
            before, after = at_zero["answers"][question], dialled["answers"][question]
            assert before["exact"]["visits"] == before["tolerant"]["visits"] > 0
            assert after["exact"]["visits"] == before["exact"]["visits"]
            saved = after["exact"]["visits"] - after["tolerant"]["visits"]
            # One pose in memory is answered by one kernel call, whose distance is exact.
            assert saved > 0 if question == "collide" else saved == 0
        exact, tolerant = (dialled["answers"]["distance"][kind] for kind in ("exact", "tolerant"))
        assert exact["sure"] and exact["lower"] == exact["upper"]
        assert tolerant["lower"] == exact["lower"] == tolerant["upper"]
        table = viewed.page.inner_text("#instrument-openAccuracy table")
        assert "within 10.0 cm" in table and f"{exact['visits']:,}" in table
        viewed.check_clean(url)


def test_level_changes_the_spheres_and_the_picture(browser: Any, url: str) -> None:
    with viewed_page(browser, f"{url}?at={BY_WALL}") as viewed:
        opened(viewed, "Hierarchy")
        level = viewed.page.get_by_role("slider", name="Level", exact=True)
        totals, pictures = [], []
        for number in range(4):
            level.fill(str(number))
            spheres = viewed.wait(f"s.spheres && s.spheres.level === {number} && s.spheres")
            viewed.wait("s.complete")
            totals.append(spheres["total"])
            pictures.append(viewed.picture())
            assert 0 < spheres["drawn"] <= spheres["total"]
            assert spheres["radii"][0] <= spheres["radii"][1]
            text = f"Level {number}: {spheres['total']:,} spheres"
            assert text in viewed.page.inner_text("#instrument-openHierarchy")
        assert totals == sorted(set(totals))
        assert totals[0] == spheres["voxels"] > 1
        for one, other in pairwise(pictures):
            assert (np.abs(one - other).max(axis=-1) > 25).mean() > 0.01
        viewed.page.get_by_label("Show spheres and their voxels").uncheck()
        viewed.wait("s.spheres === null")
        viewed.check_clean(url)


def test_effects_are_switched_with_those_that_require_them(browser: Any, url: str, server: Any) -> None:
    with viewed_page(browser, f"{url}?at={BY_WALL}") as viewed:
        opened(viewed, "Effects")
        place = viewed.wait("s.place")
        shown = viewed.wait("s.effects.length && s.effects")
        assert [each["name"] for each in shown] == list(server.declared)
        viewed.page.get_by_role("checkbox", name="slide").click()
        running = "s.effects.filter((each) => each.on).map((each) => each.name)"
        left = [name for name in server.declared if name not in ("slide", "step")]
        viewed.wait(running, lambda names: names == left)
        # The frames of the new server have no such effect, and the user is where it was.
        viewed.wait(f"{LAST} && !('effect slide' in {LAST}) && {LAST}['effect stop'] > 0")
        assert np.allclose(viewed.read("s.place"), place, atol=0.1)
        viewed.page.get_by_role("checkbox", name="step").click()
        viewed.wait(running, lambda names: names == list(server.declared))
        viewed.wait("!s.notices.includes('server')")
        viewed.check_clean(url)


def test_effects_of_another_server_are_shown_only(browser: Any, server: ViewedServer) -> None:
    with viewing(server.endpoint) as url, viewed_page(browser, url) as viewed:
        opened(viewed, "Effects")
        viewed.wait("s.effects.length")
        assert viewed.page.get_by_role("checkbox", name="slide").is_disabled()
        assert "scene file" in viewed.page.inner_text("#instrument-openEffects > p")
        unnamed = viewed.page.evaluate(
            "[...document.querySelectorAll('#instruments input, #instruments button')]"
            ".filter((each) => !(each.labels?.length || each.ariaLabel || each.textContent.trim())).length"
        )
        assert unnamed == 0
        viewed.check_clean(url)
